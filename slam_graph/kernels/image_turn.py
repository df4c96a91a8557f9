# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations of the rotation between two small images, for direct alignment."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["turn_equations", "turn_equations_numpy"]

_Grey = NDArray[np.float32]
_AHEAD = 1e-3
"""Rays that are turned to less than this along the axis are out of view."""


@compiled(
    "i8(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f8[::1], i8, f8[:, ::1], f8[:, ::1],"
    " f8[::1])"
)
def turn_equations(
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
    """Of the differences of an image and another one as the first camera would see it.

    Args:
        one: (h, w) grey values of the first image.
        other: (h, w) of the second.
        along_u: (h, w) slopes of the first image to the right, per pixel.
        along_v: (h, w) downwards.
        camera: (4,) fx, fy, cx, cy in pixels of these images.
        stride: one pixel of so many is compared, in rows and in columns.
        R: (3, 3) other_R_one of the camera.
        lhs: (3, 3), filled with JᵀJ, where J are slopes by a turn of the points before the camera.
        rhs: (4,), filled with Jᵀd and the sum of the squares of the differences d.

    Returns:
        How many of these pixels both images show.
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


def turn_equations_numpy(
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
    """`turn_equations` in NumPy."""
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
    J = np.stack(turns, axis=1)
    lhs[:], rhs[:3], rhs[3] = J.T @ J, J.T @ d, d @ d
    return int(np.count_nonzero(inside))
