# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Householder's reflections that take the position of each feature out of its rows."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["triangularize_features", "triangularize_features_numpy"]


@compiled()
def _reflect(A: FloatArray, B: FloatArray, column: int, v: FloatArray, product: FloatArray) -> None:
    """The reflection that zeroes a column of A (m, 3) below the diagonal; the same of B (m, n).

    Args:
        A: (m, 3).
        B: (m, n).
        column: which of A.
        v: (m,) room for the reflection.
        product: (max(3, n),) room for products with it.
    """
    rows = len(A)
    squares = 0.0
    for i in range(column, rows):
        squares += A[i, column] * A[i, column]
    if squares == 0.0:
        return
    count = rows - column
    for i in range(count):
        v[i] = A[column + i, column]
    v[0] += math.copysign(math.sqrt(squares), v[0])
    scale = 0.0
    for i in range(count):
        scale += v[i] * v[i]
    for M in (A, B):
        for k in range(M.shape[1]):
            product[k] = 0.0
        for i in range(count):
            if v[i] != 0.0:
                for k in range(M.shape[1]):
                    product[k] += v[i] * M[column + i, k]
        for i in range(count):
            if v[i] != 0.0:
                factor = 2.0 / scale * v[i]
                for k in range(M.shape[1]):
                    M[column + i, k] -= factor * product[k]


@compiled("void(f8[:, :, ::1], f8[:, :, ::1])")
def triangularize_features(A: FloatArray, B: FloatArray) -> None:
    """Triangularise the coefficients of features, and apply the same reflections beside them.

    Args:
        A: (J, m, 3) coefficients of the positions; R in the first three rows afterwards.
        B: (J, m, n) all others of the same rows.
    """
    v, product = np.empty(A.shape[1]), np.empty(max(3, B.shape[2]))
    for j in range(len(A)):
        for column in range(3):
            _reflect(A[j], B[j], column, v, product)


def triangularize_features_numpy(A: FloatArray, B: FloatArray) -> None:
    """`triangularize_features` in NumPy."""
    for column in range(3):
        x = A[:, column:, column]
        norm = np.linalg.norm(x, axis=1)
        v = x.copy()
        v[:, 0] += np.where(x[:, 0] >= 0, norm, -norm)
        scale = np.einsum("ji,ji->j", v, v)
        beta = 2.0 / np.where(scale > 0, scale, np.inf)
        for target in (A, B):
            part = target[:, column:]
            projection = (v[:, None, :] @ part) * beta[:, None, None]
            part -= v[:, :, None] * projection
