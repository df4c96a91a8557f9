# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 1 of pose-graph optimisation, cost construction: which edges count, and how much.

    c = ½ Σ ρ(‖Log(i_T_j⁻¹ T_i⁻¹ T_j)‖²_Ω)

over all edges, with a robust loss ρ on loop closures if one is chosen. A prior on the first pose of
each connected component fixes the gauge; it is zero at a minimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_initialization import chordal_cost
from slam_graph.pose_graph.gtsam_graph import (
    anchor_factors,
    edge_chi2,
    edge_factors,
    factor_graph,
    robust_estimator,
    values_of,
)
from slam_graph.pose_graph.pose_graph_policy import PoseGraphCostPolicy

_SMALL_ANGLE = 1e-4
"""Below this angle the series of ½θ cot ½θ has a smaller error than the quotient."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphCost:
    """The cost of a pose graph.

    Attributes:
        graph: the pose graph.
        policy: the robust loss.
        rows: (K,) rows of the edges that are in the cost.
        edges: their K factors.
        anchors: priors that fix the gauge.
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
        policy: the robust loss.
        weights: (M,) factors on the information of the edges; edges of weight 0 are left out.
    """
    rows = np.flatnonzero(weights > 0)
    scaled = graph.keep_edges(rows).weighted(weights[rows])
    factors = edge_factors(scaled)
    if policy.robust not in ("none", "gnc"):
        uncertain = uncertain_edges(scaled, policy)
        width = _robust_width(graph, policy)
        robust = edge_factors(scaled.keep_edges(uncertain), policy.robust, width)
        for row, factor in zip(uncertain.tolist(), robust, strict=True):
            factors[row] = factor
    return PoseGraphCost(graph, policy, rows, factors, anchor_factors(graph))


def uncertain_edges(graph: PoseGraph, policy: PoseGraphCostPolicy) -> IntArray:
    """Rows of the edges that may be outliers."""
    return np.flatnonzero(~graph.is_odometry | (not policy.trust_odometry))


def _robust_width(graph: PoseGraph, policy: PoseGraphCostPolicy) -> float:
    """The width of the robust loss: as set, or the bound of inliers."""
    if policy.robust_width is not None:
        return policy.robust_width
    squared = inlier_bound(graph, policy)
    return squared if policy.robust == "dcs" else float(np.sqrt(squared))


def inlier_bound(graph: PoseGraph, policy: PoseGraphCostPolicy) -> float:
    """The χ² quantile of the squared residual of an inlier."""
    return float(2.0 * gammaincinv(0.5 * graph.tangent_size, policy.confidence))


def loss_weights(cost: PoseGraphCost, poses: Poses) -> FloatArray:
    """(K,) weights of the edges of a cost under its robust loss, from 0 to 1."""
    weights = np.ones(len(cost.rows))
    policy = cost.policy
    if policy.robust in ("none", "gnc"):
        return weights
    estimator = robust_estimator(policy.robust, _robust_width(cost.graph, policy))
    uncertain = cost.rows[uncertain_edges(cost.graph.keep_edges(cost.rows), policy)]
    plain = edge_factors(cost.graph.keep_edges(uncertain))
    lengths = np.sqrt(edge_chi2(plain, values_of(poses)))
    at = np.searchsorted(cost.rows, uncertain)
    weights[at] = [estimator.weight(length) for length in lengths.tolist()]
    return weights


def chi2_of_edges(graph: PoseGraph, poses: Poses) -> FloatArray:
    """(M,) squared whitened residual of each edge, without a robust loss, as GTSAM's factors."""
    residuals = _logarithms(_errors(graph, poses))
    squared: FloatArray = np.einsum(
        "ni,nij,nj->n", residuals, graph.angle_information, residuals, optimize=True
    )
    return squared


def _errors(graph: PoseGraph, poses: Poses) -> Poses:
    """M poses i_T_j⁻¹ T_i⁻¹ T_j, the identity where an edge agrees with its poses."""
    i, j = graph.edges.T
    return graph.measured.inverse().compose(poses.select(i).inverse().compose(poses.select(j)))


def _logarithms(errors: Poses) -> FloatArray:
    """(M, 3 or 6) logarithms, translation before rotation.

    With θ the angle of R and a = ½θ cot ½θ, that of (R, t) has the translation a t - ½ ω × t
    in 2D, where ω × t = θ (-t_y, t_x); in 3D (1 - a)/θ² ω (ω·t) is added.
    """
    t = errors.translations
    if errors.dimension == 2:
        θ = errors.angles()
        turned = np.stack([-t[:, 1], t[:, 0]], axis=1) * θ[:, None]
        moved = _half_cotangent(θ)[:, None] * t - 0.5 * turned
        return np.column_stack([moved, θ])
    ω = Rotation.from_matrix(errors.rotations).as_rotvec()
    θ = np.linalg.norm(ω, axis=1)
    a = _half_cotangent(θ)
    small = θ < _SMALL_ANGLE
    factor = np.where(small, 1.0 / 12.0, (1.0 - a) / np.where(small, 1.0, θ) ** 2)
    along = (factor * np.sum(ω * t, axis=1))[:, None] * ω
    return np.hstack([a[:, None] * t - 0.5 * np.cross(ω, t) + along, ω])


def _half_cotangent(θ: FloatArray) -> FloatArray:
    """½θ cot ½θ."""
    small = np.abs(θ) < _SMALL_ANGLE
    half = 0.5 * np.where(small, 1.0, θ)
    cotangent: FloatArray = np.where(small, 1.0 - θ**2 / 12.0, half / np.tan(half))
    return cotangent


def chi2_table(
    graph: PoseGraph, poses: Poses, weights: FloatArray | None = None
) -> dict[str, float]:
    """χ² of some poses in the conventions of three programs.

    Args:
        graph: the pose graph.
        poses: to evaluate.
        weights: (M,) of the edges; all 1 if not given.

    Returns:
        `gtsam_error` ½ Σ ‖Log‖²_Ω and `gtsam_chi2`, twice that; `g2o_chi2`, in 3D with the vector
        part of the quaternion instead of the angle; `sesync_objective`.
    """
    if weights is not None:
        rows = np.flatnonzero(weights > 0)
        graph = graph.keep_edges(rows).weighted(weights[rows])
    squared = chi2_of_edges(graph, poses)
    return {
        "gtsam_error": 0.5 * float(squared.sum()),
        "gtsam_chi2": float(squared.sum()),
        "g2o_chi2": _g2o_chi2(graph, poses),
        "sesync_objective": chordal_cost(graph, poses),
    }


def _g2o_chi2(graph: PoseGraph, poses: Poses) -> float:
    """χ² with g2o's residuals: translation, and the angle or the vector part of a quaternion."""
    error = _errors(graph, poses)
    if graph.dimension == 2:
        turn = error.angles()[:, None]
    else:
        turn = Rotation.from_matrix(error.rotations).as_quat(canonical=True)[:, :3]
    residuals = np.hstack([error.translations, turn])
    return float(np.einsum("ni,nij,nj->", residuals, graph.information, residuals))
