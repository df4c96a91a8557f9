# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Camera models: a pinhole with radial-tangential or fisheye distortion, and omnidirectional ones.

A camera maps a point p = (x, y, z) of its frame (z forward) to a pixel in two steps: the
normalised point m = (x/z, y/z), and the pixel u = K d(m) with the distortion d. All functions take
and return arrays of N points and are vectorised over them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.sensors.omnidirectional import (
    double_sphere,
    double_sphere_by_parameters,
    double_sphere_inverse,
    unified,
    unified_by_parameters,
    unified_inverse,
)

Distortion = Literal["none", "radtan", "equidistant", "mei", "double_sphere"]

COEFFICIENTS: dict[Distortion, int] = {
    "none": 0,
    "radtan": 4,
    "equidistant": 4,
    "mei": 5,
    "double_sphere": 2,
}
"""How many coefficients each distortion model has: (k1, k2, p1, p2), (k1, k2, k3, k4),
(ξ, k1, k2, p1, p2) and (ξ, α)."""

WIDE: tuple[Distortion, ...] = ("equidistant", "mei", "double_sphere")
"""Models of lenses that may see sideways and backwards."""

WIDEST = 6.0
"""Longest normalised point: 80° off the axis. What a lens sees beyond is left out, because it has
no place on the plane z = 1 (or one too far away to calculate with)."""

SEEN_TOLERANCE_PX = 1e-3

