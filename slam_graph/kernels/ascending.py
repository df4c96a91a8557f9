# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Sets of ids in ascending arrays: there are many in a frame, and each has few."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["are_among", "are_among_numpy"]


@compiled("b1[::1](i8[:], i8[:])")
def are_among(values: IntArray, ascending: IntArray) -> BoolArray:
    """Which values are among some ascending ones, by bisection.

    Args:
        values: (N,).
        ascending: (M,).

    Returns:
        (N,).
    """
    found = np.empty(len(values), np.bool_)
    for n in range(len(values)):
        low, high, value = 0, len(ascending), values[n]
        while low < high:
            middle = (low + high) // 2
            if ascending[middle] < value:
                low = middle + 1
            else:
                high = middle
        found[n] = low < len(ascending) and ascending[low] == value
    return found


def are_among_numpy(values: IntArray, ascending: IntArray) -> BoolArray:
    """`are_among` in NumPy."""
    return np.asarray(np.isin(values, ascending))
