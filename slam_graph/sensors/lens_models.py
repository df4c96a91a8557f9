# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The camera models: pinhole with radial-tangential or equidistant lens, MEI, double sphere.

Wide-angle camera models with inverses in closed form: the unified model (MEI), double sphere. Their
focal lengths are generalised ones. Where no point in front of the camera goes to a point of the
image plane, the inverse is NaN.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import lru_cache
from typing import Any, ClassVar

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.sensors.camera_model import (
    NEWTON_TOLERANCE,
    CameraModel,
    Coefficients,
    register_camera_model,
)

_ROUGH_ITERATIONS = 20
_ROUGH_EPSILON = 1e-9
_STEPS_FROM_OPENCV = 3
"""OpenCV's solution is accurate to some 1e-5; Newton's method doubles the digits in a step."""


@register_camera_model
class Pinhole(CameraModel):
    """No distortion: q = m."""

    name = "none"
    coefficient_names = ()

    def distort(self, m: FloatArray, coefficients: Coefficients) -> tuple[FloatArray, FloatArray]:
        """The points themselves, and identities."""
        return m, np.broadcast_to(np.eye(2), (len(m), 2, 2))

    def by_coefficients(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Empty derivatives (N, 2, 0)."""
        return np.zeros((len(m), 2, 0))

    def undistort(
        self, q: FloatArray, coefficients: Coefficients, near: FloatArray | None = None
    ) -> FloatArray:
        """The points themselves."""
        return q

    def gtsam_calibration(self, intrinsics: FloatArray, coefficients: Coefficients) -> Any:
        """A `gtsam.Cal3_S2`."""
        fx, fy, cx, cy = intrinsics
        return gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)


class _SolvedInTwoSteps(CameraModel):
    """A model that is inverted as OpenCV does it, roughly; Newton's method does the rest."""

    _steps: ClassVar[int] = _STEPS_FROM_OPENCV

    def undistort(
        self, q: FloatArray, coefficients: Coefficients, near: FloatArray | None = None
    ) -> FloatArray:
        """Newton's method from a guess, or from the solution of a slower method."""
        if near is None:
            own = np.array(coefficients, np.float64)
            near = self._approached(np.ascontiguousarray(q, np.float64), own)
        return self._newton(q, coefficients, near, self._steps)

    @abstractmethod
    def _approached(self, q: FloatArray, coefficients: FloatArray) -> FloatArray:
        """OpenCV's solution (N, 2) for points (N, 2)."""


_CRITERIA = (
    cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS,
    _ROUGH_ITERATIONS,
    _ROUGH_EPSILON,
)


@lru_cache
def _row(coefficients: Coefficients) -> FloatArray:
    """Coefficients as kernels take them; an array made anew in each call is most of its time."""
    return np.array(coefficients, np.float64)


@register_camera_model
class RadialTangential(_SolvedInTwoSteps):
    """Brown's model, as OpenCV has it with four coefficients.

    Brown, "Decentering Distortion of Lenses", Photogrammetric Engineering 1966.
    """

    name = "radtan"
    coefficient_names = ("k1", "k2", "p1", "p2")
    distortion_names = ("radtan", "radial-tangential")
    ros_names = ("plumb_bob", "rational_polynomial")

    def distort(self, m: FloatArray, coefficients: Coefficients) -> tuple[FloatArray, FloatArray]:
        """Points q (N, 2) of normalised points m (N, 2), and the derivatives dq/dm (N, 2, 2)."""
        k1, k2, p1, p2 = coefficients
        x, y = m[:, 0], m[:, 1]
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + k2 * r2)
        slope = 2.0 * k1 + 4.0 * k2 * r2  # d radial / d x = slope * x
        q = self.points(m, coefficients)
        jacobian = np.empty((len(m), 2, 2))
        jacobian[:, 0, 0] = radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x
        jacobian[:, 0, 1] = slope * xy + 2.0 * p1 * x + 2.0 * p2 * y
        jacobian[:, 1, 0] = jacobian[:, 0, 1]
        jacobian[:, 1, 1] = radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x
        return q, jacobian

    def points(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Points q (N, 2) of normalised points m (N, 2)."""
        k1, k2, p1, p2 = coefficients
        x, y = m[:, 0], m[:, 1]
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + k2 * r2)
        q = np.empty_like(m)
        q[:, 0] = x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)
        q[:, 1] = y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
        return q

    def by_coefficients(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Derivatives (N, 2, 4) of q by k1, k2, p1, p2."""
        x, y = m[:, 0], m[:, 1]
        r2, xy = x * x + y * y, 2.0 * x * y
        columns_x = [x * r2, x * r2 * r2, xy, r2 + 2.0 * x * x]
        columns_y = [y * r2, y * r2 * r2, r2 + 2.0 * y * y, xy]
        return np.stack([np.stack(columns_x, axis=1), np.stack(columns_y, axis=1)], axis=1)

    def gtsam_calibration(self, intrinsics: FloatArray, coefficients: Coefficients) -> Any:
        """A `gtsam.Cal3DS2`."""
        fx, fy, cx, cy = intrinsics
        return gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, *coefficients)

    def undistort(
        self, q: FloatArray, coefficients: Coefficients, near: FloatArray | None = None
    ) -> FloatArray:
        """Both steps in one kernel, unless there is a guess, or the kernel gives up on a point."""
        if near is not None:
            return super().undistort(q, coefficients, near)
        from slam_graph.kernels.undistortion import invert_radtan  # which loads kernels

        rough, fine = (_ROUGH_ITERATIONS, _ROUGH_EPSILON), (self._steps, NEWTON_TOLERANCE)
        places = np.ascontiguousarray(q, np.float64)
        m, given_up = invert_radtan(places, _row(coefficients), *rough, *fine)
        return super().undistort(q, coefficients) if given_up else m

    def _approached(self, q: FloatArray, coefficients: FloatArray) -> FloatArray:
        """What `cv2.undistortPointsIter` finds; it is asked for where a kernel gives up."""
        from slam_graph.kernels.undistortion import approach_radtan  # which loads kernels

        m = approach_radtan(q, coefficients, _ROUGH_ITERATIONS, _ROUGH_EPSILON)
        left = np.isnan(m[:, 0])
        if left.any():
            points, eye = q[left][:, None, :], np.eye(3)
            found = cv2.undistortPointsIter(points, eye, coefficients, eye, eye, _CRITERIA)
            m[left] = np.asarray(found, np.float64)[:, 0, :]
        return m

    def _newton(
        self, q: FloatArray, coefficients: Coefficients, m: FloatArray, steps: int
    ) -> FloatArray:
        """Newton's method for each point by itself, in a kernel."""
        from slam_graph.kernels.undistortion import undistort_radtan  # which loads kernels

        places, start = np.ascontiguousarray(q), np.ascontiguousarray(m)
        own = np.array(coefficients, np.float64)
        return undistort_radtan(places, start, own, steps, NEWTON_TOLERANCE)


