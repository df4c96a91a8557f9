# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of points of two sets that are near each other."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["near_pairs", "near_pairs_numpy"]


@compiled("i8[:, ::1](f8[:, ::1], f8[:, ::1], f8)")
def near_pairs(first: FloatArray, second: FloatArray, distance: float) -> IntArray:
    """Which points are at most so far apart, by comparing all with all.

    Args:
        first: (N, 2).
        second: (M, 2).
        distance: largest distance.

    Returns:
        (P, 2) rows of both, ascending.
    """
    pairs = np.empty((len(first) * len(second), 2), np.int64)
    count, limit = 0, distance * distance
    for i in range(len(first)):
        x, y = first[i]
        for j in range(len(second)):
            dx, dy = second[j, 0] - x, second[j, 1] - y
            if dx * dx + dy * dy <= limit:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return pairs[:count].copy()


def near_pairs_numpy(first: FloatArray, second: FloatArray, distance: float) -> IntArray:
    """`near_pairs` in NumPy."""
    squares = np.sum((second - first[:, None]) ** 2, axis=2)
    return np.argwhere(squares <= distance * distance)
