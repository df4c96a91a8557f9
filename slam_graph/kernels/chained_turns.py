# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations one after the other: thousands of samples of a gyroscope at once."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["chain_turns", "chain_turns_numpy"]


@compiled("void(f8[:, :, ::1], f8[:, :, ::1])")
def chain_turns(turns: FloatArray, rotations: FloatArray) -> None:
    """The products of the first turns.

    Args:
        turns: (N, 3, 3).
        rotations: (N + 1, 3, 3), filled; the first is the identity.
    """
    rotations[0] = 0.0
    for k in range(3):
        rotations[0, k, k] = 1.0
    for n in range(len(turns)):
        before, turn, after = rotations[n], turns[n], rotations[n + 1]
        for i in range(3):
            for j in range(3):
                first, second = before[i, 0] * turn[0, j], before[i, 1] * turn[1, j]
                after[i, j] = first + second + before[i, 2] * turn[2, j]


def chain_turns_numpy(turns: FloatArray, rotations: FloatArray) -> None:
    """`chain_turns` in NumPy."""
    rotations[0] = np.eye(3)
    for before, turn, after in zip(rotations[:-1], turns, rotations[1:], strict=True):
        after[:] = before @ turn
