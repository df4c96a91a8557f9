# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The unit of length, where nothing measures it: the dynamics must not do so either.

One camera without an IMU leaves the unit of length free. Noise of the acceleration in fixed units
would measure it, as a smaller motion has smaller accelerations. A frame is linearised at the pose
that its images show, so the noise of that pose counts as an acceleration, and each frame would pull
the scale towards zero, with information that nothing gave.

So rows of the dynamics are projected: along the direction N that scales the path of the camera, its
velocity and all features, their derivative is taken away by that of the unit of length. This unit
is the distance of the features, as the harmonic mean; with the gradient g of its logarithm, for
which gᵀ N = 1, rows J become J - J N gᵀ. A motion of the whole world changes no distance, so what
the rows say of it stays. The noise itself is as configured, in the unit of the start.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.solve.layout_parts import LayoutParts
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import State, letter_and_index

_NEAREST = 0.1
"""Features count as if they were no nearer than this part of their median distance: one that is
misplaced beside the camera would be the unit."""


def without_scale(rows: FloatArray, state: State, layout: Layout, arm: FloatArray) -> FloatArray:
    """Rows of the dynamics that say nothing of the scale.

    Nothing is changed while no feature is a variable.

    Args:
        rows: (m, n + 1) [J -r] of the dynamics, J at the first estimates; changed in place.
        state: the variables.
        layout: their columns.
        arm: (3,) position of the camera in the body.
    """
    if not len(LayoutParts.of(layout).features):
        return rows
    scaling = scale_direction(state.first, layout, np.zeros(3), arm)
    rows[:, :-1] -= np.outer(rows[:, :-1] @ scaling, unit_gradient(state, layout, arm))
    return rows


def unit_gradient(state: State, layout: Layout, arm: FloatArray) -> FloatArray:
    """Derivative (n,) of the logarithm of the unit of length, at the first estimates.

    Args:
        state: the variables; features are seen from the newest pose.
        layout: their columns, at least one feature among them.
        arm: (3,) position of the camera in the body.
    """
    gradient, parts = np.zeros(layout.size), LayoutParts.of(layout)
    pose = max(key for key in parts.keys if letter_and_index(key)[0] == "x")
    seen_from = state.first_frames.atPose3(pose)
    away = state.positions_of(parts.features, first=True) - seen_from.transformFrom(arm)
    distances = np.sqrt(np.add.reduce(away**2, axis=1))
    weights = 1.0 / np.maximum(distances, _NEAREST * np.median(distances))
    by_point = away / distances[:, None] ** 2 * (weights / np.add.reduce(weights))[:, None]
    gradient[parts.of_points] = by_point
    in_body = seen_from.rotation().unrotate(np.add.reduce(by_point, axis=0))
    columns = layout.indices([pose])
    gradient[columns[:3]], gradient[columns[3:]] = -np.cross(arm, in_body), -in_body
    return gradient


def scale_direction(
    values: gtsam.Values, layout: Layout, centre: FloatArray, arm: FloatArray
) -> FloatArray:
    """Tangents (n,) of variables when the world is scaled about a point, as images allow it.

    They see the camera, whose place in the body is in metres and is not scaled: so it is the path
    of the camera that is scaled, and its velocity, and not those of the body.

    Args:
        values: of the variables, with the negative angular rate as the bias of a gyroscope.
        layout: their columns.
        centre: (3,) the point.
        arm: (3,) position of the camera in the body.
    """
    direction = np.zeros(layout.size)
    for key, columns in layout.columns.items():
        kind, frame = letter_and_index(key)
        if kind == "x":
            pose = values.atPose3(key)
            direction[columns][3:] = pose.rotation().unrotate(pose.transformFrom(arm) - centre)
        elif kind == "v":
            rate = -values.atConstantBias(B(frame)).gyroscope()
            turning = values.atPose3(X(frame)).rotation().rotate(np.cross(rate, arm))
            direction[columns] = values.atVector(key) + turning
        elif kind == "l":
            direction[columns] = values.atPoint3(key) - centre
    return direction
