# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What pairs of frames say of the rotations between them, with the directions eliminated.

A feature has the bearings f₁ and f₂ in the cameras of a pair, R turns the second camera into the
first, and t is the direction of the translation. The residual is t · (f₁ × R f₂) over its standard
deviation σ, σ² = σ₁² |R f₂ × t|² + σ₂² |f₁ × t|², under Cauchy's loss. For a given R the direction
is found by Gauss-Newton steps on the sphere, and then eliminated from the equations of R ⊕ δ.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["CAUCHY_WIDTH", "pair_equations", "pair_equations_numpy"]

CAUCHY_WIDTH = 2.4
"""Residual with half the weight, in units of the noise."""
_STEPS = 2
"""Gauss-Newton steps of the direction."""
_WEAK = 1e-3
"""Information on the direction that is added: without parallax there is none."""
_TINY = 1e-24
"""Least variance, and what keeps divisions finite."""


@compiled()
def _set_across(t: FloatArray, across: FloatArray) -> None:
    """Fill two unit vectors (2, 3) across a unit vector (3,)."""
    sign, scale = math.copysign(1.0, t[0]), 1.0 / (1.0 + abs(t[0]))
    for i in range(2):
        across[i, 0] = -sign * t[1 + i]
        for k in range(2):
            across[i, 1 + k] = (1.0 if i == k else 0.0) - t[1 + i] * t[1 + k] * scale


@compiled()
def _sum_up(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    R: FloatArray,
    t: FloatArray,
    across: FloatArray,
    H: FloatArray,
    squares: FloatArray,
) -> None:
    """Fill H (5, 6), by δ, the direction, and the gradient in column 5; and squares (N,)."""
    row, back, turned, normal = np.empty(6), np.empty(3), np.empty(3), np.empty(3)
    for i in range(5):
        for k in range(6):
            H[i, k] = 0.0
    for n in range(len(first)):
        e = of_first = of_second = 0.0
        for i in range(3):
            turned[i] = R[i, 0] * second[n, 0] + R[i, 1] * second[n, 1] + R[i, 2] * second[n, 2]
        for i in range(3):
            k, m = (i + 1) % 3, (i + 2) % 3
            normal[i] = first[n, k] * turned[m] - first[n, m] * turned[k]
            e += t[i] * normal[i]
            of_first += t[i] * turned[i]
            of_second += t[i] * first[n, i]
        variance = variances[n, 0] * (1.0 - of_first * of_first)
        variance = max(variance + variances[n, 1] * (1.0 - of_second * of_second), _TINY)
        squares[n] = e * e / (CAUCHY_WIDTH * CAUCHY_WIDTH * variance)
        weight = 1.0 / ((1.0 + squares[n]) * variance)
        for i in range(3):  # Rᵀ (t × f₁)
            back[i] = 0.0
            for k in range(3):
                p, q = (k + 1) % 3, (k + 2) % 3
                back[i] += R[k, i] * (t[p] * first[n, q] - t[q] * first[n, p])
        for i in range(3):
            k, m = (i + 1) % 3, (i + 2) % 3
            row[i] = second[n, k] * back[m] - second[n, m] * back[k]
        for i in range(2):
            row[3 + i] = (
                across[i, 0] * normal[0] + across[i, 1] * normal[1] + across[i, 2] * normal[2]
            )
        row[5] = e
        for i in range(5):
            for k in range(i, 6):
                H[i, k] += weight * row[i] * row[k]
    for i in range(5):
        for k in range(i):
            H[i, k] = H[k, i]
    H[3, 3] += _WEAK
    H[4, 4] += _WEAK


