# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""An update of a Gaussian by a few rows, where little is asked of the outcome.

Over the whitened variables x with δ = Wᵀ x, where P = Wᵀ W is the covariance, the Gaussian is
‖x - d‖² and rows [A b] are [Y b] with Y = A Wᵀ. They move the mean to d + Yᵀ (Y Yᵀ + I)⁻¹ (b - Y d)
and leave the covariance Wᵀ (I - Yᵀ (Y Yᵀ + I)⁻¹ Y) W, as in an extended Kalman filter. Where W is
there already and the rows are few, that takes a quarter of the time of an update of the triangle by
QR and its inverse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_factors import WhitenedObservations
from slam_graph.backend.cost.gating import distances_of_observations, distances_of_rows
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.kernels.gate import observation_rows


@dataclass(frozen=True, slots=True, eq=False)
class TailRoot:
    """A root of the covariance of the last variables of a Gaussian.

    Attributes:
        first: the first column.
        W: (m, m) lower triangular, R⁻ᵀ of the columns from there on.
    """

    first: int
    W: FloatArray

    @staticmethod
    def of(gaussian: SquareRootInformation, first: int) -> TailRoot:
        """That of all columns from one on."""
        return TailRoot(first, gaussian.root_from(first))

    def last_rows(self, columns: NDArray[np.intp]) -> FloatArray:
        """Columns (q, k) of W without the leading rows that are zero in all of them.

        Args:
            columns: (k,) their numbers in the Gaussian.

        Returns:
            A root of the covariance of these variables.
        """
        own = columns - self.first
        zeros = int(own.min(initial=len(self.W)))
        return np.asarray(self.W.T.take(own, axis=0).T)[zeros:]  # contiguous columns


@dataclass(frozen=True, slots=True, eq=False)
class GateRoot:
    """A root of the covariance of the variables that the observations of a step depend on.

    Attributes:
        tail: the root, from the first of these variables on; m variables.
        columns: (N, 9 + C) of observations of features of the state.
        pose_root: (q, 6 F + C) its last rows in the columns of poses and calibration of new
            features; those before are zero.
    """

    tail: TailRoot
    columns: NDArray[np.intp]
    pose_root: FloatArray

    def of_poses(self, poses: NDArray[np.intp]) -> Self:
        """The same for other new features, with columns (6 F + C,) of poses and calibration."""
        return replace(self, pose_root=self.tail.last_rows(poses))

    def distances(self, linear: WhitenedObservations) -> FloatArray:
        """Squared Mahalanobis distances (N,) of the observations of features of the state."""
        return distances_of_observations(linear, self.tail.W, self.columns - self.tail.first)


@dataclass(frozen=True, slots=True, eq=False)
class GatedRows(GateRoot):
    """The root with the derivatives of observations, for two tests of the same ones.

    Attributes:
        poses: (6 F + C,) columns of poses and calibration of new features.
        rows: (N, 2, m) derivatives of observations of features of the state by whitened variables.
    """

    poses: NDArray[np.intp]
    rows: FloatArray

    def distances(self, linear: WhitenedObservations) -> FloatArray:
        """As `GateRoot.distances`, from the rows."""
        return distances_of_rows(linear.r, self.rows)


def gate_root(
    gaussian: SquareRootInformation, columns: NDArray[np.intp], poses: NDArray[np.intp]
) -> GateRoot:
    """The root for the observations of a step.

    Args:
        gaussian: what is known before them.
        columns: (N, 9 + C) of observations of features of the state.
        poses: (6 F + C,) columns of poses and calibration of new features.
    """
    size = gaussian.layout.size
    tail = TailRoot.of(gaussian, min(int(part.min(initial=size)) for part in (columns, poses)))
    return GateRoot(tail, columns, tail.last_rows(poses))


def gated_rows(
    gaussian: SquareRootInformation,
    columns: NDArray[np.intp],
    poses: NDArray[np.intp],
    H: FloatArray,
) -> GatedRows:
    """The root for the observations of a step, and the rows of those of features of the state.

    Args:
        gaussian: what is known before them.
        columns: (N, 9 + C) of observations of features of the state.
        poses: (6 F + C,) columns of poses and calibration of new features.
        H: (N, 2, 9 + C) derivatives of the former.
    """
    root = gate_root(gaussian, columns, poses)
    W = root.tail.W
    rows = np.empty((len(H), 2, len(W)))
    observation_rows(H, W, columns - root.tail.first, rows.reshape(-1, len(W)))
    return GatedRows(root.tail, columns, root.pose_root, poses, rows)


class WhitenedUpdate:
    """The Gaussian after an update by rows.

    Attributes:
        mean: (m,) of the whitened variables.

    Args:
        gaussian: before it, n variables.
        root: of the covariance of all that is asked for and that the rows contain, m variables.
        Y: (k, m) the rows, by whitened variables.
        b: (k,) their right-hand side.

    Raises:
        numpy.linalg.LinAlgError: if rows or Gaussian are not finite.
    """

    def __init__(
        self, gaussian: SquareRootInformation, root: TailRoot, Y: FloatArray, b: FloatArray
    ) -> None:
        self._root, self._Y = root, Y
        self._size = gaussian.layout.size
        S = blas.dsyrk(1.0, Y.T, trans=1, lower=1)
        S[np.diag_indices(len(S))] += 1.0
        self._L, info = lapack.dpotrf(S, lower=1, overwrite_a=1)
        d = gaussian.d[root.first :]
        z, _ = lapack.dpotrs(self._L, b - Y @ d, lower=1)
        self.mean = d + Y.T @ z
        if info != 0 or not np.isfinite(self.mean).all():
            raise np.linalg.LinAlgError("an update is not finite")

    def solution(self) -> FloatArray:
        """The δ (n,) of least cost; zero before the first column of the root."""
        solution = np.zeros(self._size)
        solution[self._root.first :] = self._root.W.T @ self.mean
        return solution

    def reduction(self, rows: FloatArray) -> FloatArray:
        """By what the update has reduced the covariance of rows A (n, m) of whitened variables.

        Returns:
            Z (n, k): the covariance was A Aᵀ before it, and is A Aᵀ - Z Zᵀ after it.
        """
        Z_transposed, _ = lapack.dtrtrs(self._L, self._Y @ rows.T, lower=1)
        return np.asarray(Z_transposed.T)

    def covariance(self, W: FloatArray) -> FloatArray:
        """The covariance (k, k) of variables.

        Args:
            W: (q, k) the last rows of their columns of the root; those before are zero.
        """
        right = np.asfortranarray(self._Y[:, self._Y.shape[1] - len(W) :] @ W)
        Z_transposed, _ = lapack.dtrtrs(self._L, right, lower=1, overwrite_b=1)
        return np.asarray(W.T @ W - Z_transposed.T @ Z_transposed)
