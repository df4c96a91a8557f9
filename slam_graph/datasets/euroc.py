# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC / ASL folders: images of any number of cameras, an IMU, and often ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from copy import copy
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.asl import find_mav0, list_images, name_of, read_rig
from slam_graph.datasets.groundtruth import find_groundtruth
from slam_graph.datasets.images import Fault, prefetch, read_grey
from slam_graph.datasets.imu_stream import clean_blocks, parse_imu_rows
from slam_graph.datasets.packets import FrameStream
from slam_graph.datasets.pairing import ABSENT, Groups, group_by_time
from slam_graph.datasets.recorded import Extent, RecordedSequence
from slam_graph.datasets.rows import count_rows, read_rows, require_rows
from slam_graph.diagnostics import Diagnostics
from slam_graph.sensors.measurements import CameraFrame, ImuData

STEREO_TOLERANCE_S = 0.003
"""Images at most this far apart are one frame; EuRoC's pairs differ by some hundred nanoseconds."""

Image = NDArray[np.uint8] | Fault | None


class EurocSequence(RecordedSequence):
    """A recording in the ASL layout: a folder for each sensor, in one folder ``mav0``.

    Frames carry None for the image of a camera that has none at that time (counted as
    `camera_frame_missing`), or one that is damaged or not of the calibrated size
    (`image_unreadable`, `image_wrong_size`). A folder whose cameras are calibrated but hold no
    images opens with 0 frames, for its IMU and ground truth.

    Args:
        path: ``mav0`` or the folder that holds it.
        cameras: use only the first so many.
        calibration: a Kalibr camera chain to use instead of the ``sensor.yaml`` files.
        groundtruth: file or folder to use instead of the recording's own ground truth.
        diagnostics: where faults are counted.
        stereo_tolerance_s: largest time difference of images that are one frame.
        decode: False leaves all images None, and only looks whether their files exist.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "euroc"
    content: ClassVar[Literal["images", "tracks"]] = "images"

    def __init__(
        self,
        path: Path,
        cameras: int | None = None,
        calibration: Path | None = None,
        groundtruth: Path | None = None,
        diagnostics: Diagnostics | None = None,
        stereo_tolerance_s: float = STEREO_TOLERANCE_S,
        decode: bool = True,
    ) -> None:
        self.mav0 = find_mav0(path)
        rig, folders = read_rig(self.mav0, cameras, calibration)
        super().__init__(
            name_of(self.mav0), rig, groundtruth or find_groundtruth(self.mav0), diagnostics
        )
        self.decode = decode
        self._imu_file = self.mav0 / "imu0" / "data.csv"
        require_rows(self._imu_file)
        self._folders = folders
        listed = [list_images(folder, self.diagnostics) for folder in folders]
        self._files = [names for _, names in listed]
        self._groups = self._group([stamps for stamps, _ in listed], stereo_tolerance_s)

    def without_images(self) -> EurocSequence:
        """The same recording, its frames without images: quick to run through."""
        twin = copy(self)
        twin.decode = False
        return twin

    def measure(self) -> Extent:
        """Count frames and IMU samples."""
        stamps = self._groups.stamps_ns
        samples, first, last = count_rows(self._imu_file)
        if len(stamps):
            return Extent(len(stamps), int(stamps[0]), int(stamps[-1]), samples)
        ends = [int(line.partition(",")[0]) for line in (first, last)]
        return Extent(0, ends[0], ends[1], samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on."""
        blocks = ((rows, parse_imu_rows(rows)) for rows in read_rows(self._imu_file))
        return clean_blocks(blocks, self.diagnostics, after_ns)

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """Frames with their images, the next ones decoded in a thread."""
        stamps = self._groups.stamps_ns
        first = 0 if start_ns is None else int(np.searchsorted(stamps, start_ns))
        last = len(stamps) if end_ns is None else int(np.searchsorted(stamps, end_ns, "right"))
        jobs = (partial(self._read_frame, k) for k in range(first, last))
        with closing(prefetch(jobs)) as results:
            for k, images in zip(range(first, last), results, strict=True):
                yield self._report(k, images)

    def _group(self, stamps: list[NDArray[np.int64]], tolerance_s: float) -> Groups:
        groups = group_by_time(stamps, round(tolerance_s * 1e9))
        for stamp in groups.skipped:
            self.diagnostics.warn("camera_out_of_order", f"{self.mav0}: frame at {stamp} dropped")
        return groups

    def _read_frame(self, index: int) -> list[Image]:
        """The images of one frame; runs in the thread, so it counts nothing itself."""
        images: list[Image] = []
        for camera, member in enumerate(self._groups.members[index].tolist()):
            if member == ABSENT:
                images.append(None)
                continue
            path = self._folders[camera] / "data" / self._files[camera][member]
            images.append(self._read_image(camera, path))
        return images

    def _read_image(self, camera: int, path: Path) -> Image:
        if self.decode:
            model = self.rig.cameras[camera].camera
            return read_grey(path, model.width, model.height)
        missing = not path.is_file()
        return Fault("image_unreadable", f"{path}: no such file") if missing else None

    def _report(self, index: int, images: list[Image]) -> CameraFrame:
        """Count what is wrong with a frame, and deliver the rest of it."""
        stamp_ns = int(self._groups.stamps_ns[index])
        for camera, member in enumerate(self._groups.members[index].tolist()):
            image = images[camera]
            if member == ABSENT:
                name = self._folders[camera].name
                self.diagnostics.warn("camera_frame_missing", f"{name} has no image at {stamp_ns}")
            elif isinstance(image, Fault):
                self.diagnostics.warn(image.kind, image.message)
        return CameraFrame(stamp_ns, tuple(None if isinstance(i, Fault) else i for i in images))
