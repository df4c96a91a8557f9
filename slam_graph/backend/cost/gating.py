# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The Mahalanobis (χ²) gate: is a residual as large as its predicted covariance allows?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.cost.feature_factors import WhitenedObservations
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.kernels.gate import observation_distances, track_distances


@dataclass(frozen=True, slots=True)
class Innovations:
    """How far the measurements of one step were from what was predicted of them.

    A measurement is a new feature with all of its observations, or one observation of a feature of
    the state; where the gate is on what remains after the steps, each single observation. Distances
    are squared Mahalanobis distances, which the gate judges.

    Attributes:
        tested: number of measurements.
        rejected: how many of them the gate left out.
        distance: sum of the distances of all that were tested.
        dof: sum of their degrees of freedom.
        passed_distance: of those that passed; jointly, where the engine knows that.
        passed_dof: sum of the degrees of freedom of those that passed.
        expected: mean of the sum of the distances of those that passed if all covariances are
            right: less than `passed_dof`, as the gate cuts off the tail of the distribution.
    """

    tested: int = 0
    rejected: int = 0
    distance: float = 0.0
    dof: int = 0
    passed_distance: float = 0.0
    passed_dof: int = 0
    expected: float = 0.0

    @staticmethod
    def of(
        distances: FloatArray, dof: NDArray[np.int64], largest: FloatArray, passed: BoolArray
    ) -> Innovations:
        """The sums over J measurements.

        Args:
            distances: (J,) squared Mahalanobis distances.
            dof: (J,) their degrees of freedom.
            largest: (J,) what the gate lets through, the same where the degrees of freedom are.
            passed: (J,) what it let through.
        """
        entered, passed_dof = distances[passed], dof[passed]
        counts = np.bincount(passed_dof)
        degrees = counts.nonzero()[0]
        numbers, kinds = counts[degrees], degrees.tolist()
        limits = dict(zip(passed_dof.tolist(), largest[passed].tolist(), strict=True))
        means = np.array([_mean_below(k, limits[k]) for k in kinds])
        return Innovations(
            len(distances),
            len(distances) - len(entered),
            float(distances.sum()),
            int(dof.sum()),
            float(entered.sum()),
            int(degrees @ numbers),
            float(means @ numbers),
        )

    @staticmethod
    def untested(dof: NDArray[np.int64]) -> Innovations:
        """Measurements with degrees of freedom (J,) that enter without a gate."""
        total = int(np.sum(dof))
        return Innovations(passed_dof=total, expected=float(total))

    def __add__(self, other: Innovations) -> Innovations:
        if not self.tested and not self.passed_dof:
            return other
        return Innovations(*(getattr(self, name) + getattr(other, name) for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Gate:
    """What the gate of one step lets through.

    Attributes:
        landmarks: (N,) observations of features of the state that pass.
        tracks: (J,) new features that pass, of those that were tested.
        innovations: their distances.
    """

    landmarks: BoolArray
    tracks: BoolArray
    innovations: Innovations


def squared_mahalanobis(r: FloatArray, H: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis distances of whitened residuals.

    Args:
        r: (J, m) residuals in standard deviations of their measurement noise.
        H: (J, m, n) their derivatives by the state.
        covariance: (n, n) of the state, or (J, n, n).

    Returns:
        (J,) rᵀ (H P Hᵀ + I)⁻¹ r; χ² distributed with m degrees of freedom.
    """
    S = H @ covariance @ H.transpose(0, 2, 1) + np.eye(H.shape[1])
    distances: FloatArray = np.einsum("ji,ji->j", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
    return distances


def distances_of_observations(
    linear: WhitenedObservations, root: FloatArray, columns: NDArray[np.intp]
) -> FloatArray:
    """Squared Mahalanobis distances (N,) of observations of features of the state.

    Args:
        linear: N of them.
        root: (m, n) of the covariance of the state, P = rootᵀ root.
        columns: (N, 9 + C) of `root`, for pose, feature and calibration of each.
    """
    distances = np.empty(len(linear.r))
    observation_distances(linear.r, linear.H, np.asfortranarray(root), columns, distances)
    return distances


def distances_of_rows(
    r: FloatArray, rows: FloatArray, reduction: FloatArray | None = None
) -> FloatArray:
    """Squared Mahalanobis distances (N,) of observations, from their rows by whitened variables.

    Args:
        r: (N, 2) residuals.
        rows: (N, 2, m) their derivatives Y by variables whose covariance is the identity.
        reduction: (N, 2, k) rows Z; an update has reduced the covariance Y Yᵀ of the rows by Z Zᵀ.
            None for no update.

    Returns:
        rᵀ (Y Yᵀ - Z Zᵀ + I)⁻¹ r.
    """
    products = _products(rows)
    if reduction is not None:
        products -= _products(reduction)
    s00, s01, s11 = products
    s00, s11 = s00 + 1.0, s11 + 1.0
    u, v = r.T
    squares = s11 * u * u - 2.0 * s01 * u * v + s00 * v * v
    return np.asarray(squares / (s00 * s11 - s01 * s01))


def _products(rows: FloatArray) -> FloatArray:
    """The products (3, N) of each pair (N, 2, m) of rows: first by first, by second, and second."""
    one, other = rows[:, 0], rows[:, 1]
    pairs = (one, one), (one, other), (other, other)
    return np.array([np.einsum("nm,nm->n", a, b) for a, b in pairs])


def distances_of_tracks(
    obs: Observations, linear: WhitenedObservations, covariance: FloatArray
) -> FloatArray:
    """Squared Mahalanobis distances (J,) of whole features, whatever their positions are.

    Args:
        obs: N observations of J features.
        linear: their linearisation.
        covariance: (6 F + C, 6 F + C) of poses and calibration.
    """
    distances = np.empty(len(obs.ids))
    parts = linear.r, linear.by_pose, linear.by_point, linear.by_calibration
    track_distances(*parts, obs.frame, obs.starts, covariance, distances)
    return distances


def passing(
    distances: FloatArray, dof: NDArray[np.int64], confidence: float, may_pass: BoolArray | bool
) -> tuple[BoolArray, Innovations]:
    """Which of J measurements pass the test, and how far all of them were.

    Args:
        distances: (J,) squared Mahalanobis distances.
        dof: (J,) their degrees of freedom.
        confidence: share of right measurements that pass.
        may_pass: (J,) those that may pass; or all, or none.
    """
    largest = threshold(dof, confidence)
    passed = (distances < largest) & may_pass
    return passed, Innovations.of(distances, dof, largest, passed)


def threshold(dof: NDArray[np.int64], confidence: float) -> FloatArray:
    """The χ² quantile for each number of degrees of freedom."""
    table = _quantiles(int(dof.max(initial=1)), confidence)
    return table[dof]


@lru_cache(maxsize=1024)
def _mean_below(dof: int, limit: float) -> float:
    """The mean k F(k + 2, q) / F(k, q) of a χ² variable of k degrees of freedom, cut off at q."""
    k, q = 0.5 * dof, 0.5 * limit
    return float(dof * scipy.special.gammainc(k + 1.0, q) / scipy.special.gammainc(k, q))


@lru_cache(maxsize=64)
def _quantiles(largest: int, confidence: float) -> FloatArray:
    # the quantile of χ² with k degrees of freedom is 2 P⁻¹(k/2, p), P the incomplete gamma function
    halves = scipy.special.gammaincinv(0.5 * np.arange(1, largest + 1), confidence)
    return np.concatenate([[0.0], 2.0 * halves])
