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

from dataclasses import dataclass

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
        """The last rows (q, k) of columns, by their numbers in the Gaussian; those before are zero.

        It is a root of the covariance of these variables.
        """
        own = columns - self.first
        zeros = int(own.min(initial=len(self.W)))
        return np.asarray(self.W.T.take(own, axis=0).T)[zeros:]  # contiguous columns


@dataclass(frozen=True, slots=True, eq=False)
class GateRoot:
    """What the gate knows of the variables that the observations of a step depend on.

    Attributes:
        root: of their covariance, m variables.
        columns: (N, 9 + C) of observations of features of the state.
    """

    root: TailRoot
    columns: NDArray[np.intp]

    @staticmethod
    def of(
        gaussian: SquareRootInformation, columns: NDArray[np.intp], poses: NDArray[np.intp]
    ) -> GateRoot:
        """That of such columns, and of those (6 F + C,) of the poses of new features."""
        return GateRoot(TailRoot.of(gaussian, _first(gaussian, columns, poses)), columns)

    def distances(self, linear: WhitenedObservations) -> FloatArray:
        """Squared Mahalanobis distances (N,) of the observations of features of the state."""
        return distances_of_observations(linear, self.root.W, self.columns - self.root.first)


@dataclass(frozen=True, slots=True, eq=False)
class GatedRows(GateRoot):
    """The same with what two tests of the same observations share.

    Attributes:
        poses: (6 F + C,) columns of poses and calibration of new features.
        rows: (N, 2, m) derivatives of observations of features of the state by whitened variables.
        pose_root: (q, 6 F + C) the last rows of the root in the columns of poses; those before are
            zero.
    """

    poses: NDArray[np.intp]
    rows: FloatArray
    pose_root: FloatArray

    @staticmethod
    def with_rows(
        gaussian: SquareRootInformation,
        columns: NDArray[np.intp],
        poses: NDArray[np.intp],
        H: FloatArray,
    ) -> GatedRows:
        """Those of observations with derivatives H (N, 2, 9 + C)."""
        root = TailRoot.of(gaussian, _first(gaussian, columns, poses))
        rows = np.empty((len(H), 2, len(root.W)))
        observation_rows(H, root.W, columns - root.first, rows.reshape(-1, len(root.W)))
        return GatedRows(root, columns, poses, rows, root.last_rows(poses))

    def distances(self, linear: WhitenedObservations) -> FloatArray:
        """As `GateRoot.distances`, from the rows."""
        return distances_of_rows(linear.r, self.rows)


def _first(
    gaussian: SquareRootInformation, columns: NDArray[np.intp], poses: NDArray[np.intp]
) -> int:
    """The first of all columns; their number if there are none."""
    size = gaussian.layout.size
    return min(int(part.min(initial=size)) for part in (columns, poses))


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
