# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Givens rotations that take variables out of the rows of a triangle."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["eliminate_columns", "eliminate_columns_numpy"]


@compiled("void(f8[:, ::1], i8[::1], f8[:, ::1])")
def eliminate_columns(rows: FloatArray, gone: IntArray, carried: FloatArray) -> None:
    """Take columns out of the rows of a triangle, from the bottom up.

    A row whose own column is eliminated is carried upwards. Each row above is rotated with all that
    are carried, one for each column that it must lose. These have nothing to the left of what the
    row begins with, so that it stays a row of a triangle.

    Args:
        rows: (n, w + k) first rows of a triangle, the w eliminated columns moved to the front. The
            rows of columns that stay have lost the others afterwards.
        gone: (w,) where these columns stood in the triangle, ascending; some behind row n.
        carried: (w, w + k) the rows that are carried; those of columns that stood behind row n are
            given, all of them are filled afterwards.
    """
    w, width = carried.shape
    top = 0
    while top < w and gone[top] < len(rows):
        top += 1
    for i in range(len(rows) - 1, -1, -1):
        if top > 0 and gone[top - 1] == i:
            top -= 1
            carried[top] = rows[i]
            continue
        row, first = rows[i], w + i - top
        for column in range(top, w):
            x = row[column]
            if x == 0.0:
                continue
            other = carried[column]
            length = math.hypot(other[column], x)
            c, s = other[column] / length, x / length
            for k in range(column, w):
                above, below = row[k], other[k]
                row[k] = c * above - s * below
                other[k] = c * below + s * above
            for k in range(first, width):
                above, below = row[k], other[k]
                row[k] = c * above - s * below
                other[k] = c * below + s * above


def eliminate_columns_numpy(rows: FloatArray, gone: IntArray, carried: FloatArray) -> None:
    """`eliminate_columns` by one QR decomposition; rows have any sign."""
    stays = ~np.isin(np.arange(len(rows)), gone)
    R = np.linalg.qr(np.concatenate([carried[gone >= len(rows)], rows]), mode="r")
    carried[:] = R[: len(gone)]
    rows[stays] = R[len(gone) : len(gone) + np.count_nonzero(stays)]
