# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Graduated non-convexity (GNC): true and false loop closures, classified with the poses.

Pairwise consistency of loop closures, from short cycles through the odometry between them. Two loop
closures (a, b) and (c, d) whose ends are near each other form a cycle a → b → d → c → a with the
odometry between b and d and between c and a. Composed, a cycle is the identity up to its noise,
which is small as long as the stretches of odometry are short. True loop closures of one revisit are
consistent; false ones are consistent with their neighbours only by chance (Mangelson, Dominic,
Eustice and Vasudevan 2018; here only neighbours are compared).

Graduated non-convexity (GNC): loop closures are classified while the poses are estimated. Yang,
Antonante, Tzoumas and Carlone 2020, with truncated least squares: updates of the edge weights and
of the poses alternate. With small μ all edges have some weight, whatever their residual; as μ
grows, the weights separate into 0 and 1 at the χ² bound. There are two differences to the paper:

- There is one Gauss-Newton step between two updates of the weights, and edges of zero weight are
  left out of it, which keeps the problem sparse.
- Where loop closures confirm each other, the first poses are the optimum of
  these alone, and μ starts larger. From odometry, hundreds of false loop closures would lead into
  wrong minima.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from slam_graph.arrays import BoolArray, FloatArray, IntArray
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
from slam_graph.pose_graph.pose_graph_policy import PoseGraphCostPolicy

_NEIGHBOURHOOD = 10
"""Two loop closures are compared if their ends are at most this many poses apart."""

_MIN_GROUP = 5
"""Least size of a connected group of consistent loop closures that confirm each other."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of neighbouring loop closures.

    Attributes:
        members: (P, 2) rows among the loop closures.
        consistent: (P,) whether the cycle of the pair closes.
    """

    members: IntArray
    consistent: BoolArray


def confirmed_loops(graph: PoseGraph, along_odometry: Poses, bound: float) -> IntArray:
    """Rows of the loop closures that are confirmed by others.

    A confirmed loop closure belongs to a connected group of at least `_MIN_GROUP` consistent ones,
    and is consistent with more of its neighbours than it is inconsistent with.

    Args:
        graph: the pose graph.
        along_odometry: poses composed along the odometry, as by `along_tree`.
        bound: largest χ² of a consistent cycle.
    """
    loops = np.flatnonzero(~graph.is_odometry)
    if len(loops) < _MIN_GROUP:
        return loops[:0]
    pairs, count = _compare(graph, loops, along_odometry, bound), len(loops)
    consistent, inconsistent = pairs.members[pairs.consistent], pairs.members[~pairs.consistent]
    links = coo_matrix((np.ones(len(consistent)), tuple(consistent.T)), shape=(count, count))
    group = connected_components(links, directed=False)[1]
    large = np.bincount(group)[group] >= _MIN_GROUP
    for_, against = (
        np.bincount(rows.ravel(), minlength=count) for rows in (consistent, inconsistent)
    )
    confirmed: IntArray = loops[large & (for_ > against)]
    return confirmed


def _compare(graph: PoseGraph, loops: IntArray, along: Poses, bound: float) -> _Pairs:
    """Test the cycles of all pairs of neighbouring loop closures."""
    ends, measured = _ordered(graph.edges[loops], graph.measured.select(loops))
    members = cKDTree(ends).query_pairs(_NEIGHBOURHOOD, p=np.inf, output_type="ndarray")
    noise = _Noise.of(graph, loops)
    (a, b), (c, d) = ends[members[:, 0]].T, ends[members[:, 1]].T
    chained = (noise.chain[a] == noise.chain[c]) & (noise.chain[b] == noise.chain[d])
    members, a, b, c, d = members[chained], a[chained], b[chained], c[chained], d[chained]
    first, second = measured.select(members[:, 0]), measured.select(members[:, 1])
    stretches = _between(along, b, d), _between(along, c, a)
    cycle = first.compose(stretches[0]).compose(second.inverse()).compose(stretches[1])
    # a rotation error anywhere moves the end of the cycle by at most half of its length
    lever = 0.5 * sum(np.linalg.norm(p.translations, axis=1) for p in (first, second, *stretches))
    of_R, of_t = noise.of_cycles(members, a, b, c, d)
    squared = cycle.angles() ** 2 / of_R + np.sum(cycle.translations**2, axis=1) / (
        of_t + of_R * lever**2
    )
    return _Pairs(members, squared < bound)


@dataclass(frozen=True, slots=True, eq=False)
class _Noise:
    """Variances, averaged over the axes of rotation (rad²) and translation (m²).

    Attributes:
        loops: (2, L) of the loop closures.
        odometry: (2, N) summed over the odometry up to each pose.
        chain: (N,) number of the unbroken chain of odometry of each pose.
    """

    loops: FloatArray
    odometry: FloatArray
    chain: IntArray

    @staticmethod
    def of(graph: PoseGraph, loops: IntArray) -> _Noise:
        d, covariance = graph.dimension, np.linalg.inv(graph.angle_information)
        axes = np.diagonal(covariance, axis1=1, axis2=2)
        variances = np.stack([axes[:, d:].mean(axis=1), axes[:, :d].mean(axis=1)])
        steps = np.full((2, len(graph.keys)), np.nan)
        odometry = graph.is_odometry
        steps[:, graph.edges[odometry].max(axis=1)] = variances[:, odometry]
        missing = np.isnan(steps[0])
        return _Noise(
            variances[:, loops], np.cumsum(np.nan_to_num(steps), axis=1), np.cumsum(missing)
        )

    def of_cycles(
        self, members: IntArray, a: IntArray, b: IntArray, c: IntArray, d: IntArray
    ) -> FloatArray:
        """(2, P) variances summed around each cycle."""
        odometry = self.odometry
        stretches = np.abs(odometry[:, b] - odometry[:, d]) + np.abs(
            odometry[:, a] - odometry[:, c]
        )
        summed: FloatArray = self.loops[:, members].sum(axis=2) + stretches
        return summed


def _ordered(ends: IntArray, measured: Poses) -> tuple[IntArray, Poses]:
    """Edges reversed where needed, so that the first end is the earlier pose."""
    back, inverse = ends[:, 0] > ends[:, 1], measured.inverse()
    return np.sort(ends, axis=1), Poses(
        np.where(back[:, None, None], inverse.rotations, measured.rotations),
        np.where(back[:, None], inverse.translations, measured.translations),
    )


def _between(poses: Poses, first: IntArray, second: IntArray) -> Poses:
    """Relative poses first_T_second."""
    return poses.select(first).inverse().compose(poses.select(second))


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
    plain, anchors = edge_factors(graph), anchor_factors(graph)
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
    factors = factor_graph([*edge_factors(weighted), *anchors])
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
