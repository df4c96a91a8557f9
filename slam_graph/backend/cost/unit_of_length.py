# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The dynamics where nothing measures lengths: their noise is in the unit of what is seen.

One camera without an IMU leaves the unit of length free. Noise of the acceleration in fixed units
would measure it, as a smaller motion has smaller accelerations: along the direction N that scales
the motion and all features, a whitened residual r has the derivative J N = r. A frame is linearised
at the pose that its images show. Its noise counts as an acceleration there, so that each frame
pulls the scale towards zero, with information that nothing gave.

So the standard deviation of the noise is σ s, where s is the unit: the distance of the features,
as the harmonic mean. The derivative of e / (σ s) is J - r gᵀ, where g is that of log s. Since
gᵀ N = 1 it is zero along N. A motion of the whole world changes no distance, so that what the
dynamics say of the other directions stays as it was.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.solve.layout_parts import LayoutParts
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import State, letter_and_index


def in_the_unit(rows: FloatArray, state: State, layout: Layout, arm: FloatArray) -> FloatArray:
    """Rows of the dynamics whose noise is a multiple of the unit of length.

    Args:
        rows: (m, n + 1) [J -r] of the dynamics, whitened; changed in place.
        state: the variables.
        layout: their columns.
        arm: (3,) position of the camera in the body.
    """
    rows[:, :-1] += np.outer(rows[:, -1], unit_gradient(state, layout, arm))
    return rows


def unit_gradient(state: State, layout: Layout, arm: FloatArray) -> FloatArray:
    """Derivative (n,) of the logarithm of the unit of length, at the first estimates.

    Features are seen from the newest pose. It is zero while none is a variable.
    """
    gradient, parts = np.zeros(layout.size), LayoutParts.of(layout)
    if not len(parts.features):
        return gradient
    pose = max(key for key in parts.keys if letter_and_index(key)[0] == "x")
    seen_from = state.first_frames.atPose3(pose)
    away = state.positions_of(parts.features, first=True) - seen_from.transformFrom(arm)
    distances = np.sqrt(np.add.reduce(away**2, axis=1))
    by_point = away / distances[:, None] ** 3 / np.add.reduce(1.0 / distances)
    gradient[parts.of_points] = by_point
    in_body = seen_from.rotation().unrotate(np.add.reduce(by_point, axis=0))
    columns = layout.indices([pose])
    gradient[columns[:3]], gradient[columns[3:]] = -np.cross(arm, in_body), -in_body
    return gradient
