# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A video of one camera, with a table of the times of its frames, and with or without an IMU."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.datasets.formats.image_folder import (
    LooseFiles,
    find_files,
    is_usable_rate,
    read_stamps,
    regular_stamps,
)
from slam_graph.datasets.sequence import FrameStream, ReaderOptions
from slam_graph.datasets.streams.image_sequence import (
    LOOKED_AT,
    GroupedSequence,
    check_size,
    require_size,
)
from slam_graph.datasets.streams.images import Fault, Image, prefetch
from slam_graph.datasets.streams.pairing import Groups, group_by_time, in_order
from slam_graph.errors import DataError
from slam_graph.image_files import ImageFile
from slam_graph.sensors import CameraFrame

SUFFIXES = {".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mjpeg", ".h264"}

_SILENT = "-8"
"""FFmpeg's level of logging; damage is found and counted without its messages."""


_MOST_FRAMES = 100_000_000
"""No container is believed that claims more, 19 days at 60 Hz: their times take 0.8 GB."""


def is_video(path: Path) -> bool:
    """Whether this is a video, by its name."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


class _VideoReader:
    """Reads the frames of a video one after the other, as grey images.

    Raises:
        DataError: if the video cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _SILENT)
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not self._capture.isOpened():
            raise DataError(f"{path}: this video cannot be opened; it is damaged or not a video")
        self._next = 0
        self._most = path.stat().st_size
        sides = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        width, height = (int(self._capture.get(side)) for side in sides)
        fault = ImageFile.fault_of_claim((width, height), self._most)
        if fault is not None:
            self.close()
            raise DataError(f"{path}: this video {fault}; it is damaged")

    @property
    def count(self) -> int | None:
        """Number of frames according to the container; None if it gives none that can be true.

        There are no more frames than bytes, and no more than `_MOST_FRAMES`.
        """
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        return int(count) if 0 < count <= min(self._most, _MOST_FRAMES) else None

    @property
    def rate_hz(self) -> float | None:
        """Frame rate according to the container; None if it gives none.

        Without a number of frames it is FFmpeg's guess, and not used.
        """
        rate_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate_hz if self.count is not None and is_usable_rate(rate_hz) else None

    def skip_to(self, index: int) -> bool:
        """Go forward to a frame; whether there is one."""
        while self._next <= index:
            if not self._capture.grab():
                return False
            self._next += 1
        return True

    def read(self, index: int) -> Image | None:
        """Go forward to a frame and read it; None if the video ends before it."""
        if not self.skip_to(index):
            return None
        whole, image = self._capture.retrieve()
        if not whole:
            return None
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return np.asarray(grey, np.uint8)

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


class VideoSequence(GroupedSequence):
    """A video of one camera.

    The times of its frames are in a table (see `loose_files`), one for each frame. Without one they
    have the rate that is given, or that of the container (`stamps_assumed`), from time 0.

    Args:
        path: the video.
        options: what else is asked for. Files that are not named are looked for beside the video:
            calibration ``NAME.yaml``; of the `sources` ``stamps`` ``NAME.csv`` and ``imu``
            ``NAME.imu.csv``. A source ``rate`` gives the frame rate in Hz.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "video"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path
        with closing(_VideoReader(path)) as video:
            beside = {
                "stamps": [path.with_suffix(".csv"), path.with_suffix(".txt")],
                "imu": [path.with_suffix(".imu.csv")],
                "calibration": [path.with_suffix(".yaml")],
            }
            files = find_files(path, beside, options)
            rig = replace(files.rig, has_imu=files.imu is not None, depth=None)
            super().__init__(path.stem, rig, ["video"], files.imu, options)
            rate_hz = files.rate_hz if files.rate_hz is not None else video.rate_hz
            count = video.count if video.count is not None else _count_frames(path)
            looked_at = [video.read(k) for k in range(LOOKED_AT)]
        first = [image for image in looked_at if image is not None]
        if not first:
            raise DataError(f"{path}: no frame of this video can be read")
        require_size(first, files.rig.cameras[0].camera, path.name)
        stamps = self._stamps(files, count, rate_hz)
        self._kept = in_order(stamps, partial(self._dropped, stamps))
        self._groups = group_by_time([stamps[self._kept]], 0)

    @property
    def groups(self) -> Groups:
        """The frames by their times."""
        return self._groups

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """Frames with their images, the next ones decoded in a thread.

        They end where the video does, also if its container or the table of times promised more
        (`video_ended_early`).
        """
        wanted = self._range(start_ns, end_ns)
        if not self.decode:
            for k in wanted:
                yield CameraFrame(int(self._groups.stamps_ns[k]), (None,))
            return
        with closing(_VideoReader(self.path)) as video:
            jobs = (partial(video.read, int(self._kept[k])) for k in wanted)
            with closing(prefetch(jobs)) as results:
                for k, image in zip(wanted, results, strict=True):
                    if image is None:
                        what = f"ends before frame {self._kept[k]}, {self._kept[-1] + 1} expected"
                        self.diagnostics.warn("video_ended_early", f"{self.path}: {what}")
                        return
                    yield self._report(k, [self._checked(image, k)])

    def _checked(self, image: Image, index: int) -> Image | Fault:
        where: Callable[[], str] = lambda: f"{self.path}: frame {self._kept[index]}"  # noqa: E731
        return check_size(image, self.rig.cameras[0].camera, where)

    def _stamps(self, files: LooseFiles, count: int, rate_hz: float | None) -> IntArray:
        """Times (N,) of the frames."""
        if files.stamps is not None:
            stamps, _ = read_stamps(files.stamps)
            if len(stamps) != count:
                what = f"{len(stamps)} times, {self.path.name} has {count} frames"
                what += "; taken in their order as far as both go"
                self.diagnostics.warn("stamps_differ", f"{files.stamps}: {what}")
            return stamps[:count]
        if rate_hz is None:
            raise DataError(
                f"{self.path}: no times of the frames, and the container has no frame rate; give "
                "--source stamps=FILE or --source rate=HZ"
            )
        if files.rate_hz is None:
            what = f"no times of the frames; taken as {rate_hz:.6g} a second, from time 0"
            self.diagnostics.warn("stamps_assumed", f"{self.path}: {what}")
        return regular_stamps(count, rate_hz)

    def _dropped(self, stamps: IntArray, k: int, _: int) -> None:
        what = f"frame {k} at {stamps[k]} dropped, not in the order of time"
        self.diagnostics.warn("camera_out_of_order", f"{self.path}: {what}")


def _count_frames(path: Path) -> int:
    """Go through a whole video to count its frames."""
    with closing(_VideoReader(path)) as video:
        return next(k for k in range(2**62) if not video.skip_to(k))
