# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Squared Mahalanobis distances of whitened residuals, for the χ² gate."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "observation_distances",
    "observation_distances_numpy",
    "observation_rows",
    "observation_rows_numpy",
    "track_distances",
    "track_distances_numpy",
]


@compiled("void(f8[:, ::1], f8[:, :, ::1], f8[::1, :], i8[:, ::1], f8[::1])")
def observation_distances(
    r: FloatArray, H: FloatArray, root: FloatArray, columns: IntArray, distances: FloatArray
) -> None:
    """rᵀ (H P Hᵀ + I)⁻¹ r of single observations.

    Args:
        r: (N, 2) residuals.
        H: (N, 2, k) their derivatives.
        root: (m, n) with P = rootᵀ root, the covariance of the state.
        columns: (N, k) columns of `root` that go with those of H.
        distances: (N,), filled.
    """
    rows = len(root)
    y = np.empty((2, rows))
    for n in range(len(r)):
        for i in range(rows):
            y[0, i] = y[1, i] = 0.0
        for k in range(columns.shape[1]):
            column = root[:, columns[n, k]]
            a, b = H[n, 0, k], H[n, 1, k]
            for i in range(rows):
                y[0, i] += a * column[i]
                y[1, i] += b * column[i]
        s00, s01, s11 = 1.0, 0.0, 1.0
        for i in range(rows):
            s00 += y[0, i] * y[0, i]
            s01 += y[0, i] * y[1, i]
            s11 += y[1, i] * y[1, i]
        u, v = r[n, 0], r[n, 1]
        distances[n] = (s11 * u * u - 2.0 * s01 * u * v + s00 * v * v) / (s00 * s11 - s01 * s01)


def observation_distances_numpy(
    r: FloatArray, H: FloatArray, root: FloatArray, columns: IntArray, distances: FloatArray
) -> None:
    """`observation_distances` in NumPy."""
    y = H @ root.T[columns]
    S = y @ y.transpose(0, 2, 1) + np.eye(2)
    distances[:] = np.einsum("ni,ni->n", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])


@compiled("void(f8[:, :, ::1], f8[::1, :], i8[:, ::1], f8[:, ::1])")
def observation_rows(H: FloatArray, root: FloatArray, columns: IntArray, rows: FloatArray) -> None:
    """Derivatives H rootᵀ of single observations by whitened variables x, δ = rootᵀ x.

    Args:
        H: (N, 2, k) by variables.
        root: (m, n) lower triangular, with P = rootᵀ root the covariance of the variables.
        columns: (N, k) columns of `root` that go with those of H.
        rows: (2 N, m), filled.
    """
    for n in range(len(H)):
        one, other = rows[2 * n], rows[2 * n + 1]
        one[:], other[:] = 0.0, 0.0
        for k in range(columns.shape[1]):
            first = columns[n, k]
            column = root[:, first]
            a, b = H[n, 0, k], H[n, 1, k]
            for i in range(first, len(column)):
                one[i] += a * column[i]
                other[i] += b * column[i]


def observation_rows_numpy(
    H: FloatArray, root: FloatArray, columns: IntArray, rows: FloatArray
) -> None:
    """`observation_rows` in NumPy."""
    rows[:] = (H @ np.tril(root).T[columns]).reshape(rows.shape)


@compiled()
def _without_point(rows: FloatArray, m: int) -> float:
    """Squared length of column 0 of (m, 4) rows off the other three, by modified Gram-Schmidt."""
    for k in range(1, 4):
        square = 0.0
        for i in range(m):
            square += rows[i, k] * rows[i, k]
        if square == 0.0:
            continue
        for other in range(4):
            if other == 0 or other > k:
                along = 0.0
                for i in range(m):
                    along += rows[i, k] * rows[i, other]
                for i in range(m):
                    rows[i, other] -= along / square * rows[i, k]
    length = 0.0
    for i in range(m):
        length += rows[i, 0] * rows[i, 0]
    return length


