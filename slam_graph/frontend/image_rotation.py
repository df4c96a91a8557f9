# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The rotation of a camera between two images, by aligning small copies of them as a whole.

Without a gyroscope nothing says where features will be after a fast turn. Small images are blurred
by it as little as they are small, and a rotation moves all of their pixels, near and far. The
rotation that aligns them best is found by Gauss-Newton steps on the differences of grey values
(direct alignment: Lucas & Kanade 1981, in the three parameters of a rotation), from the last
rotation or, where that does not fit, from it, from none or from a shift by phase correlation,
whichever fits best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.frontend.keypoints import Image
from slam_graph.kernels.image_turn import turn_steps
from slam_graph.sensors import Camera

_WIDTH = 80
"""Width of the small images, in pixels."""
_STEPS = 8
_SMALLEST_STEP = 1e-3
"""Steps end below this angle, rad: half a pixel of a large image. Much less is left then."""
_STRIDE = 2
"""One pixel of so many is compared, in rows and in columns. Between all pixels the rotation differs
by 0.3 mrad in the median."""
_BLUR = 1.0
"""Standard deviation, in small pixels, of the blur that makes alignment smooth."""
_FITTING = 0.2
"""Images fit if they differ by less than this part of their contrast, squared."""
_CLOSELY = 0.1
"""The same part where a rotation is good to a few pixels: not in images that are blurred."""
_LEAST_OVERLAP = 0.4
"""Part of the image that both must show."""

SmallImage = NDArray[np.float32]
"""As images are aligned: `ImageRotation.reduced`."""


class ImageRotation:
    """Aligns the images of one camera.

    A lens with distortion is taken for a pinhole: what that costs is within the search of tracking.

    Attributes:
        close: whether the last rotation that `between` found is good to a few pixels.
    """

    def __init__(self, camera: Camera) -> None:
        self._scale = _WIDTH / camera.width
        height = max(1, round(camera.height * self._scale))
        self._size = _WIDTH, height
        self._camera = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) * self._scale
        self._window = cv2.createHanningWindow(self._size, cv2.CV_32F)
        self._last: tuple[Image, SmallImage] | None = None
        self._turn = np.eye(3)
        self.close = False

    def between(self, before: Image, after: Image) -> FloatArray:
        """after_R_before (3, 3) of the camera."""
        one = self.reduced(before)
        other = self.reduced(after)
        self._last = after, other
        pair = _Pair(one, other, self._camera)
        contrast = float(np.vdot(one, one)) / one.size
        enough = _FITTING * contrast
        guesses = [pair.at(self._turn)]
        if guesses[0].cost >= enough:
            guesses += [pair.at(np.eye(3)), pair.at(self._by_shift(one, other))]
        found = guesses.copy()
        for guess in sorted(guesses, key=_cost_of):
            found.append(pair.refined(guess))
            if found[-1].cost < enough:
                break
        best = min(found, key=_cost_of)
        self._turn, self.close = best.R, best.cost < _CLOSELY * contrast
        return self._turn

    def aligned(self, one: SmallImage, after: Image, guess: FloatArray) -> FloatArray:
        """after_R_before (3, 3) from an earlier reduced image, near a guess."""
        pair = _Pair(one, self.reduced(after), self._camera)
        start = pair.at(guess)
        return min(start, pair.refined(start), key=_cost_of).R

    def reduced(self, image: Image) -> SmallImage:
        """A small, smooth copy with the mean of its surroundings taken away."""
        if self._last is not None and self._last[0] is image:
            return self._last[1]
        reduced: cv2.typing.MatLike = image
        while reduced.shape[1] >= 2 * _WIDTH:  # halving is ten times as fast as any other factor
            half = reduced.shape[1] // 2, max(1, reduced.shape[0] // 2)
            reduced = cv2.resize(reduced, half, interpolation=cv2.INTER_AREA)
        reduced = cv2.resize(reduced, self._size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(reduced.astype(np.float32), (0, 0), _BLUR)
        return np.asarray(small - cv2.blur(small, (31, 31)), np.float32)

    def _by_shift(self, one: SmallImage, other: SmallImage) -> FloatArray:
        """The rotation that shifts the middle of the image as phase correlation says."""
        (u, v), _ = cv2.phaseCorrelate(one, other, self._window)
        turn = Rotation.from_rotvec([-v / self._camera[1], u / self._camera[0], 0.0])
        return np.asarray(turn.as_matrix())


@dataclass(frozen=True, slots=True, eq=False)
class _Aligned:
    """A rotation, and how well it aligns two images.

    Attributes:
        R: (3, 3) other_R_one.
        cost: mean squared difference; infinite with too little overlap.
    """

    R: FloatArray
    cost: float


class _Pair:
    """Two images to be aligned.

    Args:
        one: (h, w) the first one.
        other: (h, w) the second one.
        camera: (4,) fx, fy, cx, cy in pixels of these.
    """

    def __init__(self, one: SmallImage, other: SmallImage, camera: FloatArray) -> None:
        along_u = np.asarray(cv2.Sobel(one, -1, 1, 0, scale=0.125), np.float32)
        along_v = np.asarray(cv2.Sobel(one, -1, 0, 1, scale=0.125), np.float32)
        self._images = one, other, along_u, along_v, camera
        self._least = _LEAST_OVERLAP * one.size / _STRIDE**2

    def at(self, R: FloatArray, steps: int = 0) -> _Aligned:
        """How well a rotation (3, 3) aligns them, after so many Gauss-Newton steps from it."""
        turned = np.array(R, np.float64, order="C")
        squares, count = turn_steps(*self._images, _STRIDE, steps, _SMALLEST_STEP, turned)
        return _Aligned(turned, squares / count if count >= self._least else math.inf)

    def refined(self, found: _Aligned) -> _Aligned:
        """The rotation after Gauss-Newton steps."""
        return self.at(found.R, _STEPS)


def _cost_of(found: _Aligned) -> float:
    return found.cost
