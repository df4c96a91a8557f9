# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The rotation between two small images by direct alignment."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["turn_steps", "turn_steps_numpy"]

_Grey = NDArray[np.float32]
_AHEAD = 1e-3
"""Rays that are turned to less than this along the axis are out of view."""
_DAMPING = 1e-6
"""Of the normal equations, grey values squared: images without contrast do not turn."""


@compiled()
def _equations(
    one: _Grey,
    other: _Grey,
    along_u: _Grey,
    along_v: _Grey,
    camera: FloatArray,
    stride: int,
    R: FloatArray,
    lhs: FloatArray,
    rhs: FloatArray,
) -> int:
    """Fill JᵀJ (3, 3), and Jᵀd and the sum of d² (4,), of the differences d; how many there are.

    J are the slopes by a turn of the points before the camera.
    """
    h, w = one.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    l00 = l01 = l02 = l11 = l12 = l22 = 0.0
    b0 = b1 = b2 = squares = 0.0
    count = 0
    for row in range(0, h, stride):
        y = (row - cy) / fy
        for column in range(0, w, stride):
            x = (column - cx) / fx
            ahead = R[2, 0] * x + R[2, 1] * y + R[2, 2]
            if not ahead > _AHEAD:
                continue
            u = fx * ((R[0, 0] * x + R[0, 1] * y + R[0, 2]) / ahead) + cx
            v = fy * ((R[1, 0] * x + R[1, 1] * y + R[1, 2]) / ahead) + cy
            if not (0.0 <= u < w - 1 and 0.0 <= v < h - 1):
                continue
            left, top = math.floor(u), math.floor(v)
            a, b = u - left, v - top
            above = (1.0 - a) * other[top, left] + a * other[top, left + 1]
            below = (1.0 - a) * other[top + 1, left] + a * other[top + 1, left + 1]
            d = (1.0 - b) * above + b * below - one[row, column]
            su, sv = fx * along_u[row, column], fy * along_v[row, column]
            j0 = -(su * x * y + sv * (1.0 + y * y))
            j1 = su * (1.0 + x * x) + sv * x * y
            j2 = sv * x - su * y
            l00 += j0 * j0
            l01 += j0 * j1
            l02 += j0 * j2
            l11 += j1 * j1
            l12 += j1 * j2
            l22 += j2 * j2
            b0 += j0 * d
            b1 += j1 * d
            b2 += j2 * d
            squares += d * d
            count += 1
    lhs[0, 0], lhs[1, 1], lhs[2, 2] = l00, l11, l22
    lhs[0, 1] = lhs[1, 0] = l01
    lhs[0, 2] = lhs[2, 0] = l02
    lhs[1, 2] = lhs[2, 1] = l12
    rhs[0], rhs[1], rhs[2], rhs[3] = b0, b1, b2, squares
    return count


@compiled()
def _turn(R: FloatArray, theta: FloatArray) -> None:
    """R Exp(-theta) in the place of R (3, 3), by Rodrigues."""
    square = theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2]
    angle = math.sqrt(square)
    sine, versine = 1.0 - square / 6.0, 0.5 - square / 24.0
    if angle > 1e-3:
        sine, versine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    for i in range(3):
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        a = theta[1] * z - theta[2] * y
        b = theta[2] * x - theta[0] * z
        c = theta[0] * y - theta[1] * x
        R[i, 0] = x + sine * a + versine * (theta[1] * c - theta[2] * b)
        R[i, 1] = y + sine * b + versine * (theta[2] * a - theta[0] * c)
        R[i, 2] = z + sine * c + versine * (theta[0] * b - theta[1] * a)


@compiled()
def _solve(A: FloatArray, b: FloatArray) -> None:
    """The solution of A x = b for a positive definite A (3, 3), in the place of b[:3], by LDLᵀ."""
    d0, a10, a20, b0 = A[0, 0], A[1, 0], A[2, 0], b[0]
    l10, l20 = a10 / d0, a20 / d0
    d1 = A[1, 1] - l10 * a10
    l21 = (A[2, 1] - l20 * a10) / d1
    d2 = A[2, 2] - l20 * a20 - l21 * l21 * d1
    y1 = b[1] - l10 * b0
    b[2] = (b[2] - l20 * b0 - l21 * y1) / d2
    b[1] = y1 / d1 - l21 * b[2]
    b[0] = b0 / d0 - l10 * b[1] - l20 * b[2]


