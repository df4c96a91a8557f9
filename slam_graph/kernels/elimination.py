# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Givens rotations that take variables out of the rows of a triangle; where rows have zeros."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "eliminate_columns",
    "eliminate_columns_numpy",
    "zeros_to_the_left",
    "zeros_to_the_left_numpy",
]


_at = np.uintp
"""An index without a sign. Numba would test others for negative ones, and not use vectors."""


@compiled()
def _rotate(row: FloatArray, other: FloatArray, c: float, s: float) -> None:
    """Rotate two rows by an angle of which cosine and sine are given."""
    for k in range(len(row)):
        above, below = row[_at(k)], other[_at(k)]
        row[_at(k)] = c * above - s * below
        other[_at(k)] = c * below + s * above


@compiled("void(f8[:, :], i8[::1], f8[:, ::1], f8[:, :])")
def eliminate_columns(
    R: FloatArray, order: IntArray, carried: FloatArray, kept: FloatArray
) -> None:
    """Take columns out of the rows of a triangle, from the bottom up.

    A row whose own column is eliminated is carried upwards. Each row above is rotated with all that
    are carried, one for each column that it must lose. These have nothing to the left of what the
    row begins with, so that it stays a row of a triangle.

    Args:
        R: (n, w + k) first rows of an upper triangle.
        order: (w + k,) where its columns go: first the w that are eliminated, then those that stay;
            both ascending as far as they are among the first n.
        carried: (w, w + k) the rows that are carried, in the new order of columns; those of columns
            that stood behind row n are given, zeros otherwise. All are filled afterwards.
        kept: (m, k) zeros; filled with the rows of columns that stay.
    """
    w, width = carried.shape
    top = 0
    while top < w and order[top] < len(R):
        top += 1
    row = np.empty(width)
    for i in range(len(R) - 1, -1, -1):
        eliminated = top > 0 and order[top - 1] == i
        if eliminated:
            top -= 1
            row = carried[top]
        first = w + i - top
        for k in range(top, w):
            row[k] = R[i, order[k]]
        for k in range(first, width):
            row[k] = R[i, order[k]]
        if eliminated:
            row = np.empty(width)
            continue
        for column in range(top, w):
            x = row[column]
            if x == 0.0:
                continue
            other = carried[column]
            length = math.hypot(other[column], x)
            c, s = other[column] / length, x / length
            _rotate(row[column:w], other[column:w], c, s)
            _rotate(row[first:], other[first:], c, s)
        for k in range(first, width):
            kept[i - top, k - w] = row[k]


def eliminate_columns_numpy(
    R: FloatArray, order: IntArray, carried: FloatArray, kept: FloatArray
) -> None:
    """`eliminate_columns` by one QR decomposition; rows have any sign."""
    given = carried[order[: len(carried)] >= len(R)]
    rows = np.concatenate([given, R[:, order]])
    triangle = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
    carried[:] = triangle[: len(carried)]
    kept[:] = triangle[len(carried) :, len(carried) :][: len(kept)]


@compiled("Tuple((i8, b1))(f8[:, :])")
def zeros_to_the_left(rows: FloatArray) -> tuple[int, bool]:
    """How many columns of (m, n) rows are zero, and whether row i is zero for i columns more."""
    m, n = rows.shape
    first, found = 0, False
    while first < n and not found:
        for i in range(m):
            found = found or rows[i, first] != 0.0
        first += 0 if found else 1
    for k in range(min(m, n - first)):
        for i in range(k + 1, m):
            if rows[i, first + k] != 0.0:
                return first, False
    return first, m <= n - first


def zeros_to_the_left_numpy(rows: FloatArray) -> tuple[int, bool]:
    """`zeros_to_the_left` in NumPy."""
    first = int(np.argmax(np.append(rows.any(axis=0), True)))
    rest = rows[:, first:]
    return first, len(rest) <= rest.shape[1] and not np.any(np.tril(rest, -1))
