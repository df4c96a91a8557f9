# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimisation: the loop of every algorithm here, with the policies of PGO.

Cost construction takes all poses and no features, Gauss-Newton goes on until convergence, and
nothing is marginalised, so that one pass of the loop is the whole algorithm. `marginal_covariances`
gives the uncertainty of the optimum.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.pose_graph.gnc import graduated_nonconvexity
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_cost import PoseGraphCost, construct, loss_weights
from slam_graph.pose_graph.graph_initialization import initialize
from slam_graph.pose_graph.graph_steps import minimize
from slam_graph.pose_graph.gtsam_graph import (
    ROTATION_FIRST,
    anchor_factors,
    edge_factors,
    factor_graph,
    values_of,
)
from slam_graph.pose_graph.pose_graph_policy import (
    PoseGraphCostPolicy,
    PoseGraphPolicy,
    PoseGraphSolution,
)


def optimize_pose_graph(
    graph: PoseGraph,
    policy: PoseGraphPolicy | None = None,
    diagnostics: Diagnostics | None = None,
) -> PoseGraphSolution:
    """Estimate all poses of a graph.

    Args:
        graph: poses and edges.
        policy: settings; the defaults if not given.
        diagnostics: counts what did not go as asked.

    Raises:
        DataError: if the graph does not allow the initialization that is asked for.
        EstimationError: if the cost cannot be minimised.
    """
    policy, diagnostics = policy or PoseGraphPolicy(), diagnostics or Diagnostics()
    start, weights = _initial_estimates(graph, policy.cost, diagnostics)

    # 1. Cost construction: all poses, no features.
    cost = construct(graph, policy.cost, weights)
    # 2. Gauss-Newton steps until convergence.
    minimum = minimize(cost, start, policy.gauss_newton, diagnostics)
    # 3. Marginalization: none, every pose stays.

    return PoseGraphSolution(graph, start, minimum, _weights(cost, minimum.poses, weights))


def _initial_estimates(
    graph: PoseGraph, policy: PoseGraphCostPolicy, diagnostics: Diagnostics
) -> tuple[Poses, FloatArray]:
    """Initial poses, and weights (M,) of the edges: 0 for those that `gnc` rejected."""
    if policy.robust == "gnc":
        try:
            return graduated_nonconvexity(graph, policy, diagnostics)
        except RuntimeError as error:
            reason = " ".join(str(error).split(".")[0].split())
            raise EstimationError(f"{graph.name}: gnc failed: {reason}") from error
    how = policy.initialization
    if how == "auto":
        how = "chordal" if policy.robust == "none" else "odometry"
    return initialize(graph, how, diagnostics), np.ones(len(graph.edges))


def _weights(cost: PoseGraphCost, poses: Poses, weights: FloatArray) -> FloatArray:
    """(M,) final weights of all edges, those of the robust loss included."""
    final = weights.copy()
    final[cost.rows] *= loss_weights(cost, poses)
    return final


def marginal_covariances(
    solution: PoseGraphSolution, rows: Sequence[int] | None = None
) -> FloatArray:
    """(K, k, k) marginal covariances of some poses, or of all.

    In the tangent at each pose, T exp(δ), in the order of files: translation (m), then rotation
    (rad), both in the frame of the pose. The first pose of each connected component is fixed: its
    covariance is zero.

    Args:
        solution: the optimum and the weights of its edges.
        rows: of the poses; all if not given.

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
