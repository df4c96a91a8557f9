# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Array types that all modules share, and the matrix of the cross product."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["BoolArray", "FloatArray", "IntArray", "skew"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def skew(v: FloatArray) -> FloatArray:
    """[v]ₓ (N, 3, 3) of vectors v (N, 3), so that [v]ₓ u = v × u."""
    return np.cross(v[:, None, :], -np.eye(3))
