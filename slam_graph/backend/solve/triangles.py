# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Triangular matrices: solutions, inverses, and the upper parts of others."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import blas, lapack

from slam_graph.arrays import FloatArray, IntArray

_ROUNDED = 128
"""Masks are made for multiples of this, as they take as much memory as the matrices."""
_SMALL_TRIANGLE = 64
"""Triangles up to this size are inverted at once."""


def solved(R: FloatArray, d: FloatArray) -> FloatArray:
    """The solution of R x = d for an upper triangular R; rows below its last column are not read.

    As many values follow the solution as there are such rows.
    """
    if len(d) == 0:
        return np.zeros(0)
    x, info = lapack.dtrtrs(R, d)
    if info != 0 or not np.isfinite(x).all():
        raise np.linalg.LinAlgError("the cost does not determine all of its variables")
    return np.asarray(x, dtype=np.float64)


def transposed_inverse(R: FloatArray) -> FloatArray:
    """R⁻ᵀ of an upper triangular (n, n) matrix; what is below its diagonal may be anything.

    By the inverses of its halves and triangular products of these, which take half of the time of
    LAPACK's `dtrtri` for a few hundred columns. What is above the diagonal of the result is zero.

    Raises:
        numpy.linalg.LinAlgError: if it is singular.
    """
    n = len(R)
    if n <= _SMALL_TRIANGLE:
        small, info = lapack.dtrtri(R.T, lower=1)
        if info != 0:
            raise np.linalg.LinAlgError("the information is singular")
        return lower_part(small)
    half = n // 2
    inverse = np.empty((n, n), order="F")
    inverse[:half, half:] = 0.0
    inverse[:half, :half] = first = transposed_inverse(R[:half, :half])
    inverse[half:, half:] = second = transposed_inverse(R[half:, half:])
    corner = blas.dtrmm(-1.0, second, R[:half, half:].T, lower=1)
    inverse[half:, :half] = blas.dtrmm(1.0, first, corner, side=1, lower=1, overwrite_b=1)
    return inverse


def upper_part(values: FloatArray) -> FloatArray:
    """A copy of (m, n) values, m at most n, with zeros below the diagonal.

    By their bits, whatever values are below: `np.where` and `np.triu` take three times as long.
    """
    m, n = values.shape
    return (values.view(np.int64) & _upper_bits(_rounded(n))[:m, :n]).view(np.float64)


def lower_part(values: FloatArray) -> FloatArray:
    """A copy of a square matrix with zeros above the diagonal.

    It is column by column in memory as LAPACK's results are, which is what it is for.
    """
    n = len(values)
    return (values.view(np.int64) & _lower_bits(_rounded(n))[:n, :n]).view(np.float64)


def _rounded(n: int) -> int:
    return -(-n // _ROUNDED) * _ROUNDED


@lru_cache(maxsize=8)
def _upper_bits(n: int) -> IntArray:
    """(n, n) all bits where an upper triangle is."""
    return np.asfortranarray(-np.tri(n, dtype=np.int64).T)


@lru_cache(maxsize=8)
def _lower_bits(n: int) -> IntArray:
    """(n, n) all bits where a lower triangle is."""
    return np.asfortranarray(-np.tri(n, dtype=np.int64))
