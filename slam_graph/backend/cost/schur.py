# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What many features say of the poses together, by the Schur complement of their positions.

The null-space form (`feature_factors.py`) keeps the rows of each feature apart, as the gate needs
them. Where only their sum is needed, it is cheaper to form it. With the residuals r = H_x δx +
H_f δf of a feature and H_f = Q R_f, Q having three orthonormal columns,

    T = Qᵀ H_x,    r₁ = Qᵀ r,    information of all features = Σ H_xᵀ H_x - Tᵀ T.

Q comes from two rounds of Cholesky QR (Yamamoto, Nakatsukasa, Yanagisawa & Fukaya 2015), which is
as accurate as Householder's and works on all features at once. The products are of whitened pixels
only. Their rounding errors are 1e-16 of the largest information of any pose, 1e-8 per rad² or m² in
the directions that images do not see: nothing beside any prior. What spans many orders of magnitude
(IMU, prior) never enters; the root of the sum is folded into it by QR as any other rows are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_factors import WhitenedObservations
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.solve.state import POSE_DIM

REGULARISATION = 1e-15
"""Information that is added to a feature, relative to what its observations say of it."""


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
    """
    by_point, by_view = _tables(obs, linear)
    Q, R_f = _orthonormal(by_point)
    T = _along(Q, by_view)
    stacked = T.reshape(-1, T.shape[2])
    information = _view_information(by_view) - stacked.T @ stacked
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
    rows[:rank, pivots] = np.triu(root)
    rows[:rank, n] = b
    rows[rank, n] = np.sqrt(max(information[n, n] - b @ b, 0.0))
    return rows


def _tables(obs: Observations, linear: WhitenedObservations) -> tuple[FloatArray, FloatArray]:
    """All rows in their places, zero where a feature was not seen.

    A view is what all C cameras of one frame see of a feature, m = 2 C rows.

    Returns:
        by_point: (J, F m, 3).
        by_view: (J, F, m, 6 + C + 1) derivatives by the pose of the frame and the calibration, and
            residuals.
    """
    J, F, C = len(obs.ids), len(obs.frames), int(obs.camera.max()) + 1
    by_point = np.zeros((J, F, C, 2, 3))
    by_point[obs.feature, obs.frame, obs.camera] = linear.by_point
    rows = np.concatenate([linear.by_pose, linear.by_calibration, linear.r[:, :, None]], axis=2)
    by_view = np.zeros((J, F, C, 2, rows.shape[2]))
    by_view[obs.feature, obs.frame, obs.camera] = rows
    return by_point.reshape(J, -1, 3), by_view.reshape(J, F, 2 * C, -1)


def _orthonormal(by_point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Q (J, F m, 3) with orthonormal columns for each feature, and R_f (J, 3, 3)."""
    Q, R_f = by_point, np.broadcast_to(np.eye(3), (len(by_point), 3, 3))
    for _ in range(2):
        squares = Q.transpose(0, 2, 1) @ Q
        trace = np.trace(squares, axis1=1, axis2=2)
        squares += REGULARISATION * trace[:, None, None] * np.eye(3)
        R = np.linalg.cholesky(squares).transpose(0, 2, 1)
        Q, R_f = Q @ np.linalg.inv(R), R @ R_f
    return Q, R_f


def _along(Q: FloatArray, by_view: FloatArray) -> FloatArray:
    """Qᵀ [H_x r] of each feature, (J, 3, 6 F + C + 1)."""
    J, F, m, _ = by_view.shape
    views = Q.reshape(J, F, m, 3).transpose(0, 1, 3, 2) @ by_view
    poses = views[:, :, :, :POSE_DIM].transpose(0, 2, 1, 3).reshape(J, 3, POSE_DIM * F)
    return np.concatenate([poses, views[:, :, :, POSE_DIM:].sum(axis=1)], axis=2)


def _view_information(by_view: FloatArray) -> FloatArray:
    """Σ [H_x r]ᵀ [H_x r], (6 F + C + 1)²: a block for each pose, and all else."""
    _, F, _, width = by_view.shape
    size = POSE_DIM * F
    information = np.zeros((size + width - POSE_DIM, size + width - POSE_DIM))
    rest = np.arange(size, len(information))
    for frame in range(F):
        seen = np.ascontiguousarray(by_view[:, frame]).reshape(-1, width)
        columns = np.append(np.arange(POSE_DIM * frame, POSE_DIM * (frame + 1)), rest)
        information[np.ix_(columns, columns)] += seen.T @ seen
    return information
