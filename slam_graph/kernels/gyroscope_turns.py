# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations of an integrated gyroscope at many times, and those of rotation vectors."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["orientations_at", "orientations_at_numpy", "turn_matrices", "turn_matrices_numpy"]

_SMALL = 1e-4
"""Angle below which series take the place of quotients, rad."""


@compiled()
def _set_turn(x: float, y: float, z: float, R: FloatArray) -> None:
    """Fill the matrix (3, 3) of a rotation vector (Rodrigues)."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    sine, versine = 1.0 - square / 6.0, 0.5 - square / 24.0
    if angle > _SMALL:
        half = math.sin(0.5 * angle) / angle
        sine, versine = math.sin(angle) / angle, 2.0 * half * half
    a, b, c = versine * x, versine * y, versine * z
    R[0, 0], R[1, 1], R[2, 2] = 1.0 - b * y - c * z, 1.0 - a * x - c * z, 1.0 - a * x - b * y
    R[0, 1], R[1, 0] = a * y - sine * z, a * y + sine * z
    R[0, 2], R[2, 0] = a * z + sine * y, a * z - sine * y
    R[1, 2], R[2, 1] = b * z - sine * x, b * z + sine * x


@compiled("void(f8[:, ::1], f8[:, :, ::1])")
def turn_matrices(vectors: FloatArray, R: FloatArray) -> None:
    """Fill the matrices of rotation vectors.

    Args:
        vectors: (N, 3), rad.
        R: (N, 3, 3), filled.
    """
    for n in range(len(vectors)):
        _set_turn(vectors[n, 0], vectors[n, 1], vectors[n, 2], R[n])


@compiled("void(f8[::1], f8[:, ::1], f8[:, :, ::1], f8[::1], f8[:, :, ::1])")
def orientations_at(
    times: FloatArray, rates: FloatArray, chained: FloatArray, at: FloatArray, R: FloatArray
) -> None:
    """Fill orientations at any times, under rates that are lines between the samples.

    Beyond the last sample its rate lasts, and before the first that one.

    Args:
        times: (M,) of the samples, ascending, s.
        rates: (M, 3) rad/s.
        chained: (M, 3, 3) orientations at the samples.
        at: (N,) times, s.
        R: (N, 3, 3), filled.
    """
    turn, last = np.empty((3, 3)), len(times) - 1
    for n in range(len(at)):
        row, end = 0, last + 1  # of the last sample that is not later
        while end - row > 1:
            middle = (row + end) // 2
            if times[middle] <= at[n]:
                row = middle
            else:
                end = middle
        seconds, part = at[n] - times[row], 0.0
        if row < last and seconds > 0.0:
            part = seconds / (times[row + 1] - times[row])
        following = min(row + 1, last)
        by = 0.5 * part * seconds
        x = rates[row, 0] * seconds + (rates[following, 0] - rates[row, 0]) * by
        y = rates[row, 1] * seconds + (rates[following, 1] - rates[row, 1]) * by
        z = rates[row, 2] * seconds + (rates[following, 2] - rates[row, 2]) * by
        _set_turn(x, y, z, turn)
        for i in range(3):
            for k in range(3):
                R[n, i, k] = (
                    chained[row, i, 0] * turn[0, k]
                    + chained[row, i, 1] * turn[1, k]
                    + chained[row, i, 2] * turn[2, k]
                )


def turn_matrices_numpy(vectors: FloatArray, R: FloatArray) -> None:
    """`turn_matrices` in NumPy."""
    from scipy.spatial.transform import Rotation  # what few processes need

    R[:] = Rotation.from_rotvec(vectors).as_matrix()


def orientations_at_numpy(
    times: FloatArray, rates: FloatArray, chained: FloatArray, at: FloatArray, R: FloatArray
) -> None:
    """`orientations_at` in NumPy."""
    row = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)
    now = np.column_stack([np.interp(at, times, axis) for axis in rates.T])
    turn_matrices_numpy(0.5 * (rates[row] + now) * (at - times[row])[:, None], R)
    R[:] = chained[row] @ R