UNDISTORT_ITERATIONS = 20
UNDISTORT_EPSILON = 1e-10


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Attributes:
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels; pixel (0, 0) is the centre of the top left pixel.
        distortion: name of the distortion model. `radtan` is Brown's radial-tangential model
            (OpenCV's, with k1, k2, p1, p2); `equidistant` is Kannala and Brandt's (OpenCV's
            fisheye, with k1..k4); `mei` is the unified model of Mei and Rives with
            radial-tangential distortion (Kalibr's omni); `double_sphere` that of Usenko et al.
            (Kalibr's ds). For the last two fx and fy are the generalised focal lengths.
        coefficients: of the distortion model.
        width, height: size of the image in pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion
    coefficients: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.distortion not in COEFFICIENTS:
            raise DataError(
                f"unknown distortion model '{self.distortion}'; known: {', '.join(COEFFICIENTS)}"
            )
        if len(self.coefficients) != COEFFICIENTS[self.distortion]:
            raise DataError(
                f"distortion '{self.distortion}' has {COEFFICIENTS[self.distortion]} coefficients, "
                f"got {len(self.coefficients)}"
            )
        if not (self.fx > 0 and self.fy > 0):
            raise DataError(f"focal lengths must be positive, got ({self.fx}, {self.fy})")

    @property
    def K(self) -> FloatArray:
        """The (3, 3) calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> FloatArray:
        """(fx, fy, cx, cy) in pixels."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def distort(self, normalized: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels of normalised points, and the derivative.

        Args:
            normalized: (N, 2) points on the plane z = 1.

        Returns:
            pixels: (N, 2).
            jacobian: (N, 2, 2), d pixel / d normalized.
        """
        if self.distortion == "radtan":
            bent, jacobian = _radtan(normalized, *self.coefficients)
        elif self.distortion == "equidistant":
            bent, jacobian = _equidistant(normalized, np.array(self.coefficients))
        elif self.distortion == "mei":
            on_plane, lifted = unified(normalized, self.coefficients[0])
            bent, bend = _radtan(on_plane, *self.coefficients[1:])
            jacobian = bend @ lifted
        elif self.distortion == "double_sphere":
            bent, jacobian = double_sphere(normalized, *self.coefficients)
        else:
            bent, jacobian = normalized, np.broadcast_to(np.eye(2), (len(normalized), 2, 2))
        focal = np.array([self.fx, self.fy])
        return bent * focal + (self.cx, self.cy), jacobian * focal[:, None]

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (N, 2) of points (N, 3) in the camera frame; the points must have z > 0."""
        return self.distort(points[:, :2] / points[:, 2:3])[0]

    def by_intrinsics(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (N, 2, 4) of the pixels of normalised points by (fx, fy, cx, cy)."""
        bent = (self.distort(normalized)[0] - (self.cx, self.cy)) / (self.fx, self.fy)
        derivative = np.zeros((len(normalized), 2, 4))
        derivative[:, 0, 0], derivative[:, 1, 1] = bent[:, 0], bent[:, 1]
        derivative[:, 0, 2] = derivative[:, 1, 3] = 1.0
        return derivative

    def by_coefficients(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (N, 2, n) of the pixels of normalised points by the distortion's."""
        if self.distortion == "radtan":
            bent = _radtan_by_coefficients(normalized)
        elif self.distortion == "equidistant":
            r = np.hypot(normalized[:, 0], normalized[:, 1])
            powers = np.arctan(r)[:, None] ** np.array([3, 5, 7, 9]) / np.maximum(r, 1e-9)[:, None]
            bent = normalized[:, :, None] * powers[:, None, :]
        elif self.distortion == "mei":
            on_plane, _ = unified(normalized, self.coefficients[0])
            bend = _radtan(on_plane, *self.coefficients[1:])[1]
            first = bend @ unified_by_parameters(normalized, self.coefficients[0])
            bent = np.concatenate([first, _radtan_by_coefficients(on_plane)], axis=2)
        elif self.distortion == "double_sphere":
            bent = double_sphere_by_parameters(normalized, *self.coefficients)
        else:
            bent = np.zeros((len(normalized), 2, 0))
        return np.asarray(bent * np.array([[self.fx], [self.fy]]), dtype=np.float64)

    def undistort(self, pixels: FloatArray, near: FloatArray | None = None) -> FloatArray:
        """Normalised coordinates (N, 2) of pixels (N, 2): the inverse of `distort`.

        Pixels that see nothing in front of the camera get NaN or any other point; see `visible`.

        Args:
            pixels: (N, 2).
            near: (N, 2) a guess of the result, where there is one; it saves time.
        """
        if len(pixels) == 0:
            return np.zeros((0, 2))
        plain = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.distortion == "none":
            return plain
        if self.distortion == "mei":
            bend = Camera(1.0, 1.0, 0.0, 0.0, "radtan", self.coefficients[1:], 1, 1)
            return unified_inverse(bend.undistort(plain), self.coefficients[0])
        if self.distortion == "double_sphere":
            return double_sphere_inverse(plain, *self.coefficients)
        return self._newton(plain, self._fixed_point(plain) if near is None else near)

    def visible(
        self, pixels: FloatArray, reach: float = WIDEST
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Normalised coordinates of pixels (N, 2), and which of them have any.

        Args:
            pixels: (N, 2).
            reach: longest normalised point that counts, the tangent of the angle to the axis.

        Returns:
            normalized: (N, 2); zero where there is none.
            usable: (N,) whether the pixel sees points so near to the axis.
        """
        with np.errstate(all="ignore"):
            plane = self.undistort(pixels)
            usable = np.linalg.norm(plane, axis=1) < reach
            plane = np.where(usable[:, None], plane, 0.0)
            error_px = np.linalg.norm(self.distort(plane)[0] - pixels, axis=1)
        return plane, usable & (error_px < SEEN_TOLERANCE_PX)

    def visible_mask(self, reach: float = WIDEST) -> NDArray[np.bool_]:
        """Which pixels (height, width) see points with normalised coordinates up to `reach`."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        return self.visible(pixels, reach)[1].reshape(self.height, self.width)

    def _fixed_point(self, bent: FloatArray) -> FloatArray:
        """OpenCV's solution, from which Newton's method converges."""
        source = np.ascontiguousarray(bent[:, None, :])
        coefficients = np.array(self.coefficients)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, UNDISTORT_ITERATIONS, 1e-9)
        if self.distortion == "radtan":
            eye = np.eye(3)
            start = cv2.undistortPointsIter(source, eye, coefficients, eye, eye, criteria)
        else:
            start = cv2.fisheye.undistortPoints(source, np.eye(3), coefficients, criteria=criteria)
        return np.asarray(start, dtype=np.float64)[:, 0, :]

    def _newton(self, bent: FloatArray, m: FloatArray) -> FloatArray:
        """Newton's method on `distort` from a start m (N, 2)."""
        coefficients = np.array(self.coefficients)
        forward = _radtan if self.distortion == "radtan" else None
        for _ in range(3):
            if forward is not None:
                value, jacobian = forward(m, *self.coefficients)
            else:
                value, jacobian = _equidistant(m, coefficients)
            m = m + _solve_2x2(jacobian, bent - value)
            if np.max(np.abs(bent - value), initial=0.0) < UNDISTORT_EPSILON:
                break
        return m


def _solve_2x2(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solutions x (N, 2) of A x = b for A (N, 2, 2), b (N, 2)."""
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    x = (A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1]) / determinant
    y = (A[:, 0, 0] * b[:, 1] - A[:, 1, 0] * b[:, 0]) / determinant
    return np.stack([x, y], axis=1)


def _radtan(
    m: FloatArray, k1: float, k2: float, p1: float, p2: float
) -> tuple[FloatArray, FloatArray]:
    """Brown's model: distorted points (N, 2) and their derivative (N, 2, 2)."""
    x, y = m[:, 0], m[:, 1]
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + k2 * r2)
    slope = 2.0 * k1 + 4.0 * k2 * r2  # d radial / d x = slope * x
    bent = np.empty_like(m)
    bent[:, 0] = x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)
    bent[:, 1] = y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
    jacobian = np.empty((len(m), 2, 2))
    jacobian[:, 0, 0] = radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x
    jacobian[:, 0, 1] = slope * xy + 2.0 * p1 * x + 2.0 * p2 * y
    jacobian[:, 1, 0] = jacobian[:, 0, 1]
    jacobian[:, 1, 1] = radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x
    return bent, jacobian


def _radtan_by_coefficients(m: FloatArray) -> FloatArray:
    """Derivatives (N, 2, 4) of Brown's model by k1, k2, p1, p2."""
    x, y = m[:, 0], m[:, 1]
    r2, xy = x * x + y * y, 2.0 * x * y
    columns_x = [x * r2, x * r2 * r2, xy, r2 + 2.0 * x * x]
    columns_y = [y * r2, y * r2 * r2, r2 + 2.0 * y * y, xy]
    return np.stack([np.stack(columns_x, axis=1), np.stack(columns_y, axis=1)], axis=1)


def _equidistant(m: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Kannala and Brandt's model: distorted points (N, 2) and their derivative (N, 2, 2)."""
    r = np.hypot(m[:, 0], m[:, 1])
    safe = np.maximum(r, 1e-9)
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    theta_d_slope = 1.0 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
    scale = np.where(r > 1e-9, theta_d / safe, 1.0)
    # d(scale)/dr / r, with d(theta_d)/dr = slope / (1 + r²); zero at the centre
    radial = np.where(r > 1e-6, (theta_d_slope / (1.0 + r * r) - scale) / (safe * safe), 0.0)
    jacobian = scale[:, None, None] * np.eye(2) + radial[:, None, None] * (
        m[:, :, None] * m[:, None, :]
    )
    return m * scale[:, None], jacobian
