# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimisation: the loop of every algorithm here, with the policies of PGO.

Cost construction takes all poses and no features, Gauss-Newton goes on until convergence, and
nothing is marginalised, so that one pass of the loop is all there is.
"""

from __future__ import annotations

import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.mapping.pose_graph import FloatArray, PoseGraph, Poses
from slam_graph.mapping.pose_graph_cost import PoseGraphCost, construct, loss_weights
from slam_graph.mapping.pose_graph_gnc import graduated_nonconvexity
from slam_graph.mapping.pose_graph_initialization import initialize
from slam_graph.mapping.pose_graph_policy import (
    PoseGraphCostPolicy,
    PoseGraphPolicy,
    PoseGraphSolution,
)
from slam_graph.mapping.pose_graph_steps import minimize


def optimize_pose_graph(
    graph: PoseGraph,
    policy: PoseGraphPolicy | None = None,
    diagnostics: Diagnostics | None = None,
) -> PoseGraphSolution:
    """Estimate all poses of a graph.

    Args:
        graph: poses and edges.
        policy: how; the defaults if not said.
        diagnostics: counts what did not go as asked.

    Raises:
        DataError: if the graph does not allow the initialization that is asked for.
        EstimationError: if the cost cannot be minimised.
    """
    policy, diagnostics = policy or PoseGraphPolicy(), diagnostics or Diagnostics()
    start, weights = first_estimates(graph, policy.cost, diagnostics)

    # 1. Cost construction: all poses, no features.
    cost = construct(graph, policy.cost, weights)
    # 2. Gauss-Newton steps until convergence.
    minimum = minimize(cost, start, policy.gauss_newton, diagnostics)
    # 3. Marginalization: none, every pose stays.

    return PoseGraphSolution(graph, start, minimum, _weights(cost, minimum.poses, weights))


def first_estimates(
    graph: PoseGraph, policy: PoseGraphCostPolicy, diagnostics: Diagnostics
) -> tuple[Poses, FloatArray]:
    """Where the steps begin, and weights (M,) of the edges: 0 for what `gnc` has rejected."""
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
    """Weights of all edges at the end, those of a robust loss included."""
    final = weights.copy()
    final[cost.rows] *= loss_weights(cost, poses)
    return final
