# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The seven degrees of freedom that no image sees: where the world is, how it is turned, its scale.

A similarity X ← s Q X + b of the world leaves all pixels as they are. Steps are therefore taken
without any part along its seven directions (inner constraints; Triggs, McLauchlan, Hartley &
Fitzgibbon 2000), and in the end the gauge of the start is restored: the first camera has its pose,
and the median distance of the points from it is what it was. Groups of cameras that have no point
in common have seven directions each.
"""

from __future__ import annotations

import numpy as np

from slam_graph.mapping.bal_problem import (
    CAMERA_DIM,
    BalEstimates,
    BalPart,
    FloatArray,
    IntArray,
)

GAUGE_DIM = 7


def gauge_directions(estimates: BalEstimates, groups: IntArray) -> FloatArray:
    """(9 C, 7 G) how the tangents of the cameras change with a similarity of each group.

    Of X ← (1 + σ)(I + [φ]ₓ) X + b it is δθ = -R φ and δt = σ t - R b.
    """
    C, G = len(groups), int(groups.max()) + 1
    R, rows = estimates.rotations, np.arange(C)
    directions = np.zeros((C, CAMERA_DIM, G, GAUGE_DIM))
    directions[rows, 0:3, groups, 0:3] = -R
    directions[rows, 3:6, groups, 3:6] = -R
    directions[rows, 3:6, groups, 6] = estimates.translations
    return directions.reshape(CAMERA_DIM * C, GAUGE_DIM * G)


def restored(part: BalPart, end: BalEstimates) -> BalEstimates:
    """Estimates of a part, moved by a similarity of each group into the gauge of its start."""
    start, problem = part.problem.estimates, part.problem
    group_of_point = np.zeros(problem.points, np.int64)
    group_of_point[problem.point] = part.groups[problem.camera]
    rotations, translations = end.rotations.copy(), end.translations.copy()
    points = end.points.copy()
    for group in range(int(part.groups.max()) + 1):
        cameras = np.flatnonzero(part.groups == group)
        rows, first = np.flatnonzero(group_of_point == group), cameras[0]
        scale = _median_distance(start, first, rows) / _median_distance(end, first, rows)
        R_0, t_0 = start.rotations[first], start.translations[first]
        Q = R_0.T @ end.rotations[first]
        b = R_0.T @ (scale * end.translations[first] - t_0)
        points[rows] = scale * end.points[rows] @ Q.T + b
        rotations[cameras] = end.rotations[cameras] @ Q.T
        translations[cameras] = scale * end.translations[cameras] - rotations[cameras] @ b
    return BalEstimates(rotations, translations, end.intrinsics, points)


def _median_distance(estimates: BalEstimates, camera: int, points: IntArray) -> float:
    """Of some points from a camera."""
    away = estimates.points[points] - estimates.centres()[camera]
    return float(np.median(np.linalg.norm(away, axis=1)))
