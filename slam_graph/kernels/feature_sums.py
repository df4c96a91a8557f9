# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Sums over the observations of features whose positions are eliminated.

What many features say of the poses together, by the Schur complement of their positions; and the
means of their residuals over blocks, as the noise of the pixels is read from them.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "block_sums",
    "block_sums_numpy",
    "extents",
    "extents_numpy",
    "sum_of_features",
    "sum_of_features_numpy",
]

_REGULARISATION = 1e-15
"""Information that is added to a feature, relative to what its observations say of it."""


@compiled()
def _orthonormalize(Q: FloatArray, m: int, R: FloatArray) -> None:
    """Make the columns of (m, 3) rows orthonormal; R (3, 3) is what they were multiplied with."""
    L, before = np.empty((3, 3)), np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            R[a, b] = 1.0 if a == b else 0.0
    for _ in range(2):
        s00 = s10 = s11 = s20 = s21 = s22 = 0.0
        for i in range(m):
            x, y, z = Q[i, 0], Q[i, 1], Q[i, 2]
            s00 += x * x
            s10 += y * x
            s11 += y * y
            s20 += z * x
            s21 += z * y
            s22 += z * z
        added = _REGULARISATION * (s00 + s11 + s22)
        l00 = math.sqrt(s00 + added)
        l10, l20 = s10 / l00, s20 / l00
        l11 = math.sqrt(s11 + added - l10 * l10)
        l21 = (s21 - l20 * l10) / l11
        l22 = math.sqrt(s22 + added - l20 * l20 - l21 * l21)
        L[0, 0], L[1, 0], L[1, 1] = l00, l10, l11
        L[2, 0], L[2, 1], L[2, 2] = l20, l21, l22
        i0, i1, i2 = 1.0 / l00, 1.0 / l11, 1.0 / l22
        for i in range(m):
            x = Q[i, 0] * i0
            y = (Q[i, 1] - l10 * x) * i1
            Q[i, 0], Q[i, 1], Q[i, 2] = x, y, (Q[i, 2] - l20 * x - l21 * y) * i2
        for a in range(3):
            for b in range(3):
                before[a, b] = R[a, b]
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
    products: FloatArray,
) -> None:
    """Eliminate the positions of J features, and add up the products of their rows.

    With H_f = Q R_f by two rounds of Cholesky QR and H = [H_x r], T = Qᵀ H. The information is
    Σ Hᵀ H - Tᵀ T; its second part is one product of matrices, best left to BLAS.

    Args:
        r: (N, 2) residuals of the observations, those of one feature after the other.
        by_pose: (N, 2, 6) their derivatives by the observing pose.
        by_point: (N, 2, 3) by the position of the feature.
        by_calibration: (N, 2, C) by the calibration.
        frame: (N,) number of the observing pose.
        starts: (J + 1,) first observation of each feature, and N.
        R_f: (J, 3, 3), filled: upper triangular.
        T: (J, 3, n + 1), filled; n = 6 F + C, of F poses and the calibration.
        products: (n + 1, n + 1), filled: Σ Hᵀ H.
    """
    width, C = len(products), by_calibration.shape[2]
    first = width - 1 - C
    for a in range(width):
        for b in range(width):
            products[a, b] = 0.0
    longest = 0
    for j in range(len(T)):
        longest = max(longest, starts[j + 1] - starts[j])
    Q, others = np.empty((2 * longest, 3)), np.empty(C + 1)
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
            pose, h = 6 * frame[n], by_pose[n, i]
            for k in range(C):
                others[k] = by_calibration[n, i, k]
            others[C] = r[n, i]
            for k in range(3):
                for a in range(6):
                    T[j, k, pose + a] += Q[row, k] * h[a]
                for a in range(C + 1):
                    T[j, k, first + a] += Q[row, k] * others[a]
            for a in range(6):
                for b in range(6):
                    products[pose + a, pose + b] += h[a] * h[b]
                for b in range(C + 1):
                    products[pose + a, first + b] += h[a] * others[b]
            for a in range(C + 1):
                for b in range(C + 1):
                    products[first + a, first + b] += others[a] * others[b]
    for a in range(width):
        for b in range(first, width):
            products[b, a] = products[a, b]


