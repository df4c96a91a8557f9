# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Reprojection factors of whole features: linearised, and reduced by null space or Schur.

What many features say of the poses together, by the Schur complement of their positions. The null-
space form (`feature_factors.py`) keeps the rows of each feature apart, as the gate needs them.
Where only their sum is needed, it is cheaper to form it. With the residuals r = H_x δx + H_f δf of
a feature and H_f = Q R_f, Q having three orthonormal columns,

    T = Qᵀ H_x,    r₁ = Qᵀ r,    information of all features = Σ H_xᵀ H_x - Tᵀ T.

Q comes from two rounds of Cholesky QR (Yamamoto, Nakatsukasa, Yanagisawa & Fukaya 2015), which is
as accurate as Householder's and works on all features at once. The products are of whitened pixels
only. Their rounding errors are 1e-16 of the largest information of any pose, 1e-8 per rad² or m² in
the directions that images do not see: nothing beside any prior. What spans many orders of magnitude
(IMU, prior) never enters; the root of the sum is folded into it by QR as any other rows are.

Reprojection factors of whole features, linearised and reduced together. For a feature f seen from
several poses x, the linearised residuals r = H_x δx + H_f δf are rotated by the orthogonal factor
of a QR of H_f into three rows that determine δf,

    r₁ = T δx + R_f δf,

and the others, r₂ = N δx, which no longer contain f: the projection onto the left null space of H_f
(Mourikis & Roumeliotis 2007, eq. 23-24). Leaving the first three out is marginalising the feature;
keeping them makes it a variable of the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.solve.state import POSE_DIM
from slam_graph.backend.solve.triangles import upper_part
from slam_graph.kernels.feature_sums import sum_of_features
from slam_graph.kernels.null_space import triangularize_features


@dataclass(frozen=True, slots=True, eq=False)
class SummedFeatures:
    """J features over the poses of F frames and C columns of the calibration, summed up.

    Attributes:
        R_f: (J, 3, 3) upper triangular.
        T: (J, 3, 6 F + C).
        r_1: (J, 3).
        rows: (K, 6 F + C + 1) rows [N r₂] that say of them what all features say together.
    """

    R_f: FloatArray
    T: FloatArray
    r_1: FloatArray
    rows: FloatArray

    def null_space_rows(self) -> FloatArray:
        """The rows [N r₂] of all features together, (K, 6 F + C + 1), K at most that."""
        return self.rows

    def point_increments(self, delta: FloatArray) -> FloatArray:
        """The δf (J, 3) that go with an increment of poses and calibration (6 F + C,)."""
        rest = self.r_1 - self.T @ delta
        increments = np.linalg.solve(self.R_f, rest[:, :, None])[:, :, 0]
        return np.asarray(increments, dtype=np.float64)


def sum_features(obs: Observations, linear: WhitenedObservations) -> SummedFeatures:
    """Eliminate the position of each feature and add up what they all say of the poses.

    Args:
        obs: N observations of J features, each seen at least twice.
        linear: their linearisation.

    Raises:
        numpy.linalg.LinAlgError: if the observations of a feature do not determine its position.
    """
    J, width = len(obs.ids), POSE_DIM * len(obs.frames) + linear.by_calibration.shape[2] + 1
    R_f, T, information = np.empty((J, 3, 3)), np.empty((J, 3, width)), np.empty((width, width))
    parts = linear.r, linear.by_pose, linear.by_point, linear.by_calibration
    sum_of_features(*parts, obs.frame, obs.starts, R_f, T, information)
    stacked = T.reshape(-1, width)
    information -= stacked.T @ stacked
    if not np.isfinite(information).all():
        raise np.linalg.LinAlgError("a feature is not determined by its observations")
    return SummedFeatures(R_f, T[:, :, :-1], T[:, :, -1], information_root(information))


def information_root(information: FloatArray) -> FloatArray:
    """Rows [N r] (K, n + 1) with Nᵀ N, Nᵀ r and rᵀ r as given: a root of a semidefinite matrix.

    A pivoted Cholesky factorisation, which ends where the rest is rounding error.

    Args:
        information: (n + 1, n + 1) symmetric; the sum of products of rows [N r].
    """
    n = len(information) - 1
    root, pivots, rank, _ = lapack.dpstrf(information[:n, :n])
    root, pivots = root[:rank], pivots - 1
    b, _ = lapack.dtrtrs(root[:, :rank], information[pivots[:rank], n], trans=1)
    rows = np.zeros((rank + 1, n + 1))
    rows[:rank, pivots] = upper_part(root)
    rows[:rank, n] = b
    rows[rank, n] = np.sqrt(max(information[n, n] - b @ b, 0.0))
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class WhitenedObservations:
    """Linearised residuals of single observations, in standard deviations.

    Attributes:
        r: (N, 2) residuals.
        by_pose: (N, 2, 6) derivatives of the projection.
        by_point: (N, 2, 3).
        by_calibration: (N, 2, C), by the parameters of the rig that are estimated.
        depths: (N,) in metres.
        errors: (N,) lengths of the residuals before the robust loss reduced their weight.
    """

    r: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    by_calibration: FloatArray
    depths: FloatArray
    errors: FloatArray

    @property
    def H(self) -> FloatArray:
        """(N, 2, 9 + C) by the pose, the point and the calibration, in this order."""
        return np.concatenate([self.by_pose, self.by_point, self.by_calibration], axis=2)

    def subset(self, keep: NDArray[np.bool_]) -> WhitenedObservations:
        """The observations where `keep` (N,) holds."""
        if keep.all():
            return self
        rows = keep.nonzero()[0]  # faster to take than a mask
        parts = self.r, self.by_pose, self.by_point, self.by_calibration, self.depths, self.errors
        return WhitenedObservations(*(part.take(rows, axis=0) for part in parts))

    def unweighted(self, loss: RobustLoss) -> WhitenedObservations:
        """The same without the weights of a loss."""
        scale = 1.0 / np.sqrt(loss.weights(self.errors))
        r, wide = self.r * scale[:, None], scale[:, None, None]
        parts = self.by_pose * wide, self.by_point * wide, self.by_calibration * wide
        return WhitenedObservations(r, *parts, self.depths, self.errors)


