# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Many least-squares problems, a part of whose solution has a known length."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "constrained_solutions",
    "constrained_solutions_numpy",
    "secular_roots",
    "secular_roots_numpy",
]

_SWEEPS = 12
"""Most sweeps of Jacobi's rotations; they converge quadratically, after some four."""
_NEGLIGIBLE = 1e-300
"""Entries below this are taken for zero."""
_LEAST = 1e-12
"""A multiplier begins so far above the pole, relative to the largest eigenvalue."""


@compiled("void(f8[:, :], f8[:, :], f8, i8, f8[::1])")
def secular_roots(
    values: FloatArray, projected: FloatArray, length: float, steps: int, multipliers: FloatArray
) -> None:
    """Move multipliers up to the roots of ‖projected / (values + multiplier)‖ = length.

    Newton's method on the inverse length; a step that would lead down is not taken.

    Args:
        values: (S, 3) eigenvalues.
        projected: (S, 3) right-hand sides in the basis of the eigenvectors.
        length: of the solution.
        steps: how many are taken at most.
        multipliers: (S,) to begin with, left of the roots; those that were found afterwards.
    """
    for s in range(len(multipliers)):
        multiplier = multipliers[s]
        for _ in range(steps):
            square, slope = 0.0, 0.0
            for i in range(3):
                shifted = values[s, i] + multiplier
                g = projected[s, i] / shifted
                square += g * g
                slope += g * g / shifted
            step = (math.sqrt(square) / length - 1.0) * square / slope
            moved = multiplier + step
            if not step > 0.0 or moved == multiplier:
                break
            multiplier = moved
        multipliers[s] = multiplier


def secular_roots_numpy(
    values: FloatArray, projected: FloatArray, length: float, steps: int, multipliers: FloatArray
) -> None:
    """`secular_roots` in NumPy."""
    with np.errstate(all="ignore"):
        for _ in range(steps):
            shifted = values + multipliers[:, None]
            g = projected / shifted
            square, slope = np.sum(g**2, axis=1), np.sum(g**2 / shifted, axis=1)
            step = (np.sqrt(square) / length - 1.0) * square / slope
            multipliers += np.where(step > 0.0, step, 0.0)


@compiled()
def _eigenvectors(S: FloatArray, V: FloatArray) -> None:
    """Make a symmetric S (3, 3) diagonal by Jacobi's rotations; V (3, 3) has the eigenvectors."""
    for i in range(3):
        for k in range(3):
            V[i, k] = 1.0 if i == k else 0.0
    for sweep in range(3 * _SWEEPS):
        r = 2 - sweep % 3
        p, q = (r + 1) % 3, (r + 2) % 3
        if abs(S[p, q]) <= _NEGLIGIBLE:
            continue
        ratio = 0.5 * (S[q, q] - S[p, p]) / S[p, q]
        t = math.copysign(1.0, ratio) / (abs(ratio) + math.hypot(ratio, 1.0))
        c = 1.0 / math.hypot(t, 1.0)
        for i in range(3):
            x, y = S[i, p], S[i, q]
            S[i, p], S[i, q] = c * (x - t * y), c * (t * x + y)
        for i in range(3):
            x, y = S[p, i], S[q, i]
            S[p, i], S[q, i] = c * (x - t * y), c * (t * x + y)
            x, y = V[i, p], V[i, q]
            V[i, p], V[i, q] = c * (x - t * y), c * (t * x + y)
        S[p, q] = S[q, p] = 0.0


@compiled("void(f8[:, :, ::1], f8, f8, i8, f8[:, ::1])")
def constrained_solutions(
    M: FloatArray, length: float, ridge: float, steps: int, x: FloatArray
) -> None:
    """Solutions of least squares in v (3,) and g (3,) under |g| = length.

    The first part is eliminated; for the other it is a secular equation (see `secular_roots`).

    Args:
        M: (S, 7, 7) normal equations of v, g and the right-hand side; changed.
        length: of g.
        ridge: is added to the diagonal of v, in units of the trace of that of v and g.
        steps: to a multiplier, at most.
        x: (S, 6), filled; not finite where there is no solution.
    """
    count = len(M)
    values, projected = np.empty((count, 3)), np.empty((count, 3))
    vectors, multipliers, of_g = np.empty((count, 3, 3)), np.empty(count), np.empty((3, 3))
    for s in range(count):
        A = M[s]
        size = 0.0
        for i in range(6):
            size += A[i, i]
        for i in range(3):
            A[i, i] += ridge * size
        for k in range(3):  # Gauss: positive pivots
            for i in range(k + 1, 6):
                factor = A[i, k] / A[k, k]
                for j in range(k, 7):
                    A[i, j] -= factor * A[k, j]
        for i in range(3):
            for j in range(3):
                of_g[i, j] = A[3 + i, 3 + j]
        _eigenvectors(of_g, vectors[s])
        least, most = of_g[0, 0], _LEAST
        for i in range(3):
            values[s, i] = of_g[i, i]
            least, most = min(least, of_g[i, i]), max(most, of_g[i, i])
            projected[s, i] = 0.0
            for j in range(3):
                projected[s, i] += vectors[s, j, i] * A[3 + j, 6]
        multipliers[s] = _LEAST * most - least
    secular_roots(values, projected, length, steps, multipliers)
    for s in range(count):
        square = 0.0
        for i in range(3):
            projected[s, i] /= values[s, i] + multipliers[s]
            square += projected[s, i] * projected[s, i]
        for j in range(3):
            x[s, 3 + j] = 0.0
            for i in range(3):
                x[s, 3 + j] += vectors[s, j, i] * projected[s, i] * (length / math.sqrt(square))
        for i in range(2, -1, -1):
            rest = M[s, i, 6]
            for j in range(i + 1, 6):
                rest -= M[s, i, j] * x[s, j]
            x[s, i] = rest / M[s, i, i]


def constrained_solutions_numpy(
    M: FloatArray, length: float, ridge: float, steps: int, x: FloatArray
) -> None:
    """`constrained_solutions` in NumPy; M stays."""
    size = np.einsum("sii->s", M[:, :6, :6])[:, None, None]
    with np.errstate(all="ignore"):
        by_g = np.linalg.solve(M[:, :3, :3] + ridge * size * np.eye(3), M[:, :3, 3:])
        rest = M[:, 3:6, 3:] - M[:, 3:6, :3] @ by_g
        values, vectors = np.linalg.eigh(rest[:, :, :3])
        projected = np.einsum("sji,sj->si", vectors, rest[:, :, 3])
        multipliers = -values[:, 0] + _LEAST * np.maximum(values[:, 2], _LEAST)
        secular_roots_numpy(values, projected, length, steps, multipliers)
        g = projected / (values + multipliers[:, None])
        g *= length / np.linalg.norm(g, axis=1, keepdims=True)
        x[:, 3:] = np.einsum("sij,sj->si", vectors, g)
        x[:, :3] = by_g[:, :, 3] - np.einsum("sij,sj->si", by_g[:, :, :3], x[:, 3:])
