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
from numpy.typing import NDArray
from scipy.linalg import lapack

from slam_graph.backend.feature_factors import WhitenedObservations
from slam_graph.backend.tracks import Observations

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

REGULARISATION = 1e-15
"""Information that is added to a feature, relative to what its observations say of it."""


@dataclass(frozen=True, slots=True, eq=False)
class CondensedFeatures:
    """J features over the poses of F frames, their sum for the poses formed.

    Attributes:
        R_f: (J, 3, 3) upper triangular.
        T: (J, 3, 6 F).
        r_1: (J, 3).
        rows: (K, 6 F + 1) rows [N r₂] that say of the poses what all features say together.
    """

    R_f: FloatArray
    T: FloatArray
    r_1: FloatArray
    rows: FloatArray

    def null_space_rows(self) -> FloatArray:
        """The rows [N r₂] of all features together, (K, 6 F + 1), K not above 6 F + 1."""
        return self.rows

    def point_increments(self, delta_poses: FloatArray) -> FloatArray:
        """The δf (J, 3) that go with an increment of the poses (6 F,)."""
        rest = self.r_1 - self.T @ delta_poses
        increments = np.linalg.solve(self.R_f, rest[:, :, None])[:, :, 0]
        return np.asarray(increments, dtype=np.float64)


def condense_features(obs: Observations, linear: WhitenedObservations) -> CondensedFeatures:
    """Eliminate the position of each feature and add up what they all say of the poses.

    Args:
        obs: N observations of J features, each seen at least twice.
        linear: their linearisation.
    """
    Q, R_f = _orthonormal(obs, linear.by_point)
    T, r_1 = _along(obs, Q, linear)
    stacked = np.concatenate([T, r_1[:, :, None]], axis=2).reshape(3 * len(T), -1)
    information = _pose_information(obs, linear) - stacked.T @ stacked
    return CondensedFeatures(R_f, T, r_1, information_root(information))


def _orthonormal(obs: Observations, by_point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Q (N, 2, 3) with orthonormal columns over all rows of a feature, and R_f (J, 3, 3)."""
    Q, R_f = by_point, np.broadcast_to(np.eye(3), (len(obs.ids), 3, 3))
    for _ in range(2):
        squares = np.einsum("nki,nkj->nij", Q, Q)
        squares = np.add.reduceat(squares, _first_of_each(obs.feature))
        trace = np.trace(squares, axis1=1, axis2=2)
        squares += REGULARISATION * trace[:, None, None] * np.eye(3)
        R = np.linalg.cholesky(squares).transpose(0, 2, 1)
        Q, R_f = Q @ np.linalg.inv(R)[obs.feature], R @ R_f
    return Q, R_f


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


def _along(
    obs: Observations, Q: FloatArray, linear: WhitenedObservations
) -> tuple[FloatArray, FloatArray]:
    """Qᵀ H_x (J, 3, 6 F) and Qᵀ r (J, 3) of each feature."""
    J, F = len(obs.ids), len(obs.frames)
    views = _first_of_each(obs.feature * F + obs.frame)  # a view: all cameras of one frame
    by_pose = np.add.reduceat(np.einsum("nki,nkj->nij", Q, linear.by_pose), views)
    T = np.zeros((J, 3, F, 6))
    T[obs.feature[views], :, obs.frame[views]] = by_pose
    r_1 = np.add.reduceat(np.einsum("nki,nk->ni", Q, linear.r), _first_of_each(obs.feature))
    return T.reshape(J, 3, 6 * F), r_1


def _pose_information(obs: Observations, linear: WhitenedObservations) -> FloatArray:
    """Σ [H_x r]ᵀ [H_x r], (6 F + 1, 6 F + 1): a block for each pose, and the residuals."""
    F = len(obs.frames)
    rows = np.concatenate([linear.by_pose, linear.r[:, :, None]], axis=2)
    information = np.zeros((6 * F + 1, 6 * F + 1))
    for frame in range(F):
        seen = rows[obs.frame == frame].reshape(-1, 7)
        columns = np.append(np.arange(6 * frame, 6 * frame + 6), 6 * F)
        information[np.ix_(columns, columns)] += seen.T @ seen
    return information


def _first_of_each(ascending: IntArray) -> IntArray:
    """Index of the first of each run of equal values."""
    return np.flatnonzero(np.diff(ascending, prepend=-1))
