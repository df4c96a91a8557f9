# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A calibrated camera: focal lengths, principal point, and the coefficients of a camera model.

All functions take and return arrays of N points and are vectorised over them. Derivatives are those
of pixels. What a model is, and how to add one, is in `camera_model`; the models are in
`lens_models`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.errors import DataError
from slam_graph.sensors.camera_model import MAX_TANGENT, CameraModel, camera_model

_VISIBLE_TOLERANCE_PX = 1e-3
"""A pixel is visible if its normalised point is projected back to it within this distance."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Attributes:
        fx, fy: focal lengths in pixels; the generalised ones of `mei` and `double_sphere`.
        cx, cy: principal point in pixels; pixel (0, 0) is the centre of the top left pixel.
        distortion: name of the camera model in `CAMERA_MODELS`: `none`; `radtan`, Brown's
            radial-tangential model (OpenCV's, with k1, k2, p1, p2); `equidistant`, Kannala and
            Brandt's fisheye (OpenCV's, with k1 to k4); `mei`, the unified model of Mei and Rives
            (Kalibr's omni, with ξ, k1, k2, p1, p2); `double_sphere` of Usenko et al. (Kalibr's ds,
            with ξ and α); or one that a plugin brings.
        coefficients: of the model.
        width, height: size of the image in pixels.

    Raises:
        DataError: if the model is unknown, the number of coefficients is not the model's, or a
            focal length is not positive.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: str
    coefficients: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", tuple(self.coefficients))  # a list may be given
        count = len(self.model.coefficient_names)
        if len(self.coefficients) != count:
            raise DataError(
                f"distortion '{self.distortion}' has {count} coefficients, "
                f"got {len(self.coefficients)}"
            )
        if not (self.fx > 0 and self.fy > 0):
            raise DataError(f"focal lengths must be positive, got ({self.fx}, {self.fy})")

    @cached_property
    def model(self) -> CameraModel:
        """The camera model."""
        return camera_model(self.distortion)

    @property
    def K(self) -> FloatArray:
        """The (3, 3) calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> FloatArray:
        """(fx, fy, cx, cy) in pixels."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @cached_property
    def _focal(self) -> FloatArray:
        """(fx, fy) in pixels."""
        return np.array([self.fx, self.fy])

    @cached_property
    def _center(self) -> FloatArray:
        """(cx, cy) in pixels."""
        return np.array([self.cx, self.cy])

    @cached_property
    def max_tangent(self) -> float:
        """Length of the longest normalised point in the model's valid field of view."""
        return self.model.max_tangent(self.coefficients)

    def gtsam_calibration(self) -> Any | None:
        """GTSAM's calibration object, such as `gtsam.Cal3DS2`; None if GTSAM has no such model."""
        return self.model.gtsam_calibration(self.intrinsics, self.coefficients)

    def distort(self, normalized: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels of normalised points, and the derivative.

        Args:
            normalized: (N, 2) points on the plane z = 1.

        Returns:
            pixels: (N, 2).
            jacobian: (N, 2, 2), d pixel / d normalized.
        """
        q, jacobian = self.model.distort(normalized, self.coefficients)
        return q * self._focal + self._center, jacobian * self._focal[:, None]

    def pixels(self, normalized: FloatArray) -> FloatArray:
        """Pixels (N, 2) of normalised points (N, 2), in less time than with the derivative."""
        pixels = self.model.points(normalized, self.coefficients) * self._focal
        pixels += self._center
        return pixels

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (N, 2) of points (N, 3) in the camera frame; the points must have z > 0."""
        return self.pixels(points[:, :2] / points[:, 2:3])

    def by_intrinsics(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (N, 2, 4) of the pixels of normalised points by (fx, fy, cx, cy)."""
        q = self.model.points(normalized, self.coefficients)
        derivative = np.zeros((len(normalized), 2, 4))
        derivative[:, 0, 0], derivative[:, 1, 1] = q[:, 0], q[:, 1]
        derivative[:, 0, 2] = derivative[:, 1, 3] = 1.0
        return derivative

    def by_coefficients(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (N, 2, n) of the pixels of normalised points by the n coefficients."""
        by_coefficients = self.model.by_coefficients(normalized, self.coefficients)
        return np.asarray(by_coefficients * np.array([[self.fx], [self.fy]]), dtype=np.float64)

    def undistort(self, pixels: FloatArray, near: FloatArray | None = None) -> FloatArray:
        """Normalised coordinates (N, 2) of pixels (N, 2): the inverse of `distort`.

        Pixels that see nothing in front of the camera get NaN or any other point; see `visible`.

        Args:
            pixels: (N, 2).
            near: (N, 2) a guess of the result, where there is one; it saves time.
        """
        if len(pixels) == 0:
            return np.zeros((0, 2))
        q = pixels - self._center
        q /= self._focal
        points = self.model.undistort(q, self.coefficients, near)
        return np.ascontiguousarray(points, np.float64)  # as kernels want it, whatever the model

    def within_reach(self, normalized: FloatArray, max_coordinate: float) -> BoolArray:
        """Which normalised points (N, 2) are so near to the axis that the model holds.

        Args:
            normalized: (N, 2).
            max_coordinate: limit of both coordinates for a narrow lens. A wide lens has its own
                limit, of the length: a polynomial that folds back beyond it leads into the image
                again.
        """
        if self.model.sees_sideways:
            return np.asarray(np.linalg.norm(normalized, axis=1) < self.max_tangent)
        near = np.abs(normalized) < max_coordinate
        return np.asarray(near[:, 0] & near[:, 1])

    def visible(
        self, pixels: FloatArray, max_tangent: float = MAX_TANGENT
    ) -> tuple[FloatArray, BoolArray]:
        """Normalised coordinates of pixels (N, 2), and which of them have any.

        Args:
            pixels: (N, 2).
            max_tangent: length of the longest normalised point that counts, the tangent of the
                angle to the axis; never more than the model's valid field of view.

        Returns:
            normalized: (N, 2); zero where there is none.
            usable: (N,) whether the pixel sees points so near to the axis.
        """
        with np.errstate(all="ignore"):
            plane = self.undistort(pixels)
            usable = _lengths(plane) < min(max_tangent, self.max_tangent)
            plane = np.where(usable[:, None], plane, 0.0)
            error_px = _lengths(self.pixels(plane) - pixels)
        return plane, usable & (error_px < _VISIBLE_TOLERANCE_PX)

    def visible_mask(self, max_tangent: float = MAX_TANGENT) -> BoolArray:
        """Which pixels (height, width) see points with normalised coordinates so short."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        return self.visible(pixels, max_tangent)[1].reshape(self.height, self.width)


def _lengths(vectors: FloatArray) -> FloatArray:
    """(N,) lengths of vectors (N, 2); `np.linalg.norm` takes many times as long."""
    x, y = vectors[:, 0], vectors[:, 1]
    return np.asarray(np.sqrt(x * x + y * y))
