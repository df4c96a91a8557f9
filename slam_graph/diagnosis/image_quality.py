# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Brightness, contrast, sharpness and repetition of images."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors import CameraFrame

_SATURATED, _BLACK = 250, 5
"""Grey levels from which on a pixel is overexposed, and up to which it is black."""


@dataclass(frozen=True, slots=True)
class ImageFigures:
    """Figures of one image.

    Attributes:
        stamp_ns: time.
        mean: grey level.
        std: standard deviation of the grey levels.
        bright, dark: shares of pixels that are overexposed or black.
        blur: share of the differences between neighbouring pixels that is left after smoothing
            (Crété et al. 2007, turned around): 0 for noise, 1 where smoothing changes nothing.
        repeated: whether it is identical to the image before.
    """

    stamp_ns: int
    mean: float
    std: float
    bright: float
    dark: float
    blur: float
    repeated: bool


@dataclass
class ImageSurvey:
    """Figures of the images of each camera.

    Attributes:
        cameras: number of cameras.
        figures: of each camera, in the order of time.
        missing: number of frames without an image, of each camera.
    """

    cameras: int
    figures: list[list[ImageFigures]] = field(init=False)
    missing: list[int] = field(init=False)
    _before: list[NDArray[np.uint8] | None] = field(init=False)

    def __post_init__(self) -> None:
        self.figures = [[] for _ in range(self.cameras)]
        self.missing = [0] * self.cameras
        self._before = [None] * self.cameras

    def add(self, frame: CameraFrame) -> None:
        """Take the images of the next frame."""
        for c, image in enumerate(frame.images[: self.cameras]):
            if image is None:
                self.missing[c] += 1
                continue
            before = self._before[c]
            repeated = before is not None and np.array_equal(before, image)
            self.figures[c].append(_figures(frame.stamp_ns, image, repeated))
            self._before[c] = image


def _figures(stamp_ns: int, image: NDArray[np.uint8], repeated: bool) -> ImageFigures:
    counts = np.asarray(cv2.calcHist([image], [0], None, [256], [0, 256])).ravel()
    share = counts / image.size
    levels = np.arange(256)
    mean = float(share @ levels)
    std = float(np.sqrt(np.sum(share * (levels - mean) ** 2)))
    bright, dark = float(share[_SATURATED:].sum()), float(share[: _BLACK + 1].sum())
    return ImageFigures(stamp_ns, mean, std, bright, dark, _blur(image), repeated)


def _blur(image: NDArray[np.uint8]) -> float:
    """How little of the gradients a smoothing takes away, 0 to 1."""
    middle = image[image.shape[0] // 4 : -(image.shape[0] // 4)]
    grey = middle.astype(np.float32)
    smooth = np.asarray(cv2.blur(grey, (5, 5)))
    shares = []
    for axis in (0, 1):
        before = np.abs(np.diff(grey, axis=axis))
        after = np.abs(np.diff(smooth, axis=axis))
        total = float(before.sum())
        shares.append(1.0 if total == 0.0 else float(np.minimum(before, after).sum()) / total)
    return max(shares)