@register_camera_model
class Equidistant(_SolvedInTwoSteps):
    """Kannala and Brandt's model of a fisheye lens, as OpenCV has it.

    A ray at the angle θ to the axis meets the image plane at the radius
    θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸). Kannala and Brandt, "A Generic Camera Model and
    Calibration Method for Conventional, Wide-Angle, and Fish-Eye Lenses", PAMI 2006.
    """

    name = "equidistant"
    coefficient_names = ("k1", "k2", "k3", "k4")
    _steps = (
        10  # OpenCV's solution is far off where the polynomial is nearly flat, 80° off the axis
    )
    sees_sideways = True
    ros_names = ("equidistant", "fisheye")

    def distort(self, m: FloatArray, coefficients: Coefficients) -> tuple[FloatArray, FloatArray]:
        """Points q (N, 2) of normalised points m (N, 2), and the derivatives dq/dm (N, 2, 2)."""
        k1, k2, k3, k4 = coefficients
        r = np.hypot(m[:, 0], m[:, 1])
        safe = np.maximum(r, 1e-9)
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        theta_d_slope = 1.0 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        scale = np.where(r > 1e-9, theta_d / safe, 1.0)
        # d(scale)/dr / r, with d(theta_d)/dr = slope / (1 + r²); zero at the centre
        radial = np.where(r > 1e-6, (theta_d_slope / (1.0 + r * r) - scale) / (safe * safe), 0.0)
        jacobian = scale[:, None, None] * np.eye(2) + radial[:, None, None] * (
            m[:, :, None] * m[:, None, :]
        )
        return m * scale[:, None], jacobian

    def by_coefficients(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Derivatives (N, 2, 4) of q by k1 to k4."""
        r = np.hypot(m[:, 0], m[:, 1])
        powers = np.arctan(r)[:, None] ** np.array([3, 5, 7, 9]) / np.maximum(r, 1e-9)[:, None]
        by_coefficients: FloatArray = m[:, :, None] * powers[:, None, :]
        return by_coefficients

    def gtsam_calibration(self, intrinsics: FloatArray, coefficients: Coefficients) -> Any:
        """A `gtsam.Cal3Fisheye`."""
        fx, fy, cx, cy = intrinsics
        return gtsam.Cal3Fisheye(fx, fy, 0.0, cx, cy, *coefficients)

    def _approached(self, q: FloatArray, coefficients: FloatArray) -> FloatArray:
        rough = cv2.fisheye.undistortPoints(
            q[:, None, :], np.eye(3), coefficients, criteria=_CRITERIA
        )
        return np.asarray(rough, np.float64)[:, 0, :]


_RADTAN = RadialTangential()


@register_camera_model
class Unified(CameraModel):
    """The unified model with radial-tangential distortion (Kalibr's omni).

    The point goes to the unit sphere, and is seen from ξ behind its centre: m / (1 + ξ ρ) with
    ρ = √(1 + |m|²), which is then distorted. Mei and Rives, "Single View Point Omnidirectional
    Camera Calibration from Planar Grids", ICRA 2007.
    """

    name = "mei"
    coefficient_names = ("xi", "k1", "k2", "p1", "p2")
    sees_sideways = True
    kalibr_camera = "omni"
    distortion_names = RadialTangential.distortion_names
    leading = 1

    def distort(self, m: FloatArray, coefficients: Coefficients) -> tuple[FloatArray, FloatArray]:
        """Points q (N, 2) of normalised points m (N, 2), and the derivatives dq/dm (N, 2, 2)."""
        xi, *bend = coefficients
        on_plane, by_m = _lifted(m, xi)
        q, by_plane = _RADTAN.distort(on_plane, tuple(bend))
        return q, by_plane @ by_m

    def by_coefficients(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Derivatives (N, 2, 5) of q by ξ, k1, k2, p1, p2."""
        xi, *bend = coefficients
        on_plane, _ = _lifted(m, xi)
        by_plane = _RADTAN.distort(on_plane, tuple(bend))[1]
        rho = np.sqrt(1.0 + np.sum(m * m, axis=1))
        by_xi: FloatArray = -(rho / (1.0 + xi * rho) ** 2)[:, None] * m
        by_bend = _RADTAN.by_coefficients(on_plane, tuple(bend))
        return np.concatenate([by_plane @ by_xi[:, :, None], by_bend], axis=2)

    def undistort(
        self, q: FloatArray, coefficients: Coefficients, near: FloatArray | None = None
    ) -> FloatArray:
        """Normalised points m (N, 2) of points q (N, 2)."""
        xi, *bend = coefficients
        on_plane = _RADTAN.undistort(q, tuple(bend))
        s = np.sum(on_plane * on_plane, axis=1)
        root = _root(1.0 + (1.0 - xi * xi) * s)
        scale = (xi + root) / (1.0 + s)
        return _to_plane(on_plane * scale[:, None], scale - xi)

    def gtsam_calibration(self, intrinsics: FloatArray, coefficients: Coefficients) -> Any:
        """A `gtsam.Cal3Unified`."""
        fx, fy, cx, cy = intrinsics
        xi, k1, k2, p1, p2 = coefficients
        return gtsam.Cal3Unified(fx, fy, 0.0, cx, cy, k1, k2, p1, p2, xi)


@register_camera_model
class DoubleSphere(CameraModel):
    """The double sphere model (Kalibr's ds).

    Usenko, Demmel and Cremers, "The Double Sphere Camera Model", 3DV 2018.
    """

    name = "double_sphere"
    coefficient_names = ("xi", "alpha")
    ranges = {"alpha": (0.0, 1.0)}  # noqa: RUF012
    sees_sideways = True
    kalibr_camera = "ds"
    distortion_names = ("none",)
    leading = 2

    def distort(self, m: FloatArray, coefficients: Coefficients) -> tuple[FloatArray, FloatArray]:
        """Points q (N, 2) and derivatives dq/dm (N, 2, 2); eq. (40) to (42), with z = 1."""
        xi, alpha = coefficients
        rho, shifted, second = _distances(m, xi)
        depth = alpha * second + (1.0 - alpha) * shifted
        slope = alpha * (1.0 + shifted * xi / rho) / second + (1.0 - alpha) * xi / rho
        return _divide(m, depth, slope)

    def by_coefficients(self, m: FloatArray, coefficients: Coefficients) -> FloatArray:
        """Derivatives (N, 2, 2) of q by ξ and α."""
        xi, alpha = coefficients
        rho, shifted, second = _distances(m, xi)
        depth = alpha * second + (1.0 - alpha) * shifted
        by_xi = alpha * shifted * rho / second + (1.0 - alpha) * rho
        depth_by_coefficients = np.stack([by_xi, second - shifted], axis=1)
        scale = depth_by_coefficients / (depth * depth)[:, None]
        return np.asarray(-m[:, :, None] * scale[:, None, :], dtype=np.float64)

    def undistort(
        self, q: FloatArray, coefficients: Coefficients, near: FloatArray | None = None
    ) -> FloatArray:
        """Normalised points m (N, 2) of points q (N, 2); eq. (46) to (50)."""
        xi, alpha = coefficients
        s = np.sum(q * q, axis=1)
        root = _root(1.0 - (2.0 * alpha - 1.0) * s)
        z = (1.0 - alpha * alpha * s) / (alpha * root + 1.0 - alpha)
        scale = (z * xi + _root(z * z + (1.0 - xi * xi) * s)) / (z * z + s)
        return _to_plane(q * scale[:, None], scale * z - xi)


def _lifted(m: FloatArray, xi: float) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) of the unified model before its distortion, and their derivatives by m."""
    rho = np.sqrt(1.0 + np.sum(m * m, axis=1))
    return _divide(m, 1.0 + xi * rho, xi / rho)


def _distances(m: FloatArray, xi: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances of points (m, 1) from the first centre; z and distances from the second one."""
    r2 = np.sum(m * m, axis=1)
    rho = np.sqrt(1.0 + r2)
    shifted = 1.0 + xi * rho
    return rho, shifted, np.sqrt(r2 + shifted * shifted)


def _divide(m: FloatArray, depth: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The points m / depth, and their derivatives, where d depth / d m = slope · m."""
    q = m / depth[:, None]
    jacobian = np.eye(2) / depth[:, None, None] - (slope / depth)[:, None, None] * (
        q[:, :, None] * m[:, None, :]
    )
    return q, jacobian


def _root(values: FloatArray) -> FloatArray:
    """Square roots, NaN without a warning where there is none."""
    return np.sqrt(np.where(values >= 0.0, values, np.nan))


def _to_plane(xy: FloatArray, z: FloatArray) -> FloatArray:
    """Points (N, 2) where rays (x, y, z) meet the plane z = 1; NaN for those that never do."""
    return np.asarray(xy / np.where(z > 0.0, z, np.nan)[:, None], dtype=np.float64)
