# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of the IMU over a recording, estimated from the residuals at the minimum.

Variance components (Förstner 1979; Teunissen & Amiri-Simkooei 2008): a residual r of covariance Q
before the adjustment has Q - A P Aᵀ after it, A being its Jacobian and P the covariance of the
states. So for the residuals of one kind, all of whose variances are wrong by the same ratio,

    ratio = Σ rᵀ Q⁻¹ r / Σ (dim r - tr Q⁻¹ A P Aᵀ),

whose denominator, the redundancy, is how many of the residuals the images can contradict. Its trace
is estimated by random signs (Hutchinson 1990), which takes solutions of the linear problem in place
of all covariances: with W_i the rows of Q^-½ A of the residual i and signs z_i, the mean of wᵀ P w
of w = Σ W_iᵀ z_i is Σ tr W_i P W_iᵀ. The redundancy has a standard deviation of at most
√(2 redundancy / 16).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.adaptive_imu_noise import MAX_FACTOR
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dims_of
from slam_graph.sensors import ImuNoise

_ROWS = (slice(0, 3), slice(6, 9), slice(9, 12), slice(12, 15))
"""Rows of a residual that show each kind of noise: rotation, velocity, both biases."""
_SAME_FACTOR = 1.2
"""Noise densities whose ratio is below this are taken for the same."""
_PROBES = 16
"""Vectors of random signs for each kind of noise."""
_PRIOR_REDUNDANCY = 10.0
"""Redundancy that the assumed noise counts for: what the images cannot tell stays as it is."""

TimesCovariance = Callable[[Mapping[int, FloatArray]], Mapping[int, FloatArray]]
"""The product of a covariance with the (n, m) parts of a matrix by variable; where there is no
part it is zero."""


@dataclass(frozen=True, slots=True)
class ImuNoiseFactors:
    """Factors on the noise densities of an IMU.

    Attributes:
        gyro: on the white noise of the gyroscope.
        accel: on that of the accelerometer.
        accel_walk: on the random walk of the accelerometer's bias.
        gyro_walk: on that of the gyroscope's.
    """

    gyro: float = 1.0
    accel: float = 1.0
    accel_walk: float = 1.0
    gyro_walk: float = 1.0

    def times(self, ratios: FloatArray) -> ImuNoiseFactors:
        """The factors with variances multiplied by ratios (4,), walks no less than calibrated."""
        gyro, accel, accel_walk, gyro_walk = np.sqrt(ratios).tolist()
        return ImuNoiseFactors(
            self.gyro * gyro,
            self.accel * accel,
            float(np.clip(self.accel_walk * accel_walk, 1.0, MAX_FACTOR)),
            float(np.clip(self.gyro_walk * gyro_walk, 1.0, MAX_FACTOR)),
        )

    def white(self, gyro: float, accel: float) -> tuple[float, float]:
        """Factors on white noise, given those that were learned on the way; at least one."""
        found = np.clip([self.gyro * gyro, self.accel * accel], 1.0, MAX_FACTOR)
        return float(found[0]), float(found[1])

    def near(self, other: ImuNoiseFactors, learned: list[float]) -> bool:
        """Whether two sets of factors are the same but for what residuals can tell.

        Args:
            other: the other set.
            learned: factors on white noise of gyroscope and accelerometer from the causal run.
        """
        own, others = (
            np.array([*noise.white(*learned), noise.accel_walk, noise.gyro_walk])
            for noise in (self, other)
        )
        return bool(np.all(np.abs(np.log(own / others)) < math.log(_SAME_FACTOR)))

    def walks(self, imu: ImuNoise) -> ImuNoise:
        """The noise with the factors on random walks."""
        return replace(
            imu,
            gyro_random_walk=imu.gyro_random_walk * self.gyro_walk,
            accel_random_walk=imu.accel_random_walk * self.accel_walk,
        )


def variance_ratios(
    factors: list[gtsam.CombinedImuFactor], values: gtsam.Values, times_covariance: TimesCovariance
) -> FloatArray:
    """By how much variances of the IMU are larger than assumed.

    Args:
        factors: between neighbouring keyframes, at whose residuals to look.
        values: the minimum.
        times_covariance: the product of the covariance of all states with what it is given.

    Returns:
        (4,) of white noise of gyroscope and accelerometer, random walk of accelerometer and
        gyroscope.
    """
    rng = np.random.default_rng(0)
    squares, probes = np.zeros(len(_ROWS)), len(_ROWS) * _PROBES
    right: dict[int, FloatArray] = defaultdict(lambda: np.zeros((1, probes)))
    for factor in factors:
        r, A, Q = _residual(factor, values)
        w = np.empty((A.shape[1], probes))
        for kind, rows in enumerate(_ROWS):
            white = np.linalg.inv(np.linalg.cholesky(Q[rows, rows]))
            squares[kind] += float(np.sum((white @ r[rows]) ** 2))
            signs = rng.choice([-1.0, 1.0], (3, _PROBES))
            w[:, kind * _PROBES : (kind + 1) * _PROBES] = (white @ A[rows]).T @ signs
        own = Layout(dims_of(_in_order(factor)))
        for key, columns in own.columns.items():
            right[key] = right[key] + w[columns]
    found = times_covariance(right) if right else {}
    products = sum((np.sum(w * found[key], axis=0) for key, w in right.items()), np.zeros(probes))
    predicted = products.reshape(len(_ROWS), _PROBES).mean(axis=1)
    redundancy = np.maximum(3.0 * len(factors) - predicted, 0.0) + _PRIOR_REDUNDANCY
    return np.asarray((squares + _PRIOR_REDUNDANCY) / redundancy)


def _in_order(factor: gtsam.CombinedImuFactor) -> list[int]:
    """Keys of pose, velocity and bias of the first state of a factor, then of the second."""
    x, v, y, w, a, b = factor.keys()
    return [x, v, a, y, w, b]


def _residual(
    factor: gtsam.CombinedImuFactor, values: gtsam.Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual (15,), Jacobian (15, 30) by pose, velocity, bias of both states, and covariance."""
    linear = gtsam.JacobianFactor(factor.linearize(values))
    order = gtsam.Ordering()
    for key in _in_order(factor):
        order.push_back(key)
    whitened, d = gtsam.JacobianFactor(_alone(linear), order).jacobian()
    model: Any = factor.noiseModel()
    unwhiten = np.linalg.inv(model.R())
    return -unwhiten @ d, unwhiten @ whitened, unwhiten @ unwhiten.T


def _alone(factor: gtsam.JacobianFactor) -> gtsam.GaussianFactorGraph:
    """A graph of one factor."""
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(factor)
    return graph
