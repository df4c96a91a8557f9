# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What many features say of the poses together, by the Schur complement of their positions."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["sum_of_features", "sum_of_features_numpy"]

_REGULARISATION = 1e-15
"""Information that is added to a feature, relative to what its observations say of it."""


@compiled()
def _orthonormalize(Q: FloatArray, m: int, R: FloatArray) -> None:
    """Make the columns of (m, 3) rows orthonormal; R (3, 3) is what they were multiplied with."""
    squares, L, before = np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            R[a, b] = 1.0 if a == b else 0.0
    for _ in range(2):
        for a in range(3):
            for b in range(3):
                squares[a, b], before[a, b] = 0.0, R[a, b]
        for i in range(m):
            for a in range(3):
                for b in range(3):
                    squares[a, b] += Q[i, a] * Q[i, b]
        added = _REGULARISATION * (squares[0, 0] + squares[1, 1] + squares[2, 2])
        for a in range(3):
            for b in range(a + 1):
                rest = squares[a, b] + (added if a == b else 0.0)
                for k in range(b):
                    rest -= L[a, k] * L[b, k]
                L[a, b] = math.sqrt(rest) if a == b else rest / L[b, b]
        for i in range(m):
            for a in range(3):
                for k in range(a):
                    Q[i, a] -= L[a, k] * Q[i, k]
                Q[i, a] /= L[a, a]
        for a in range(3):
            for b in range(3):
                R[a, b] = 0.0
                for k in range(a, b + 1):
                    R[a, b] += L[k, a] * before[k, b]


@compiled(
    "void(f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], i8[:], i8[::1],"
    " f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1])"
)
def sum_of_features(
    r: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_calibration: FloatArray,
    frame: IntArray,
    starts: IntArray,
    R_f: FloatArray,
    T: FloatArray,
    information: FloatArray,
) -> None:
    """Eliminate the positions of J features, and add up what is left.

    With H_f = Q R_f by two rounds of Cholesky QR and H = [H_x r], T = Qᵀ H, and the information is
    Σ Hᵀ H - Tᵀ T.

    Args:
        r: (N, 2) residuals of the observations, those of one feature after the other.
        by_pose: (N, 2, 6) their derivatives by the observing pose.
        by_point: (N, 2, 3) by the position of the feature.
        by_calibration: (N, 2, C) by the calibration.
        frame: (N,) number of the observing pose.
        starts: (J + 1,) first observation of each feature, and N.
        R_f: (J, 3, 3), filled: upper triangular.
        T: (J, 3, n + 1), filled; n = 6 F + C, of F poses and the calibration.
        information: (n + 1, n + 1), filled.
    """
    width, C = len(information), by_calibration.shape[2]
    first = width - 1 - C
    for a in range(width):
        for b in range(width):
            information[a, b] = 0.0
    longest = 0
    for j in range(len(T)):
        longest = max(longest, starts[j + 1] - starts[j])
    Q = np.empty((2 * longest, 3))
    columns, h = np.empty(7 + C, np.int64), np.empty(7 + C)
    for k in range(C + 1):
        columns[6 + k] = first + k
    for j in range(len(T)):
        begin, m = starts[j], 2 * (starts[j + 1] - starts[j])
        for k in range(3):
            for row in range(m):
                Q[row, k] = by_point[begin + row // 2, row % 2, k]
            for a in range(width):
                T[j, k, a] = 0.0
        _orthonormalize(Q, m, R_f[j])
        for row in range(m):
            n, i = begin + row // 2, row % 2
            for k in range(6):
                columns[k], h[k] = 6 * frame[n] + k, by_pose[n, i, k]
            for k in range(C):
                h[6 + k] = by_calibration[n, i, k]
            h[6 + C] = r[n, i]
            for a in range(7 + C):
                for k in range(3):
                    T[j, k, columns[a]] += Q[row, k] * h[a]
                for b in range(a, 7 + C):
                    information[columns[a], columns[b]] += h[a] * h[b]
        for a in range(width):
            t0, t1, t2 = T[j, 0, a], T[j, 1, a], T[j, 2, a]
            if t0 != 0.0 or t1 != 0.0 or t2 != 0.0:
                for b in range(a, width):
                    information[a, b] -= t0 * T[j, 0, b] + t1 * T[j, 1, b] + t2 * T[j, 2, b]
    for a in range(width):
        for b in range(a):
            information[a, b] = information[b, a]


def sum_of_features_numpy(
    r: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_calibration: FloatArray,
    frame: IntArray,
    starts: IntArray,
    R_f: FloatArray,
    T: FloatArray,
    information: FloatArray,
) -> None:
    """`sum_of_features` in NumPy, feature by feature."""
    first = len(information) - 1 - by_calibration.shape[2]
    information[:] = 0.0
    for j in range(len(T)):
        rows = slice(starts[j], starts[j + 1])
        H = np.zeros((2 * (starts[j + 1] - starts[j]), len(information)))
        for k, i in enumerate(frame[rows]):
            H[2 * k : 2 * k + 2, 6 * i : 6 * i + 6] = by_pose[rows][k]
        H[:, first:-1] = by_calibration[rows].reshape(len(H), -1)
        H[:, -1] = r[rows].ravel()
        Q, R = by_point[rows].reshape(-1, 3), np.eye(3)
        for _ in range(2):
            squares = Q.T @ Q
            root = np.linalg.cholesky(squares + _REGULARISATION * np.trace(squares) * np.eye(3)).T
            Q, R = Q @ np.linalg.inv(root), root @ R
        R_f[j], T[j] = R, Q.T @ H
        information += H.T @ H - T[j].T @ T[j]