@compiled(
    "void(f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1],"
    " f8[::1])"
)
def pair_equations(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    begins: IntArray,
    R: FloatArray,
    t: FloatArray,
    equations: FloatArray,
    squares: FloatArray,
) -> None:
    """Fill information and gradient of the rotation of each pair.

    Args:
        first: (N, 3) bearings in the first frames, pair by pair.
        second: (N, 3) of the same features in the second ones.
        variances: (N, 2) of both, rad².
        begins: (P + 1,) first rows of the pairs, and N.
        R: (P, 3, 3) first_R_second.
        t: (P, 3) directions to begin with, of unit length; replaced by the best ones.
        equations: (P, 3, 4), filled: information and gradient of the robust cost, by R ⊕ δ.
        squares: (N,), filled: squared residuals, in units of the squared width of Cauchy's loss.
    """
    across, H = np.empty((2, 3)), np.empty((5, 6))
    for p in range(len(R)):
        rows = slice(begins[p], begins[p + 1])
        one, two, noises, of_pair = first[rows], second[rows], variances[rows], squares[rows]
        for step in range(_STEPS + 1):
            _set_across(t[p], across)
            _sum_up(one, two, noises, R[p], t[p], across, H, of_pair)
            determinant = H[3, 3] * H[4, 4] - H[3, 4] * H[4, 3]
            if step == _STEPS:
                for i in range(3):
                    a = (H[4, 4] * H[i, 3] - H[4, 3] * H[i, 4]) / determinant
                    b = (H[3, 3] * H[i, 4] - H[3, 4] * H[i, 3]) / determinant
                    for k in range(3):
                        equations[p, i, k] = H[i, k] - a * H[3, k] - b * H[4, k]
                    equations[p, i, 3] = H[i, 5] - a * H[3, 5] - b * H[4, 5]
                continue
            a = (H[3, 4] * H[4, 5] - H[4, 4] * H[3, 5]) / determinant
            b = (H[4, 3] * H[3, 5] - H[3, 3] * H[4, 5]) / determinant
            square = 0.0
            for i in range(3):
                t[p, i] += a * across[0, i] + b * across[1, i]
                square += t[p, i] * t[p, i]
            for i in range(3):
                t[p, i] /= math.sqrt(square)


def pair_equations_numpy(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    begins: IntArray,
    R: FloatArray,
    t: FloatArray,
    equations: FloatArray,
    squares: FloatArray,
) -> None:
    """`pair_equations` in NumPy."""
    for p in range(len(R)):
        rows = slice(int(begins[p]), int(begins[p + 1]))
        seen = first[rows], second[rows], variances[rows], R[p]
        for _ in range(_STEPS):
            H, across, _ = _sums(*seen, t[p])
            t[p] -= np.linalg.solve(H[3:, 3:5], H[3:, 5]) @ across
            t[p] /= np.linalg.norm(t[p])
        H, _, squares[rows] = _sums(*seen, t[p])
        equations[p] = (H[:3] - H[:3, 3:5] @ np.linalg.solve(H[3:, 3:5], H[3:]))[:, [0, 1, 2, 5]]


def _sums(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    R: FloatArray,
    t: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """H (5, 6), two unit vectors (2, 3) across t, and squares (N,) of a pair."""
    sign, scale = math.copysign(1.0, t[0]), 1.0 / (1.0 + abs(t[0]))
    across = np.column_stack([-sign * t[1:], np.eye(2) - scale * np.outer(t[1:], t[1:])])
    turned = second @ R.T
    normals, e = np.cross(first, turned), np.cross(first, turned) @ t
    sines = 1.0 - np.column_stack([turned @ t, first @ t]) ** 2
    variance = np.maximum(np.sum(variances * sines, axis=1), _TINY)
    squares = e**2 / (CAUCHY_WIDTH**2 * variance)
    weights = 1.0 / ((1.0 + squares) * variance)
    by_turn = np.cross(second, np.cross(t, first) @ R)
    J = np.column_stack([by_turn, normals @ across.T])
    H = J.T @ (np.column_stack([J, e]) * weights[:, None])
    H[[3, 4], [3, 4]] += _WEAK
    return H, across, squares
