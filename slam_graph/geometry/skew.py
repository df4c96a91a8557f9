# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matrices of cross products."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def skew(v: FloatArray) -> FloatArray:
    """[v]ₓ (N, 3, 3) of vectors v (N, 3), so that [v]ₓ u = v × u."""
    return np.cross(v[:, None, :], -np.eye(3))
