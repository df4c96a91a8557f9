# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of the IMU over a recording, estimated from the residuals at the minimum.

Variance components (Förstner 1979; Teunissen & Amiri-Simkooei 2008): a residual r of covariance Q
before the adjustment has Q - A P Aᵀ after it, A being its Jacobian and P the covariance of the
states. So for the residuals of one kind, all of whose variances are wrong by the same ratio,

    ratio = Σ rᵀ Q⁻¹ r / Σ (dim r - tr Q⁻¹ A P Aᵀ),

whose denominator, the redundancy, is how many of the residuals the images can contradict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.adaptive_imu_noise import MAX_FACTOR
from slam_graph.sensors import ImuNoise

_ROWS = (slice(0, 3), slice(6, 9), slice(9, 12), slice(12, 15))
"""Rows of a residual that show each kind of noise: rotation, velocity, both biases."""
_SAME_FACTOR = 1.2
"""Noise densities whose ratio is below this are taken for the same."""
_PRIOR_REDUNDANCY = 10.0
"""Redundancy that the assumed noise counts for: what the images cannot tell stays as it is."""


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
    factors: list[gtsam.CombinedImuFactor], values: gtsam.Values, pairs: list[FloatArray]
) -> FloatArray:
    """By how much variances of the IMU are larger than assumed.

    Args:
        factors: between neighbouring keyframes, at whose residuals to look.
        values: the minimum.
        pairs: (30, 30) joint covariance of the states of each of these factors: pose, velocity and
            bias of the first, then of the second, in the tangents of GTSAM.

    Returns:
        (4,) of white noise of gyroscope and accelerometer, random walk of accelerometer and
        gyroscope.
    """
    squares, redundancy = np.zeros(len(_ROWS)), np.zeros(len(_ROWS))
    for factor, P in zip(factors, pairs, strict=True):
        r, A, Q = _residual(factor, values)
        predicted = A @ P @ A.T
        for kind, rows in enumerate(_ROWS):
            inverse = np.linalg.inv(Q[rows, rows])
            squares[kind] += r[rows] @ inverse @ r[rows]
            redundancy[kind] += 3.0 - float(np.sum(inverse * predicted[rows, rows]))
    redundancy = np.maximum(redundancy, 0.0) + _PRIOR_REDUNDANCY
    return np.asarray((squares + _PRIOR_REDUNDANCY) / redundancy)


def _residual(
    factor: gtsam.CombinedImuFactor, values: gtsam.Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual (15,), Jacobian (15, 30) by pose, velocity, bias of both states, and covariance."""
    linear = gtsam.JacobianFactor(factor.linearize(values))
    x, v, y, w, a, b = factor.keys()
    order = gtsam.Ordering()
    for key in (x, v, a, y, w, b):
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
