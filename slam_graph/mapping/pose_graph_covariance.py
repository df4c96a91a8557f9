# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How well the poses of a pose graph are known, relative to the first one."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam_graph.errors import EstimationError
from slam_graph.mapping.native_pose_graph import (
    ROTATION_FIRST,
    anchor_factors,
    edge_factors,
    factor_graph,
    values_of,
)
from slam_graph.mapping.pose_graph import FloatArray
from slam_graph.mapping.pose_graph_policy import PoseGraphSolution


def marginal_covariances(
    solution: PoseGraphSolution, rows: Sequence[int] | None = None
) -> FloatArray:
    """(K, k, k) covariances of some poses, or of all.

    They belong to a tangent at each pose, T exp(δ), in the order of files: translation (m), then
    rotation (rad), both in the frame of the pose. The first pose of each connected part is held, so
    that its covariance is zero.

    Args:
        solution: the optimum, and the weights of the edges there.
        rows: of the poses; all if not said.

    Raises:
        EstimationError: if a pose is not determined.
    """
    weighted = solution.weighted_graph()
    factors = edge_factors(weighted, range(len(weighted.edges)))
    held = factor_graph([*factors, *anchor_factors(weighted, held=True)])
    rows = range(len(solution.poses)) if rows is None else rows
    try:
        marginals = gtsam.Marginals(held, values_of(solution.poses))
        found = np.array([marginals.marginalCovariance(row) for row in rows])
    except RuntimeError as error:
        raise EstimationError(f"{solution.graph.name}: a pose is not determined") from error
    if solution.graph.dimension == 3:
        translation_first = np.argsort(ROTATION_FIRST)
        found = found[:, translation_first[:, None], translation_first]
    return found
