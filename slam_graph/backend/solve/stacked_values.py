# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays of what GTSAM's values hold: poses of frames, positions of features."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.solve.state import INDEX_MASK, POINT_DIM, dim


def stacked_poses(values: gtsam.Values, frames: Iterable[int]) -> tuple[FloatArray, FloatArray]:
    """Rotations (F, 3, 3) and positions (F, 3) of the poses of some frames."""
    none = np.zeros((0, 4))
    matrices = np.concatenate([none, *(values.atPose3(X(i)).matrix() for i in frames)])
    matrices = matrices.reshape(-1, 4, 4)
    return matrices[:, :3, :3], matrices[:, :3, 3]


def stacked_points(values: gtsam.Values, features: IntArray) -> FloatArray:
    """Positions (J, 3) of some features.

    Raises:
        KeyError: if one is not among the values.
    """
    if len(features) == 0:
        return np.zeros((0, 3))
    keys = np.array(values.keys())
    first, end = keys.searchsorted((L(0), L(INDEX_MASK)))
    known = keys[first:end] - L(0)
    places = known.searchsorted(features)
    if len(known) == 0 or (known[np.minimum(places, len(known) - 1)] != features).any():
        raise KeyError(f"not all of the features {features.tolist()} are variables")
    # one by one they would take three times as long; these are all variables of three numbers, in
    # the order of keys
    before = sum(dim(key) == POINT_DIM for key in keys[:first].tolist())
    rows = gtsam.utilities.extractPoint3(values)[before + places]
    return np.ascontiguousarray(rows, dtype=np.float64)
