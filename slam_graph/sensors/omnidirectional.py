# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Wide-angle camera models on the plane z = 1: unified (MEI) and double sphere, with inverses.

A point m = (x/z, y/z) in front of the camera goes to a point q on the model's image plane, which
distortion and focal lengths turn into a pixel. The inverses are in closed form; where no point in
front of the camera goes to q, they give NaN.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray


def unified(m: FloatArray, xi: float) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) of the unified model, and their derivative (N, 2, 2) by m (N, 2).

    The point goes to the unit sphere, and is seen from ξ behind its centre: q = m / (1 + ξ ρ) with
    ρ = √(1 + |m|²). Mei and Rives, "Single View Point Omnidirectional Camera Calibration from
    Planar Grids", ICRA 2007.
    """
    rho = np.sqrt(1.0 + np.sum(m * m, axis=1))
    depth = 1.0 + xi * rho
    return _divide(m, depth, xi / rho)


def unified_by_parameters(m: FloatArray, xi: float) -> FloatArray:
    """Derivatives (N, 2, 1) of the points of the unified model by ξ."""
    rho = np.sqrt(1.0 + np.sum(m * m, axis=1))
    by_xi: FloatArray = -(rho / (1.0 + xi * rho) ** 2)[:, None] * m
    return by_xi[:, :, None]


def unified_inverse(q: FloatArray, xi: float) -> FloatArray:
    """Points m (N, 2) of the plane z = 1 that the unified model takes to q (N, 2)."""
    s = np.sum(q * q, axis=1)
    root = _root(1.0 + (1.0 - xi * xi) * s)
    scale = (xi + root) / (1.0 + s)
    return _to_plane(q * scale[:, None], scale - xi)


def double_sphere(m: FloatArray, xi: float, alpha: float) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) of the double sphere model, and their derivative (N, 2, 2) by m (N, 2).

    Usenko, Demmel and Cremers, "The Double Sphere Camera Model", 3DV 2018, eq. (40) to (42), with
    z = 1.
    """
    rho, shifted, second = _distances(m, xi)
    depth = alpha * second + (1.0 - alpha) * shifted
    slope = alpha * (1.0 + shifted * xi / rho) / second + (1.0 - alpha) * xi / rho
    return _divide(m, depth, slope)


def double_sphere_by_parameters(m: FloatArray, xi: float, alpha: float) -> FloatArray:
    """Derivatives (N, 2, 2) of the points of the double sphere model by ξ and α."""
    rho, shifted, second = _distances(m, xi)
    depth = alpha * second + (1.0 - alpha) * shifted
    by_xi = alpha * shifted * rho / second + (1.0 - alpha) * rho
    depth_by_parameters = np.stack([by_xi, second - shifted], axis=1)
    scale = depth_by_parameters / (depth * depth)[:, None]
    return np.asarray(-m[:, :, None] * scale[:, None, :], dtype=np.float64)


def double_sphere_inverse(q: FloatArray, xi: float, alpha: float) -> FloatArray:
    """Points m (N, 2) of the plane z = 1 that the double sphere model takes to q (N, 2).

    Usenko et al. 2018, eq. (46) to (50).
    """
    s = np.sum(q * q, axis=1)
    root = _root(1.0 - (2.0 * alpha - 1.0) * s)
    z = (1.0 - alpha * alpha * s) / (alpha * root + 1.0 - alpha)
    scale = (z * xi + _root(z * z + (1.0 - xi * xi) * s)) / (z * z + s)
    return _to_plane(q * scale[:, None], scale * z - xi)


def _distances(m: FloatArray, xi: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances of points (m, 1) from the first centre; z and distances from the second one."""
    r2 = np.sum(m * m, axis=1)
    rho = np.sqrt(1.0 + r2)
    shifted = 1.0 + xi * rho
    return rho, shifted, np.sqrt(r2 + shifted * shifted)


def _divide(m: FloatArray, depth: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
    """M / depth, and its derivative, where d depth / d m = slope · m."""
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
