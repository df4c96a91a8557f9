# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Graduated non-convexity (GNC): loop closures are classified while the poses are estimated.

Yang, Antonante, Tzoumas and Carlone 2020, with truncated least squares: updates of the edge weights
and of the poses alternate. With small μ all edges have some weight, whatever their residual; as μ
grows, the weights separate into 0 and 1 at the χ² bound. There are two differences to the paper:

- There is one Gauss-Newton step between two updates of the weights, and edges of zero weight are
  left out of it, which keeps the problem sparse.
- Where loop closures confirm each other (`loop_consistency.py`), the first poses are the optimum of
  these alone, and μ starts larger. From odometry, hundreds of false loop closures would lead into
  wrong minima.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_cost import inlier_bound, uncertain_edges
from slam_graph.pose_graph.graph_initialization import along_tree, initialize, tree_edges
from slam_graph.pose_graph.gtsam_graph import (
    anchor_factors,
    edge_chi2,
    edge_factors,
    factor_graph,
    poses_of,
    values_of,
)
from slam_graph.pose_graph.loop_consistency import confirmed_loops
from slam_graph.pose_graph.pose_graph_policy import PoseGraphCostPolicy

_CONTROL_FACTOR = 1.4
"""Growth of μ from one update of the weights to the next, as in the paper."""

_CONTROL_AFTER_CONFIRMATION = 0.1
"""First μ with confirmed loop closures: residuals of up to 3.3 times the bound have weight."""

_MAX_UPDATES = 100

_MIN_TREE_WEIGHT = 1e-6
"""Least weight of an uncertain edge without which the graph would not be connected."""


def graduated_nonconvexity(
    graph: PoseGraph, policy: PoseGraphCostPolicy, diagnostics: Diagnostics
) -> tuple[Poses, FloatArray]:
    """Poses, and weights (M,) of the edges: 1 for inliers, 0 for outliers.

    Raises:
        RuntimeError: if a step has no solution.
    """
    bound = inlier_bound(graph, policy)
    uncertain = uncertain_edges(graph, policy)
    weights, least = np.ones(len(graph.edges)), np.zeros(len(graph.edges))
    least[tree_edges(graph)] = _MIN_TREE_WEIGHT
    plain, anchors = edge_factors(graph, range(len(graph.edges))), anchor_factors(graph)
    values, control = _start(graph, policy, anchors, diagnostics)
    for _ in range(_MAX_UPDATES):
        squared = edge_chi2(plain, values)[uncertain]
        if control is None:
            control = bound / max(2.0 * squared.max(initial=0.0) - bound, 1e-3 * bound)
        weights[uncertain] = _truncated_weights(squared, bound, control)
        if np.isin(weights, (0.0, 1.0)).all():
            break
        control *= _CONTROL_FACTOR
        values = _step(graph, np.maximum(weights, least), anchors, values)
    else:
        diagnostics.warn(
            "pose_graph_gnc_undecided", f"{graph.name}: gnc ended with weights other than 0 and 1"
        )
    rejected = int(np.count_nonzero(weights < 0.5))
    if rejected:
        diagnostics.counts["pose_graph_edge_rejected"] += rejected
    return poses_of(values, graph.dimension), np.maximum(np.round(weights), least)


def _truncated_weights(squared: FloatArray, bound: float, control: float) -> FloatArray:
    """Weights of truncated least squares at μ = control (Yang et al. 2020, equation 14).

    Args:
        squared: squared whitened residuals.
        bound: the largest squared residual of an inlier.
        control: μ.
    """
    between = np.sqrt(bound * control * (control + 1.0) / np.maximum(squared, 1e-300)) - control
    within = squared <= bound * control / (control + 1.0)
    beyond = squared >= bound * (control + 1.0) / control
    weights: FloatArray = np.where(within, 1.0, np.where(beyond, 0.0, np.clip(between, 0.0, 1.0)))
    return weights


def _start(
    graph: PoseGraph,
    policy: PoseGraphCostPolicy,
    anchors: list[gtsam.NonlinearFactor],
    diagnostics: Diagnostics,
) -> tuple[gtsam.Values, float | None]:
    """Initial poses, and the first μ, or None where it follows from the residuals."""
    if policy.initialization != "auto":
        return values_of(initialize(graph, policy.initialization, diagnostics)), None
    if not policy.trust_odometry:
        return values_of(initialize(graph, "chordal", diagnostics)), None
    along = along_tree(graph)
    confirmed = confirmed_loops(graph, along, inlier_bound(graph, policy))
    if len(confirmed) == 0:
        return values_of(along), None
    weights = graph.is_odometry.astype(float)
    weights[np.concatenate([confirmed, tree_edges(graph)])] = 1.0
    poses = initialize(graph.keep_edges(weights > 0), "chordal", diagnostics)
    return _step(graph, weights, anchors, values_of(poses)), _CONTROL_AFTER_CONFIRMATION


def _step(
    graph: PoseGraph,
    weights: FloatArray,
    anchors: list[gtsam.NonlinearFactor],
    values: gtsam.Values,
) -> gtsam.Values:
    """One Gauss-Newton step on the edges of positive weight; damped if the problem is singular."""
    rows = np.flatnonzero(weights > 0)
    weighted = graph.keep_edges(rows).weighted(weights[rows])
    factors = factor_graph([*edge_factors(weighted, range(len(rows))), *anchors])
    try:
        return _one_step(gtsam.GaussNewtonOptimizer, gtsam.GaussNewtonParams(), factors, values)
    except RuntimeError:  # too poorly conditioned without damping
        return _one_step(
            gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams(), factors, values
        )


def _one_step(
    optimizer_of: Callable[..., Any],
    parameters: Any,
    factors: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
) -> gtsam.Values:
    """The values after one step of an optimizer of GTSAM."""
    parameters.setOrderingType("COLAMD")
    optimizer = optimizer_of(factors, values, parameters)
    optimizer.iterate()
    return gtsam.Values(optimizer.values())
