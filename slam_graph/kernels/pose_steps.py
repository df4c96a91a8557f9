# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton steps of the pose of a camera by points that it sees, from a pose nearby."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["pose_steps", "pose_steps_numpy"]

_DAMPING = 1e-9
"""Added to the diagonal of the normal equations, of which one point has about 1 in rotation."""


@compiled()
def _turned(theta: FloatArray, vectors: FloatArray) -> None:
    """Turn three-vectors (3, n) by a rotation vector (3,), in place (Rodrigues)."""
    square = theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2]
    angle = math.sqrt(square)
    sine, versine = 1.0 - square / 6.0, 0.5 - square / 24.0
    if angle > 1e-3:
        sine, versine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    for n in range(vectors.shape[1]):
        x, y, z = vectors[0, n], vectors[1, n], vectors[2, n]
        a = theta[1] * z - theta[2] * y
        b = theta[2] * x - theta[0] * z
        c = theta[0] * y - theta[1] * x
        vectors[0, n] = x + sine * a + versine * (theta[1] * c - theta[2] * b)
        vectors[1, n] = y + sine * b + versine * (theta[2] * a - theta[0] * c)
        vectors[2, n] = z + sine * c + versine * (theta[0] * b - theta[1] * a)


@compiled()
def _solve(A: FloatArray, b: FloatArray) -> None:
    """The solution of A x = b for a positive definite A (n, n), in the place of b, by Cholesky."""
    n = len(b)
    for k in range(n):
        A[k, k] = math.sqrt(A[k, k])
        for i in range(k + 1, n):
            A[i, k] /= A[k, k]
        for j in range(k + 1, n):
            for i in range(j, n):
                A[i, j] -= A[i, k] * A[j, k]
        b[k] /= A[k, k]
        for i in range(k + 1, n):
            b[i] -= A[i, k] * b[k]
    for k in range(n - 1, -1, -1):
        for i in range(k + 1, n):
            b[k] -= A[i, k] * b[i]
        b[k] /= A[k, k]


@compiled()
def _add_point(rows: FloatArray, r: float, s: float, w: float, A: FloatArray) -> None:
    """Add rows (2, 6) with residuals r and s, weighted by w, to normal equations [A b] (6, 7)."""
    for i in range(6):
        a, b = w * rows[0, i], w * rows[1, i]
        for k in range(i + 1):
            A[i, k] += a * rows[0, k] + b * rows[1, k]
        A[i, 6] += a * r + b * s


@compiled()
def _fill_rows(x: float, y: float, inverse: float, rows: FloatArray) -> None:
    """The rows (2, 6) of a point by a small turn and shift of it before the camera."""
    rows[0, 0], rows[0, 1], rows[0, 2] = -x * y, 1.0 + x * x, -y
    rows[1, 0], rows[1, 1], rows[1, 2] = -(1.0 + y * y), x * y, x
    rows[0, 3], rows[0, 4], rows[0, 5] = inverse, 0.0, -x * inverse
    rows[1, 3], rows[1, 4], rows[1, 5] = 0.0, inverse, -y * inverse


@compiled("void(f8[:, ::1], f8[:, ::1], b1[::1], f8[::1], f8[:, ::1], f8[::1])")
def pose_steps(
    points: FloatArray,
    rays: FloatArray,
    chosen: BoolArray,
    scales: FloatArray,
    pose: FloatArray,
    errors: FloatArray,
) -> None:
    """Steps on the squared errors on the plane z = 1, or under the loss of Geman and McClure.

    Args:
        points: (N, 3).
        rays: (N, 2) where the camera sees them, on its plane z = 1.
        chosen: (N,) which of them count; those behind the camera never do.
        scales: (K,) for each step the scale s of the loss, whose weight is (s² / (s² + e²))² for an
            error e; infinite for none.
        pose: (3, 4) camera_T_points [R t], moved.
        errors: (N,), filled with the errors at the end; infinite behind the camera.
    """
    Ab, rows = np.empty((6, 7)), np.empty((2, 6))
    A, b = Ab[:, :6], Ab[:, 6]
    for step in range(len(scales) + 1):
        Ab[:] = 0.0
        for n in range(len(points)):
            p, q, o = points[n, 0], points[n, 1], points[n, 2]
            z = pose[2, 0] * p + pose[2, 1] * q + pose[2, 2] * o + pose[2, 3]
            if not z > 0.0:
                errors[n] = math.inf
                continue
            x = (pose[0, 0] * p + pose[0, 1] * q + pose[0, 2] * o + pose[0, 3]) / z
            y = (pose[1, 0] * p + pose[1, 1] * q + pose[1, 2] * o + pose[1, 3]) / z
            r, s = rays[n, 0] - x, rays[n, 1] - y
            square = r * r + s * s
            errors[n] = math.sqrt(square)
            if chosen[n] and step < len(scales):
                w = 1.0 / (1.0 + square / (scales[step] * scales[step]))
                _fill_rows(x, y, 1.0 / z, rows)
                _add_point(rows, r, s, w * w, Ab)
        if step < len(scales):
            for i in range(6):
                A[i, i] += _DAMPING
            _solve(A, b)
            _turned(b[:3], pose)
            for i in range(3):
                pose[i, 3] += b[3 + i]


def pose_steps_numpy(
    points: FloatArray,
    rays: FloatArray,
    chosen: BoolArray,
    scales: FloatArray,
    pose: FloatArray,
    errors: FloatArray,
) -> None:
    """`pose_steps` in NumPy."""
    for scale in [*scales, None]:
        seen = points @ pose[:, :3].T + pose[:, 3]
        ahead = seen[:, 2] > 0.0
        x, y = seen[ahead, :2].T / seen[ahead, 2]
        r = rays[ahead] - np.column_stack([x, y])
        errors[:] = np.inf
        errors[ahead] = np.linalg.norm(r, axis=1)
        if scale is None:
            return
        none, i = np.zeros_like(x), 1.0 / seen[ahead, 2]
        along_x = -x * y, 1.0 + x * x, -y, i, none, -x * i
        along_y = -(1.0 + y * y), x * y, x, none, i, -y * i
        J = np.array([along_x, along_y]).transpose(2, 0, 1)
        w = np.where(chosen[ahead], (1.0 + (errors[ahead] / scale) ** 2) ** -2.0, 0.0)
        A = np.einsum("n,nij,nik->jk", w, J, J) + _DAMPING * np.eye(6)
        step = np.linalg.solve(A, np.einsum("n,nij,ni->j", w, J, r))
        pose[:] = Rotation.from_rotvec(step[:3]).as_matrix() @ pose
        pose[:, 3] += step[3:]
