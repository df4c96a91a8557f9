# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 1 of pose-graph optimisation, cost construction: which edges count, and how much.

    c = ½ Σ ρ(‖Log(i_T_j⁻¹ T_i⁻¹ T_j)‖²_Ω)

over all edges, with a robust loss ρ on loop closures if one is asked for. The first pose of each
connected part is held by a prior, which defines the frame and costs nothing at a minimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.pose_graph.chordal import chordal_cost
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.gtsam_graph import (
    anchor_factors,
    edge_chi2,
    edge_factors,
    factor_graph,
    robust_estimator,
    values_of,
)
from slam_graph.pose_graph.pose_graph_policy import PoseGraphCostPolicy


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphCost:
    """A cost over all poses of a graph.

    Attributes:
        graph: the pose graph.
        policy: what is robust about it.
        rows: (K,) rows of the edges that are in the cost.
        edges: their K factors.
        anchors: priors that define the frame.
    """

    graph: PoseGraph
    policy: PoseGraphCostPolicy
    rows: IntArray
    edges: list[gtsam.NonlinearFactor]
    anchors: list[gtsam.NonlinearFactor]

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """All factors."""
        return factor_graph([*self.edges, *self.anchors])


def construct(graph: PoseGraph, policy: PoseGraphCostPolicy, weights: FloatArray) -> PoseGraphCost:
    """The cost of a graph.

    Args:
        graph: the pose graph.
        policy: a robust loss, or none.
        weights: (M,) factors on the information of the edges; those with none are left out.
    """
    rows = np.flatnonzero(weights > 0)
    scaled = graph.keep_edges(rows).weighted(weights[rows])
    factors = edge_factors(scaled, range(len(rows)))
    if policy.robust not in ("none", "gnc"):
        suspects = suspected(scaled, policy)
        width = robust_width(graph, policy)
        robust = edge_factors(scaled, suspects.tolist(), policy.robust, width)
        for row, factor in zip(suspects.tolist(), robust, strict=True):
            factors[row] = factor
    return PoseGraphCost(graph, policy, rows, factors, anchor_factors(graph))


def suspected(graph: PoseGraph, policy: PoseGraphCostPolicy) -> IntArray:
    """Rows of the edges that may be false."""
    return np.flatnonzero(~graph.is_odometry | (not policy.trust_odometry))


def robust_width(graph: PoseGraph, policy: PoseGraphCostPolicy) -> float:
    """The width of the robust loss: as said, or what true edges stay within."""
    if policy.robust_width is not None:
        return policy.robust_width
    squared = true_bound(graph, policy)
    return squared if policy.robust == "dcs" else float(np.sqrt(squared))


def true_bound(graph: PoseGraph, policy: PoseGraphCostPolicy) -> float:
    """The χ² quantile below which squared residuals of true edges stay."""
    return float(2.0 * gammaincinv(0.5 * graph.tangent_size, policy.confidence))


def loss_weights(cost: PoseGraphCost, poses: Poses) -> FloatArray:
    """(K,) weights that the robust loss gives to the edges of a cost, from 0 to 1."""
    weights = np.ones(len(cost.rows))
    policy = cost.policy
    if policy.robust in ("none", "gnc"):
        return weights
    estimator = robust_estimator(policy.robust, robust_width(cost.graph, policy))
    suspects = cost.rows[suspected(cost.graph.keep_edges(cost.rows), policy)]
    plain = edge_factors(cost.graph, suspects.tolist())
    lengths = np.sqrt(edge_chi2(plain, values_of(poses)))
    at = np.searchsorted(cost.rows, suspects)
    weights[at] = [estimator.weight(length) for length in lengths.tolist()]
    return weights


def chi2_table(
    graph: PoseGraph, poses: Poses, weights: FloatArray | None = None
) -> dict[str, float]:
    """What some poses cost in the conventions of three programs.

    Args:
        graph: the pose graph.
        poses: to judge.
        weights: (M,) of the edges; all 1 if not said.

    Returns:
        `gtsam_error` ½ Σ ‖Log‖²_Ω and `gtsam_chi2`, twice that; `g2o_chi2`, in 3D with the vector
        part of the quaternion instead of the angle; `sesync_objective`.
    """
    if weights is not None:
        rows = np.flatnonzero(weights > 0)
        graph = graph.keep_edges(rows).weighted(weights[rows])
    squared = edge_chi2(edge_factors(graph, range(len(graph.edges))), values_of(poses))
    return {
        "gtsam_error": 0.5 * float(squared.sum()),
        "gtsam_chi2": float(squared.sum()),
        "g2o_chi2": g2o_chi2(graph, poses),
        "sesync_objective": chordal_cost(graph, poses),
    }


def g2o_chi2(graph: PoseGraph, poses: Poses) -> float:
    """χ² with g2o's residuals: translation, and the angle or the vector part of a quaternion."""
    i, j = graph.edges.T
    error = graph.measured.inverse().compose(poses.select(i).inverse().compose(poses.select(j)))
    if graph.dimension == 2:
        turn = error.angles()[:, None]
    else:
        turn = Rotation.from_matrix(error.rotations).as_quat(canonical=True)[:, :3]
    residuals = np.hstack([error.translations, turn])
    return float(np.einsum("ni,nij,nj->", residuals, graph.information, residuals))
