# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Wide-angle camera models with inverses in closed form: the unified model (MEI), double sphere.

Their focal lengths are generalised ones. Where no point in front of the camera goes to a point of
the image plane, the inverse is NaN.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.sensors.camera_model import CameraModel, Coefficients, register_camera_model
from slam_graph.sensors.pinhole_models import RadialTangential

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
