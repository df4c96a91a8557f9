# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The rotation of a camera between two images, by aligning small copies of them as a whole.

Without a gyroscope nothing says where features will be after a fast turn. Small images are blurred
by it as little as they are small, and a rotation moves all of their pixels, near and far. The
rotation that aligns them best is found by Gauss-Newton steps on the differences of grey values
(direct alignment: Lucas & Kanade 1981, in the three parameters of a rotation), from a shift by
phase correlation, from the last rotation or from none, whichever fits best.
"""

from __future__ import annotations

from operator import itemgetter

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.frontend.keypoints import Image
from slam_graph.sensors import Camera

_WIDTH = 80
"""Width of the small images, in pixels."""
_STEPS = 8
_SMALLEST_STEP = 2e-4
"""Steps end below this angle, rad: a tenth of a pixel of a large image."""
_BLUR = 1.0
"""Standard deviation, in small pixels, of the blur that makes alignment smooth."""
_FITTING = 0.2
"""Images fit if they differ by less than this part of their contrast, squared."""
_DAMPING = 1e-6 * np.eye(3)
"""Of the normal equations, grey values squared: images without contrast do not turn."""
_LEAST_OVERLAP = 0.4
"""Part of the image that both must show."""

SmallImage = NDArray[np.float32]
"""As images are aligned: `ImageRotation.reduced`."""


class ImageRotation:
    """Aligns the images of one camera.

    A lens with distortion is taken for a pinhole: what that costs is within the search of tracking.
    """

    def __init__(self, camera: Camera) -> None:
        self._scale = _WIDTH / camera.width
        height = max(1, round(camera.height * self._scale))
        self._size = _WIDTH, height
        s = self._scale
        self._K = np.array(
            [[camera.fx * s, 0, camera.cx * s], [0, camera.fy * s, camera.cy * s], [0, 0, 1]]
        )
        self._K_inverse = np.linalg.inv(self._K)
        v, u = np.mgrid[:height, :_WIDTH]
        x, y = (u - self._K[0, 2]) / self._K[0, 0], (v - self._K[1, 2]) / self._K[1, 1]
        # how a pixel moves with a turn of the camera's points, by its components
        along_u = np.stack([-x * y, 1 + x * x, -y]) * self._K[0, 0]
        along_v = np.stack([-(1 + y * y), x * y, x]) * self._K[1, 1]
        self._along = along_u, along_v
        self._window = cv2.createHanningWindow(self._size, cv2.CV_32F)
        self._last: tuple[Image, SmallImage] | None = None
        self._turn = np.eye(3)

    def between(self, before: Image, after: Image) -> FloatArray:
        """after_R_before (3, 3) of the camera."""
        one = self.reduced(before)
        other = self.reduced(after)
        self._last = after, other
        guesses = [np.eye(3), self._turn, self._by_shift(one, other)]
        costs = [self._cost(one, other, R) for R in guesses]
        enough = _FITTING * float(np.mean(one * one))
        found: list[tuple[float, FloatArray]] = list(zip(costs, guesses, strict=True))
        for k in np.argsort(costs).tolist():
            refined = self._refined(one, other, guesses[k])
            found.append((self._cost(one, other, refined), refined))
            if found[-1][0] < enough:
                break
        self._turn = min(found, key=itemgetter(0))[1]
        return self._turn

    def aligned(self, one: SmallImage, after: Image, guess: FloatArray) -> FloatArray:
        """after_R_before (3, 3) from an earlier reduced image, near a guess."""
        other = self.reduced(after)
        found = self._refined(one, other, guess)
        better = self._cost(one, other, found) < self._cost(one, other, guess)
        return found if better else guess

    def reduced(self, image: Image) -> SmallImage:
        """A small, smooth copy with the mean of its surroundings taken away."""
        if self._last is not None and self._last[0] is image:
            return self._last[1]
        reduced: cv2.typing.MatLike = image
        while reduced.shape[1] >= 4 * _WIDTH:  # halving is ten times as fast as any other factor
            half = reduced.shape[1] // 2, reduced.shape[0] // 2
            reduced = cv2.resize(reduced, half, interpolation=cv2.INTER_AREA)
        reduced = cv2.resize(reduced, self._size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(reduced.astype(np.float32), (0, 0), _BLUR)
        return np.asarray(small - cv2.blur(small, (31, 31)), np.float32)

    def _by_shift(self, one: SmallImage, other: SmallImage) -> FloatArray:
        """The rotation that shifts the middle of the image as phase correlation says."""
        (u, v), _ = cv2.phaseCorrelate(one, other, self._window)
        turn = Rotation.from_rotvec([-v / self._K[1, 1], u / self._K[0, 0], 0.0])
        return np.asarray(turn.as_matrix())

    def _warped(self, other: SmallImage, R: FloatArray) -> tuple[SmallImage, NDArray[np.bool_]]:
        """The second image as the first camera would see it, and where it does."""
        H = self._K @ R @ self._K_inverse
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warped = cv2.warpPerspective(
            other, H, self._size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
        )
        return np.asarray(warped, np.float32), np.isfinite(warped)

    def _cost(self, one: SmallImage, other: SmallImage, R: FloatArray) -> float:
        """Mean squared difference; infinite with too little overlap."""
        warped, inside = self._warped(other, R)
        if np.count_nonzero(inside) < _LEAST_OVERLAP * inside.size:
            return float("inf")
        return float(np.mean((warped[inside] - one[inside]) ** 2))

    def _refined(self, one: SmallImage, other: SmallImage, R: FloatArray) -> FloatArray:
        """The rotation after Gauss-Newton steps."""
        slope_u, slope_v = (
            cv2.Sobel(one, -1, 1, 0, scale=0.125),
            cv2.Sobel(one, -1, 0, 1, scale=0.125),
        )
        J = slope_u * self._along[0] + slope_v * self._along[1]
        for _ in range(_STEPS):
            warped, inside = self._warped(other, R)
            seen = (J * inside).reshape(3, -1)
            difference = np.where(inside, warped - one, 0.0).ravel()
            # the first image turned by a small angle has the slopes of itself
            step = np.linalg.solve(seen @ seen.T + _DAMPING, seen @ difference)
            R = R @ Rotation.from_rotvec(-step).as_matrix()
            if np.linalg.norm(step) < _SMALLEST_STEP:
                break
        return R