def sum_of_features_numpy(
    r: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_calibration: FloatArray,
    frame: IntArray,
    starts: IntArray,
    R_f: FloatArray,
    T: FloatArray,
    products: FloatArray,
) -> None:
    """`sum_of_features` in NumPy, feature by feature."""
    first = len(products) - 1 - by_calibration.shape[2]
    products[:] = 0.0
    for j in range(len(T)):
        rows = slice(starts[j], starts[j + 1])
        H = np.zeros((2 * (starts[j + 1] - starts[j]), len(products)))
        for k, i in enumerate(frame[rows]):
            H[2 * k : 2 * k + 2, 6 * i : 6 * i + 6] = by_pose[rows][k]
        H[:, first:-1] = by_calibration[rows].reshape(len(H), -1)
        H[:, -1] = r[rows].ravel()
        Q, R_f[j] = _orthonormalize_numpy(by_point[rows].reshape(-1, 3))
        T[j] = Q.T @ H
        products += H.T @ H


def _orthonormalize_numpy(Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    R = np.eye(3)
    for _ in range(2):
        squares = Q.T @ Q
        root = np.linalg.cholesky(squares + _REGULARISATION * np.trace(squares) * np.eye(3)).T
        Q, R = Q @ np.linalg.inv(root), root @ R
    return Q, R


@compiled("void(f8[:, :], i8[:], i8[::1], f8[:, ::1])")
def extents(pixels: FloatArray, camera: IntArray, starts: IntArray, diagonals: FloatArray) -> None:
    """How far J features move in the image of each camera: diagonals of boxes around them.

    Args:
        pixels: (N, 2) of the observations, those of one feature after the other.
        camera: (N,) camera of each observation.
        starts: (J + 1,) first observation of each feature, and N.
        diagonals: (J, C), filled; 0 where a camera does not see a feature.
    """
    for j in range(len(diagonals)):
        for c in range(diagonals.shape[1]):
            left = top = math.inf
            right = bottom = -math.inf
            for n in range(starts[j], starts[j + 1]):
                if camera[n] == c:
                    left, right = min(left, pixels[n, 0]), max(right, pixels[n, 0])
                    top, bottom = min(top, pixels[n, 1]), max(bottom, pixels[n, 1])
            width, height = max(right - left, 0.0), max(bottom - top, 0.0)
            diagonals[j, c] = math.sqrt(width * width + height * height)


def extents_numpy(
    pixels: FloatArray, camera: IntArray, starts: IntArray, diagonals: FloatArray
) -> None:
    """`extents` in NumPy."""
    for j, c in np.ndindex(diagonals.shape):
        rows = slice(starts[j], starts[j + 1])
        seen = pixels[rows][camera[rows] == c]
        diagonals[j, c] = np.linalg.norm(np.ptp(seen, axis=0)) if len(seen) else 0.0


@compiled("void(f8[:, ::1], f8[:, :, ::1], i8[:], i8[:], i8[::1], i8, f8[:, :, ::1])")
def block_sums(
    r: FloatArray,
    by_point: FloatArray,
    camera: IntArray,
    frame: IntArray,
    starts: IntArray,
    block: int,
    sums: FloatArray,
) -> None:
    """How large the means of residuals are over blocks of consecutive observations of a camera.

    With the whitened residuals e = P ε of a track, P = I - Q Qᵀ the projection off the directions
    H_f = Q R_f of its point, and the rows B that average over its blocks in one camera,
    S = B P Bᵀ for white noise, and D = B P K P Bᵀ for a random walk from frame to frame that all
    cameras share, K = min(i, j) for observations in frames i and j.

    Args:
        r: (N, 2) residuals of the observations, those of one feature after the other.
        by_point: (N, 2, 3) their derivatives by the position of the feature.
        camera: (N,) camera of each observation.
        frame: (N,) number of the frame of each observation, which ascends in each feature.
        starts: (J + 1,) first observation of each feature, and N.
        block: observations in a block; those that fill none are left out.
        sums: (4, J, C), filled: ‖B e‖², tr(S), tr(S²) and tr(D) of each feature in each camera; NaN
            where the observations of a feature do not determine its position.
    """
    longest = 0
    for j in range(len(starts) - 1):
        longest = max(longest, starts[j + 1] - starts[j])
    Q, R, e = np.empty((2 * longest, 3)), np.empty((3, 3)), np.empty(2 * longest)
    along, gram, means = np.empty(3), np.empty((3, 3)), np.empty((longest // block + 1, 2, 4))
    member, later = np.empty(longest, np.int64), np.empty(longest // block + 1)
    behind = np.empty((2, 3))
    for j in range(len(starts) - 1):
        begin, count = starts[j], starts[j + 1] - starts[j]
        for row in range(2 * count):
            for k in range(3):
                Q[row, k] = by_point[begin + row // 2, row % 2, k]
        _orthonormalize(Q, 2 * count, R)
        for k in range(3):
            along[k] = 0.0
            for row in range(2 * count):
                along[k] += Q[row, k] * r[begin + row // 2, row % 2]
        for row in range(2 * count):
            e[row] = r[begin + row // 2, row % 2]
            for k in range(3):
                e[row] -= Q[row, k] * along[k]
        for c in range(sums.shape[2]):
            blocks, filled, square = 0, 0, 0.0
            means[0], gram[:] = 0.0, 0.0  # gram is (B Q)ᵀ B Q
            for n in range(count):
                member[n] = -1
                if camera[begin + n] != c:
                    continue
                member[n] = blocks
                mean = means[blocks]
                for i in range(2):
                    mean[i, 3] += e[2 * n + i] / block
                    for k in range(3):
                        mean[i, k] += Q[2 * n + i, k] / block
                filled += 1
                if filled == block:
                    for i in range(2):
                        square += mean[i, 3] * mean[i, 3]
                        for k in range(3):
                            for m in range(3):
                                gram[k, m] += mean[i, k] * mean[i, m]
                    filled, blocks = 0, blocks + 1
                    means[blocks] = 0.0
            # S = I / block - B Q (B Q)ᵀ, with two rows for each block
            trace, squares = gram[0, 0] + gram[1, 1] + gram[2, 2], 0.0
            for k in range(3):
                for m in range(3):
                    squares += gram[k, m] * gram[k, m]
            sums[0, j, c] = square
            sums[1, j, c] = 2.0 * blocks / block - trace
            sums[2, j, c] = (2.0 * blocks / block - 2.0 * trace) / block + squares
            # D: a step of the walk moves all later observations
            walked, later[:], behind[:] = 0.0, 0.0, 0.0
            for n in range(count - 1, 0, -1):
                for i in range(2):
                    for k in range(3):
                        behind[i, k] += Q[2 * n + i, k]
                if 0 <= member[n] < blocks:
                    later[member[n]] += 1.0 / block
                elapsed = frame[begin + n] - frame[begin + n - 1]
                if elapsed == 0:
                    continue
                for b in range(blocks):
                    for axis in range(2):
                        for i in range(2):
                            moved = later[b] if i == axis else 0.0
                            for k in range(3):
                                moved -= means[b, i, k] * behind[axis, k]
                            walked += elapsed * moved * moved
            sums[3, j, c] = walked


def block_sums_numpy(
    r: FloatArray,
    by_point: FloatArray,
    camera: IntArray,
    frame: IntArray,
    starts: IntArray,
    block: int,
    sums: FloatArray,
) -> None:
    """`block_sums` in NumPy, by the definition."""
    for j in range(len(starts) - 1):
        rows = slice(starts[j], starts[j + 1])
        Q, _ = _orthonormalize_numpy(by_point[rows].reshape(-1, 3))
        P = np.eye(len(Q)) - Q @ Q.T
        K = np.kron(np.minimum.outer(frame[rows], frame[rows]) - frame[starts[j]], np.eye(2))
        for c in range(sums.shape[2]):
            seen = np.flatnonzero(camera[rows] == c)
            seen = seen[: len(seen) // block * block]
            averages = np.zeros((len(seen) // block, len(camera[rows])))
            averages[np.arange(len(seen)) // block, seen] = 1.0 / block
            B = np.kron(averages, np.eye(2))
            S, D = B @ P @ B.T, B @ P @ K @ P @ B.T
            means = B @ P @ r[rows].ravel()
            sums[:, j, c] = means @ means, np.trace(S), np.sum(S**2), np.trace(D)
