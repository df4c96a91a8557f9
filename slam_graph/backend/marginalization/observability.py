# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The unobservable directions: global position and heading.

Neither cameras nor an IMU measure them, so a prior must not gain information along these four
directions. First-estimates Jacobians prevent that (`state.py`). Where linearisation points must
move after all, `relinearized` changes the prior by the least that keeps its information along the
directions as it was: at the new points the same as at the old ones (the idea of observability
constraints, Huang, Mourikis & Roumeliotis 2010; Hesch et al. 2014).
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import State

UP = np.array([0.0, 0.0, 1.0])


def unobservable_directions(values: gtsam.Values, layout: Layout) -> FloatArray:
    """Tangents (n, 4) of a shift (m) of the world along x, y, z, and of a turn (rad) about z."""
    directions = np.zeros((layout.size, 4))
    for key, columns in layout.columns.items():
        kind, block = chr(gtsam.Symbol(key).chr()), directions[columns]
        if kind == "x":
            pose = values.atPose3(key)
            body_R_world = pose.rotation().matrix().T
            block[3:, :3] = body_R_world
            block[:3, 3] = body_R_world @ UP
            block[3:, 3] = body_R_world @ np.cross(UP, pose.translation())
        elif kind == "v":
            block[:, 3] = np.cross(UP, values.atVector(key))
        elif kind == "l":
            block[:, :3] = np.eye(3)
            block[:, 3] = np.cross(UP, values.atPoint3(key))
    return directions


def relinearized(prior: SquareRootInformation, state: State) -> SquareRootInformation:
    """Move all linearisation points to the estimates without gaining unobservable information.

    Args:
        prior: over an increment of the current estimates.
        state: its linearisation points move.
    """
    before = unobservable_directions(state.first, prior.layout)
    state.rebase()
    after = unobservable_directions(state.first, prior.layout)
    Rd = prior.Rd.copy()
    correction = np.linalg.solve(after.T @ after, after.T)
    Rd[:-1, :-1] += prior.R @ (before - after) @ correction
    return SquareRootInformation(prior.layout, triangularize(Rd))