@compiled(
    "UniTuple(f8, 2)(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f8[::1], i8, i8, f8,"
    " f8[:, ::1])"
)
def turn_steps(
    one: _Grey,
    other: _Grey,
    along_u: _Grey,
    along_v: _Grey,
    camera: FloatArray,
    stride: int,
    steps: int,
    smallest: float,
    R: FloatArray,
) -> tuple[float, float]:
    """Gauss-Newton steps on the differences of two images, as the first camera would see both.

    Args:
        one: (h, w) grey values of the first image.
        other: (h, w) of the second.
        along_u: (h, w) slopes of the first image to the right, per pixel.
        along_v: (h, w) downwards.
        camera: (4,) fx, fy, cx, cy in pixels of these images.
        stride: one pixel of so many is compared, in rows and in columns.
        steps: at most so many; none only compares.
        smallest: a step below this, rad, is the last one.
        R: (3, 3) other_R_one of the camera, turned.

    Returns:
        The sum of the squared differences where they were last taken, which is at the end or before
        a last small step, and how many there are.
    """
    lhs, rhs = np.empty((3, 3)), np.empty(4)
    count = _equations(one, other, along_u, along_v, camera, stride, R, lhs, rhs)
    for _ in range(steps):
        for i in range(3):
            lhs[i, i] += _DAMPING
        _solve(lhs, rhs)
        # the first image turned by a small angle has the slopes of itself
        _turn(R, rhs[:3])
        if rhs[0] * rhs[0] + rhs[1] * rhs[1] + rhs[2] * rhs[2] < smallest * smallest:
            break
        count = _equations(one, other, along_u, along_v, camera, stride, R, lhs, rhs)
    return rhs[3], float(count)


def turn_steps_numpy(
    one: _Grey,
    other: _Grey,
    along_u: _Grey,
    along_v: _Grey,
    camera: FloatArray,
    stride: int,
    steps: int,
    smallest: float,
    R: FloatArray,
) -> tuple[float, float]:
    """`turn_steps` in NumPy."""
    J, d = _differences(one, other, along_u, along_v, camera, stride, R)
    for _ in range(steps):
        step = np.linalg.solve(J.T @ J + _DAMPING * np.eye(3), J.T @ d)
        R[:] = R @ Rotation.from_rotvec(-step).as_matrix()
        if np.linalg.norm(step) < smallest:
            break
        J, d = _differences(one, other, along_u, along_v, camera, stride, R)
    return float(d @ d), float(len(d))


def _differences(
    one: _Grey,
    other: _Grey,
    along_u: _Grey,
    along_v: _Grey,
    camera: FloatArray,
    stride: int,
    R: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Slopes J (N, 3) by a turn and differences d (N,)."""
    h, w = one.shape
    v, u = np.mgrid[:h, :w]
    x, y = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
    turned = np.stack([x, y, np.ones((h, w))], axis=-1) @ R.T
    ahead = turned[..., 2] > _AHEAD
    places = camera[:2] * turned[..., :2] / np.where(ahead, turned[..., 2], 1.0)[..., None]
    u, v = np.moveaxis(places + camera[2:], -1, 0)
    inside = ahead & (np.arange(h) % stride == 0)[:, None] & (np.arange(w) % stride == 0)
    inside &= (u >= 0) & (v >= 0) & (u < w - 1) & (v < h - 1)
    u, v, x, y = u[inside], v[inside], x[inside], y[inside]
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    a, b, grey = u - left, v - top, other.astype(np.float64)
    above = (1.0 - a) * grey[top, left] + a * grey[top, left + 1]
    below = (1.0 - a) * grey[top + 1, left] + a * grey[top + 1, left + 1]
    d = (1.0 - b) * above + b * below - one[inside]
    su, sv = camera[0] * along_u[inside], camera[1] * along_v[inside]
    turns = -(su * x * y + sv * (1 + y * y)), su * (1 + x * x) + sv * x * y, sv * x - su * y
    return np.stack(turns, axis=1), d
