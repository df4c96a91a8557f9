# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Reprojection factors of whole features, linearised and reduced together.

For a feature f seen from several poses x, the linearised residuals r = H_x δx + H_f δf are rotated
by the orthogonal factor of a QR of H_f into three rows that determine δf,

    r₁ = T δx + R_f δf,

and the others, r₂ = N δx, which no longer contain f: the projection onto the left null space of H_f
(Mourikis & Roumeliotis 2007, eq. 23-24). Leaving the first three out is marginalising the feature;
keeping them makes it a variable of the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss


@dataclass(frozen=True, slots=True, eq=False)
class WhitenedObservations:
    """Linearised residuals of single observations, in standard deviations.

    Attributes:
        r: (N, 2) residuals.
        by_pose: (N, 2, 6) derivatives of the projection.
        by_point: (N, 2, 3).
        by_calibration: (N, 2, C), by the parameters of the rig that are estimated.
        depths: (N,) in metres.
    """

    r: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    by_calibration: FloatArray
    depths: FloatArray

    @property
    def H(self) -> FloatArray:
        """(N, 2, 9 + C) by the pose, the point and the calibration, in this order."""
        return np.concatenate([self.by_pose, self.by_point, self.by_calibration], axis=2)

    def subset(self, keep: NDArray[np.bool_]) -> WhitenedObservations:
        """The observations where `keep` (N,) holds."""
        return WhitenedObservations(
            self.r[keep],
            self.by_pose[keep],
            self.by_point[keep],
            self.by_calibration[keep],
            self.depths[keep],
        )


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
    sigma_px: float,
    loss: RobustLoss,
) -> WhitenedObservations:
    """Linearise observations: Jacobians at the first estimates, residuals at the current ones."""
    residuals, depths = rig.residuals(obs, estimate)
    by_pose, by_point, by_calibration = rig.all_jacobians(obs, first)
    r = residuals / sigma_px
    weight = np.sqrt(loss.weights(np.linalg.norm(r, axis=1))) / sigma_px
    return WhitenedObservations(
        residuals * weight[:, None],
        by_pose * weight[:, None, None],
        by_point * weight[:, None, None],
        by_calibration * weight[:, None, None],
        depths,
    )


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
    _householder(A, B)
    return np.triu(A[:, :3]), B


def _householder(A: FloatArray, B: FloatArray) -> None:
    """Triangularise A (J, m, 3) in place and apply the same reflections to B (J, m, n)."""
    for column in range(3):
        x = A[:, column:, column]
        norm = np.linalg.norm(x, axis=1)
        v = x.copy()
        v[:, 0] += np.where(x[:, 0] >= 0, norm, -norm)
        scale = np.einsum("ji,ji->j", v, v)
        beta = 2.0 / np.where(scale > 0, scale, np.inf)
        for target in (A, B):
            part = target[:, column:]
            projection = (v[:, None, :] @ part) * beta[:, None, None]
            part -= v[:, :, None] * projection
