# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Feature tracks drawn on the images: the features and their recent paths."""

from __future__ import annotations

import shutil
from collections import defaultdict, deque
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.sensors import CameraFrame, FeatureFrame

Picture = NDArray[np.uint8]

_TAIL_FRAMES = 15
"""Length of the path that is drawn behind a feature; also the age at which its colour is full."""

_AGE_COLOURS = cv2.applyColorMap(
    np.linspace(60, 205, _TAIL_FRAMES + 1).astype(np.uint8), cv2.COLORMAP_PLASMA
)[:, 0].tolist()
"""Colours (BGR) by age, from violet to orange: colour-blind people can order them."""

_FRAMES_PER_S = 20.0


class _TrackPainter:
    """Draws the tracks of each frame on its images, the cameras side by side.

    Young features are violet, old ones orange; one that another camera sees too has a ring.
    """

    def __init__(self) -> None:
        self._ages: dict[int, int] = {}
        self._tails: list[dict[int, deque[tuple[int, int]]]] = []

    def paint(self, frame: CameraFrame, features: FeatureFrame) -> Picture:
        """The picture of a frame (height, width of all cameras, 3), BGR."""
        seen = [set(camera.ids.tolist()) for camera in features.cameras]
        everywhere: dict[int, int] = defaultdict(int)
        for ids in seen:
            for j in ids:
                everywhere[j] += 1
        self._ages = {j: self._ages.get(j, 0) + 1 for j in everywhere}
        self._tails = self._tails or [{} for _ in seen]
        pictures = []
        sizes = [image.shape for image in frame.images if image is not None]
        for number, (image, camera) in enumerate(zip(frame.images, features.cameras, strict=True)):
            if image is None:
                image = np.zeros(sizes[0] if sizes else (480, 640), np.uint8)
            picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
            tails = self._tails[number]
            for j, (u, v) in zip(camera.ids.tolist(), camera.pixels.tolist(), strict=True):
                tail = tails.setdefault(j, deque(maxlen=_TAIL_FRAMES))
                tail.append((round(8 * u), round(8 * v)))
                self._mark(picture, tail, self._ages[j], everywhere[j] > 1)
            self._tails[number] = {j: tail for j, tail in tails.items() if j in seen[number]}
            pictures.append(picture)
        height = max(picture.shape[0] for picture in pictures)
        return np.concatenate([_padded(picture, height) for picture in pictures], axis=1)

    def _mark(
        self, picture: NDArray[np.uint8], tail: deque[tuple[int, int]], age: int, shared: bool
    ) -> None:
        """Draw one feature; coordinates are in eighths of a pixel (`shift=3` of OpenCV)."""
        colour = _AGE_COLOURS[min(age, _TAIL_FRAMES)]
        way = np.array(tail, np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [way], False, colour, 1, cv2.LINE_AA, 3)
        cv2.circle(picture, tail[-1], 16, colour, cv2.FILLED, cv2.LINE_AA, 3)
        if shared:
            cv2.circle(picture, tail[-1], 36, colour, 1, cv2.LINE_AA, 3)


class TrackPictures:
    """A picture of one frame with its tracks, and a video of all; a context manager.

    Args:
        picture: PNG to write.
        middle_ns: the picture is of the first frame at or after this time.
        video: file to write, if one is wanted; its ending names the container, e.g. .mp4.
    """

    def __init__(self, picture: Path, middle_ns: int, video: Path | None = None) -> None:
        self._painter = _TrackPainter()
        self._picture, self._middle_ns, self._video = picture, middle_ns, video
        self._saved = False
        self._writer: cv2.VideoWriter | None = None
        self._filmed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._writer is None or self._video is None:
            return
        self._writer.release()
        try:
            if kind is not None:
                return
            if _frames_in(self._partial) != self._filmed:  # OpenCV does not say if a disk is full
                raise DataError(f"{self._video}: cannot be written; is the disk full?")
            with Files.writing(self._video):
                self._partial.replace(self._video)
        finally:
            shutil.rmtree(self._partial.parent, ignore_errors=True)

    def show(self, frame: CameraFrame, features: FeatureFrame) -> None:
        """Draw the next frame.

        Raises:
            DataError: if picture or video cannot be written.
        """
        drawn = self._painter.paint(frame, features)
        if self._video is not None:
            self._film(self._video, drawn)
        if not self._saved and frame.stamp_ns >= self._middle_ns:
            _save(self._picture, drawn)
            self._saved = True

    def _film(self, path: Path, drawn: Picture) -> None:
        """Append a picture to the video."""
        if self._writer is None:
            self._partial = Files.partial_folder(path) / path.name
            code = cv2.VideoWriter.fourcc(*"mp4v")
            size = (drawn.shape[1], drawn.shape[0])
            self._writer = cv2.VideoWriter(str(self._partial), code, _FRAMES_PER_S, size)
            if not self._writer.isOpened():
                shutil.rmtree(self._partial.parent, ignore_errors=True)
                self._writer = None
                raise DataError(f"{path}: cannot be written as a video; use .mp4")
        self._writer.write(drawn)
        self._filmed += 1


def _frames_in(path: Path) -> int:
    """How many frames a video says that it has; 0 if it cannot be read."""
    video = cv2.VideoCapture(str(path))
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    video.release()
    return count


def _save(path: Path, picture: Picture) -> None:
    """Write a picture as PNG.

    Raises:
        DataError: if it cannot be written.
    """
    Files.make_folder(path.parent)
    good, data = cv2.imencode(".png", picture)
    if not good:
        raise DataError(f"{path}: the picture cannot be encoded")
    with Files.appearing(path) as partial:
        partial.write_bytes(data.tobytes())


def _padded(picture: Picture, height: int) -> Picture:
    """A picture padded with black below, to a common height."""
    return np.pad(picture, ((0, height - picture.shape[0]), (0, 0), (0, 0)))
