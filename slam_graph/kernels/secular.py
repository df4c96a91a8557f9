# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Lagrange multipliers of many least-squares problems whose solution has a known length."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["secular_roots", "secular_roots_numpy"]


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
