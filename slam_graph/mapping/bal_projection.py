# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The camera of BAL: pixels of points, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.mapping.bal_problem import CAMERA_DIM, BalEstimates, FloatArray, IntArray

NEWTON_STEPS = 10
"""More than enough for the weak distortion that a calibration leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class BalLinearization:
    """N observations, linearised.

    Attributes:
        by_camera: (N, 2, 9) derivatives of the pixels by δθ, δt, f, k1, k2.
        by_point: (N, 2, 3) derivatives by the point.
        r: (N, 2) predicted less measured pixels.
    """

    by_camera: FloatArray
    by_point: FloatArray
    r: FloatArray


def project(
    estimates: BalEstimates, camera: IntArray, point: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Where points are seen.

    Args:
        estimates: cameras and points.
        camera: (N,) indices of cameras.
        point: (N,) indices of points.

    Returns:
        pixels: (N, 2); not finite for a point in the plane of the camera.
        depths: (N,) along the optical axis; negative behind the camera.
    """
    P = _turned(estimates, camera, point) + estimates.translations[camera].T
    f, k1, k2 = estimates.intrinsics[camera].T
    with np.errstate(all="ignore"):
        u, v = -P[:2] / P[2]
        q = u * u + v * v
        scale = f * (1.0 + q * (k1 + q * k2))
        return np.stack([scale * u, scale * v], axis=1), -P[2]


def linearize(
    estimates: BalEstimates, camera: IntArray, point: IntArray, pixels: FloatArray
) -> BalLinearization:
    """Residuals and derivatives of observations; arguments as of `project`, and (N, 2) measured.

    With (u, v) = -P_xy / P_z and the distortion d(q), q = u² + v², the pixel depends on P by

        G = f (d I + 2 d' (u, v)ᵀ (u, v)) · -1/P_z [I (u, v)ᵀ],

    and P = R X + t on δθ by -[R X]ₓ.
    """
    N, y = len(camera), _turned(estimates, camera, point)
    P = y + estimates.translations[camera].T
    f, k1, k2 = estimates.intrinsics[camera].T
    inverse = -1.0 / P[2]
    uv = P[:2] * inverse
    q = uv[0] ** 2 + uv[1] ** 2
    d, twice_slope = 1.0 + q * (k1 + q * k2), 2.0 * (k1 + 2.0 * q * k2)
    along = f * inverse * twice_slope
    R = estimates.rotations[camera].transpose(1, 2, 0)
    by_camera, by_point = np.empty((N, 2, CAMERA_DIM)), np.empty((N, 2, 3))
    for row in range(2):
        g = np.empty((3, N))
        g[:2] = along * uv[row] * uv
        g[row] += f * inverse * d
        g[2] = g[0] * uv[0] + g[1] * uv[1]
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            by_camera[:, row, a] = y[b] * g[c] - y[c] * g[b]
            by_camera[:, row, 3 + a] = g[a]
            by_point[:, row, a] = g[0] * R[0, a] + g[1] * R[1, a] + g[2] * R[2, a]
        by_camera[:, row, 6] = d * uv[row]
        by_camera[:, row, 7] = f * q * uv[row]
        by_camera[:, row, 8] = f * q * q * uv[row]
    return BalLinearization(by_camera, by_point, (f * d * uv).T - pixels)


def rays_of(pixels: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """Where pixels (N, 2) are on the plane at distance 1; (N, 3) intrinsics f, k1, k2.

    The radius ρ of f (1 + k1 ρ² + k2 ρ⁴) ρ is found by Newton's method, from that without
    distortion.
    """
    f, k1, k2 = intrinsics.T
    plain = np.linalg.norm(pixels, axis=1) / f
    radius = plain.copy()
    for _ in range(NEWTON_STEPS):
        q = radius**2
        miss = radius * (1.0 + q * (k1 + q * k2)) - plain
        radius -= miss / (1.0 + q * (3.0 * k1 + q * 5.0 * k2))
    shrunk = np.divide(radius, plain, out=np.ones_like(plain), where=plain > 0)
    return np.asarray(pixels * (shrunk / f)[:, None])


def _turned(estimates: BalEstimates, camera: IntArray, point: IntArray) -> FloatArray:
    """(3, N) R X of each observation."""
    X = estimates.points[point].T
    R = estimates.rotations[camera].transpose(1, 2, 0)
    return np.asarray(R[:, 0] * X[0] + R[:, 1] * X[1] + R[:, 2] * X[2])