@dataclass(frozen=True, slots=True, eq=False)
class ReducedFeatures:
    """J features after the rotation by QR, over the poses of F frames and C further columns.

    The further columns are those of the calibration; there are none if nothing of it is estimated.

    Attributes:
        R_f: (J, 3, 3) upper triangular.
        T: (J, 3, 6 F + C).
        r_1: (J, 3).
        N: (J, K, 6 F + C); rows beyond `dof` are zero.
        r_2: (J, K).
        dof: (J,) number of rows of N that are in use.
    """

    R_f: FloatArray
    T: FloatArray
    r_1: FloatArray
    N: FloatArray
    r_2: FloatArray
    dof: NDArray[np.int64]

    def subset(self, keep: NDArray[np.bool_]) -> ReducedFeatures:
        """The features where `keep` (J,) holds."""
        return ReducedFeatures(
            self.R_f[keep],
            self.T[keep],
            self.r_1[keep],
            self.N[keep],
            self.r_2[keep],
            self.dof[keep],
        )

    def null_space_rows(self) -> FloatArray:
        """The rows [N r₂] of all features, (rows, 6 F + C + 1)."""
        rows = np.arange(self.N.shape[1]) < self.dof[:, None]
        return np.concatenate([self.N[rows], self.r_2[rows][:, None]], axis=1)

    def point_increments(self, delta: FloatArray) -> FloatArray:
        """The δf (J, 3) that go with an increment of poses and calibration (6 F + C,)."""
        rest = self.r_1 - self.T @ delta
        increments = np.linalg.solve(self.R_f, rest[:, :, None])[:, :, 0]
        return np.asarray(increments, dtype=np.float64)


def whiten(
    obs: Observations,
    rig: RigProjection,
    first: Geometry,
    estimate: Geometry,
    sigma_px: float | FloatArray,
    loss: RobustLoss,
) -> WhitenedObservations:
    """Linearise observations: Jacobians at the first estimates, residuals at the current ones.

    Their standard deviation is one number or one for each (N,).
    """
    residuals, depths = rig.residuals(obs, estimate)
    by_pose, by_point, by_calibration = rig.all_jacobians(obs, first)
    errors = np.sqrt(np.einsum("ni,ni->n", residuals, residuals)) / sigma_px
    weight = (np.sqrt(loss.weights(errors)) / sigma_px)[:, None, None]
    residuals *= weight[:, 0]  # all of these are new arrays
    by_pose *= weight
    by_point *= weight
    if by_calibration.size:
        by_calibration *= weight
    return WhitenedObservations(residuals, by_pose, by_point, by_calibration, depths, errors)


def reduce_features(obs: Observations, linear: WhitenedObservations) -> ReducedFeatures:
    """Stack the observations of each feature and eliminate its position by Householder QR."""
    F = len(obs.frames)
    by_poses = np.zeros((len(obs), 2, F, 6))
    by_poses[np.arange(len(obs)), :, obs.frame] = linear.by_pose
    others = np.concatenate(
        [by_poses.reshape(-1, 2, 6 * F), linear.by_calibration, linear.r[:, :, None]], axis=2
    )
    R_f, rest = eliminate_points(obs, linear.by_point, others)
    H, r = rest[:, :, :-1], rest[:, :, -1]
    return ReducedFeatures(R_f, H[:, :3], r[:, :3], H[:, 3:], r[:, 3:], 2 * obs.counts - 3)


def eliminate_points(
    obs: Observations, by_point: FloatArray, others: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Stack the rows of each feature and triangularise the coefficients of its position.

    Args:
        obs: N observations of J features.
        by_point: (N, 2, 3) coefficients of the feature of each observation.
        others: (N, 2, n) all other coefficients.

    Returns:
        R: (J, 3, 3) upper triangular coefficients of the features in the first three rows.
        rest: (J, 2 M, n) the other coefficients in all rows, M the largest number of observations;
            the rows from the fourth on do not contain the feature, unused ones are zero.
    """
    J, M, slots = len(obs.ids), int(obs.counts.max(initial=2)), obs.slots
    stacked = np.zeros((J, M, 2, 3))
    stacked[obs.feature, slots] = by_point
    beside = np.zeros((J, M, 2, others.shape[2]))
    beside[obs.feature, slots] = others
    A, B = stacked.reshape(J, 2 * M, 3), beside.reshape(J, 2 * M, -1)
    triangularize_features(A, B)
    return np.triu(A[:, :3]), B