@compiled(
    "void(f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], i8[:], i8[::1], f8[:, ::1],"
    " f8[::1])"
)
def track_distances(
    r: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_calibration: FloatArray,
    frame: IntArray,
    starts: IntArray,
    covariance: FloatArray,
    distances: FloatArray,
) -> None:
    """Distances of features with all of their observations, whatever their positions are.

    With r = H δx + H_f δf and S = H P Hᵀ + I = Uᵀ U, the distance is that of U⁻ᵀ r to the span of
    U⁻ᵀ H_f: the least over all δf of the squared length of U⁻ᵀ (r - H_f δf). That is the same as
    the distance in the null space of H_f, without having to form that.

    Args:
        r: (N, 2) residuals of the observations, those of one feature after the other.
        by_pose: (N, 2, 6) their derivatives by the observing pose.
        by_point: (N, 2, 3) by the position of the feature.
        by_calibration: (N, 2, C) by the calibration.
        frame: (N,) number of the observing pose.
        starts: (J + 1,) first observation of each feature, and N.
        covariance: (6 F + C, 6 F + C) of F poses and the calibration.
        distances: (J,), filled.
    """
    size, C = len(covariance), by_calibration.shape[2]
    first = size - C
    longest = 0
    for j in range(len(distances)):
        longest = max(longest, starts[j + 1] - starts[j])
    S, rest = np.empty((2 * longest, 2 * longest)), np.empty((2 * longest, 4))
    HP = np.empty(size)
    for j in range(len(distances)):
        begin = starts[j]
        m = 2 * (starts[j + 1] - begin)
        for row in range(m):
            n, i = begin + row // 2, row % 2
            rest[row, 0] = r[n, i]
            for k in range(3):
                rest[row, 1 + k] = by_point[n, i, k]
            P, h = covariance[6 * frame[n] : 6 * frame[n] + 6], by_pose[n, i]
            for column in range(size):
                HP[column] = (
                    (h[0] * P[0, column] + h[1] * P[1, column])
                    + (h[2] * P[2, column] + h[3] * P[3, column])
                    + (h[4] * P[4, column] + h[5] * P[5, column])
                )
            for k in range(C):
                for column in range(size):
                    HP[column] += by_calibration[n, i, k] * covariance[first + k, column]
            for other in range(row, m):
                o, i_o = begin + other // 2, other % 2
                pose, h = 6 * frame[o], by_pose[o, i_o]
                value = 1.0 if other == row else 0.0
                value += (  # in pairs, which do not wait for each other
                    (HP[pose] * h[0] + HP[pose + 1] * h[1])
                    + (HP[pose + 2] * h[2] + HP[pose + 3] * h[3])
                    + (HP[pose + 4] * h[4] + HP[pose + 5] * h[5])
                )
                for k in range(C):
                    value += HP[first + k] * by_calibration[o, i_o, k]
                S[row, other] = value
        for k in range(m):  # Cholesky's U, row by row, and U⁻ᵀ of the right-hand sides
            scale = 1.0 / math.sqrt(S[k, k])
            for column in range(k, m):
                S[k, column] *= scale
            for column in range(4):
                rest[k, column] *= scale
            for row in range(k + 1, m):
                factor = S[k, row]
                for column in range(row, m):
                    S[row, column] -= factor * S[k, column]
                for column in range(4):
                    rest[row, column] -= factor * rest[k, column]
        distances[j] = _without_point(rest, m)


def track_distances_numpy(
    r: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_calibration: FloatArray,
    frame: IntArray,
    starts: IntArray,
    covariance: FloatArray,
    distances: FloatArray,
) -> None:
    """`track_distances` in NumPy, in the null space of each feature (Mourikis & Roumeliotis)."""
    first = len(covariance) - by_calibration.shape[2]
    for j in range(len(distances)):
        rows = slice(starts[j], starts[j + 1])
        H = np.zeros((2 * (starts[j + 1] - starts[j]), len(covariance)))
        for k, i in enumerate(frame[rows]):
            H[2 * k : 2 * k + 2, 6 * i : 6 * i + 6] = by_pose[rows][k]
        H[:, first:] = by_calibration[rows].reshape(len(H), -1)
        null = np.linalg.qr(by_point[rows].reshape(-1, 3), mode="complete")[0][:, 3:]
        N, r_2 = null.T @ H, null.T @ r[rows].ravel()
        distances[j] = r_2 @ np.linalg.solve(N @ covariance @ N.T + np.eye(len(N)), r_2)
