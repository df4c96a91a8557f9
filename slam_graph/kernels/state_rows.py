# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of observations of features of the state, triangular in the columns of each feature."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled
from slam_graph.kernels.null_space import triangularize_features_numpy

__all__ = ["fill_state_rows", "fill_state_rows_numpy"]


@compiled()
def _triangularize(W: FloatArray, m: int) -> None:
    """Householder's reflections that make the first three columns of (m, n) rows triangular."""
    for column in range(min(3, m)):
        squares = 0.0
        for i in range(column, m):
            squares += W[i, column] * W[i, column]
        if squares == 0.0:
            continue
        head = W[column, column]
        length = math.copysign(math.sqrt(squares), head)
        v = head + length
        factor = 2.0 / (squares - head * head + v * v)
        for k in range(column + 1, W.shape[1]):
            product = v * W[column, k]
            for i in range(column + 1, m):
                product += W[i, column] * W[i, k]
            product *= factor
            W[column, k] -= product * v
            for i in range(column + 1, m):
                W[i, k] -= product * W[i, column]
        W[column, column] = -length
        for i in range(column + 1, m):
            W[i, column] = 0.0


@compiled(
    "void(f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], i8[:], i8[::1], i8[::1],"
    " i8[::1], i8[::1], f8[:, :], f8[:, ::1])"
)
def fill_state_rows(
    r: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_calibration: FloatArray,
    frame: IntArray,
    starts: IntArray,
    order: IntArray,
    of_points: IntArray,
    columns: IntArray,
    Ab: FloatArray,
    rest: FloatArray,
) -> None:
    """Triangularise the rows of each feature in the three columns of its position.

    Args:
        r: (N, 2) residuals of the observations, those of one feature after the other.
        by_pose: (N, 2, 6) their derivatives by the observing pose.
        by_point: (N, 2, 3) by the position of the feature.
        by_calibration: (N, 2, C) by the calibration.
        frame: (N,) number of the observing pose.
        starts: (J + 1,) first observation of each feature, and N.
        order: (J,) the features in the order of their rows.
        of_points: (J,) first column of each feature.
        columns: (k,) those of F poses and the calibration, k = 6 F + C.
        Ab: (m, n + 1) zeros, filled: the rows [A b] that contain a feature, at most three of each.
        rest: (K, k + 1), filled: the others, over `columns`.
    """
    C, k = by_calibration.shape[2], len(columns)
    longest, end, others = 0, 0, 0
    for j in range(len(order)):
        longest = max(longest, starts[j + 1] - starts[j])
    W = np.empty((2 * longest, 4 + k))
    for j in order:
        begin, m = starts[j], 2 * (starts[j + 1] - starts[j])
        for row in range(m):
            n, axis = begin + row // 2, row % 2
            for a in range(4 + k):
                W[row, a] = 0.0
            for a in range(3):
                W[row, a] = by_point[n, axis, a]
            for a in range(6):
                W[row, 3 + 6 * frame[n] + a] = by_pose[n, axis, a]
            for a in range(C):
                W[row, 3 + k - C + a] = by_calibration[n, axis, a]
            W[row, 3 + k] = r[n, axis]
        _triangularize(W, m)
        for row in range(m):
            if row >= 3:
                for a in range(k + 1):
                    rest[others, a] = W[row, 3 + a]
                others += 1
                continue
            for a in range(row, 3):
                Ab[end, of_points[j] + a] = W[row, a]
            for a in range(k):
                Ab[end, columns[a]] = W[row, 3 + a]
            Ab[end, -1] = W[row, 3 + k]
            end += 1


def fill_state_rows_numpy(
    r: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_calibration: FloatArray,
    frame: IntArray,
    starts: IntArray,
    order: IntArray,
    of_points: IntArray,
    columns: IntArray,
    Ab: FloatArray,
    rest: FloatArray,
) -> None:
    """`fill_state_rows` in NumPy."""
    C, k, end, others = by_calibration.shape[2], len(columns), 0, 0
    for j in order:
        seen = slice(starts[j], starts[j + 1])
        m = 2 * (starts[j + 1] - starts[j])
        by_poses = np.zeros((m // 2, 2, (k - C) // 6, 6))
        by_poses[np.arange(m // 2), :, frame[seen]] = by_pose[seen]
        parts = by_poses.reshape(m // 2, 2, k - C), by_calibration[seen], r[seen, :, None]
        A = np.zeros((1, max(m, 3), 3))
        B = np.zeros((1, max(m, 3), k + 1))
        A[0, :m] = by_point[seen].reshape(m, 3)
        B[0, :m] = np.concatenate(parts, axis=2).reshape(m, k + 1)
        triangularize_features_numpy(A, B)
        rows = slice(end, end + min(m, 3))
        end = rows.stop
        Ab[rows, of_points[j] : of_points[j] + 3] = np.triu(A[0, :3])[:m]
        Ab[rows, columns] = B[0, : min(m, 3), :-1]
        Ab[rows, -1] = B[0, : min(m, 3), -1]
        rest[others : others + max(m - 3, 0)] = B[0, 3:m]
        others += max(m - 3, 0)
