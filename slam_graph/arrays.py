# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Array types that all modules share, the matrix of the cross product, and medians."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BoolArray", "FloatArray", "IntArray", "lengths_of", "median", "skew"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def skew(v: FloatArray) -> FloatArray:
    """[v]ₓ (..., 3, 3) of vectors v (..., 3), so that [v]ₓ u = v × u."""
    matrix = np.zeros((*v.shape, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = x, y, z
    matrix[..., 1, 2], matrix[..., 2, 0], matrix[..., 0, 1] = -x, -y, -z
    return matrix


def lengths_of(vectors: FloatArray) -> FloatArray:
    """Lengths (N,) of vectors (N, k) that a file gave, silently infinite beyond 1e154."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(vectors, axis=1))


def median(values: NDArray[Any]) -> FloatArray:
    """The median along the first axis of an array; NumPy's takes many times as long."""
    ascending, count = np.sort(values, axis=0), len(values)
    return np.asarray(0.5 * (ascending[(count - 1) // 2] + ascending[count // 2]))
