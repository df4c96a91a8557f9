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
from collections.abc import Callable
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
_PROBES = 16
"""Vectors of random signs for each kind of noise."""
_PRIOR_REDUNDANCY = 10.0
"""Redundancy that the assumed noise counts for: what the images cannot tell stays as it is."""

TimesCovariance = Callable[[FloatArray], FloatArray]
"""The product (K, 15, m) of the covariance of K states with a matrix (K, 15, m)."""


@dataclass(frozen=True, slots=True)
class ImuNoiseFactors:
    """Factors on the noise densities of an IMU.

    Attributes:
        gyro: on the white noise of the gyroscope.
        accel: on that of the accelerometer.
        accel_walk: on the random walk of the accelerometer's bias.
        gyro_walk: on that of the gyroscope's.
        least: the smallest factor: one where the noise was calibrated.
    """

    gyro: float = 1.0
    accel: float = 1.0
    accel_walk: float = 1.0
    gyro_walk: float = 1.0
    least: float = 1.0

    def times(self, ratios: FloatArray) -> ImuNoiseFactors:
        """The factors with variances multiplied by ratios (4,), walks no less than the least."""
        gyro, accel, accel_walk, gyro_walk = np.sqrt(ratios).tolist()
        return ImuNoiseFactors(
            self.gyro * gyro,
            self.accel * accel,
            float(np.clip(self.accel_walk * accel_walk, self.least, MAX_FACTOR)),
            float(np.clip(self.gyro_walk * gyro_walk, self.least, MAX_FACTOR)),
            self.least,
        )

    def white(self, gyro: float, accel: float) -> tuple[float, float]:
        """Factors on white noise, given those that were learned on the way."""
        found = np.clip([self.gyro * gyro, self.accel * accel], self.least, MAX_FACTOR)
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
    factors: list[gtsam.CombinedImuFactor],
    values: gtsam.Values,
    keyframes: int,
    times_covariance: TimesCovariance,
) -> FloatArray:
    """By how much variances of the IMU are larger than assumed.

    Args:
        factors: M of them between neighbouring keyframes, at whose residuals to look.
        values: the minimum.
        keyframes: number K of keyframes.
        times_covariance: the product of the covariance of their states with what it is given.

    Returns:
        (4,) of white noise of gyroscope and accelerometer, random walk of accelerometer and
        gyroscope.
    """
    if not factors:
        return np.ones(len(_ROWS))
    rng = np.random.default_rng(0)
    squares, kinds = np.zeros(len(_ROWS)), len(_ROWS)
    signs = rng.choice([-1.0, 1.0], (len(factors), kinds, 3, _PROBES))
    r, A, Q = _residuals(factors, values)
    w = np.empty((len(factors), A.shape[2], kinds, _PROBES))
    for kind, rows in enumerate(_ROWS):
        white = np.linalg.inv(np.linalg.cholesky(Q[:, rows, rows]))
        squares[kind] = np.sum((white @ r[:, rows, None]) ** 2)
        w[:, :, kind] = (white @ A[:, rows]).transpose(0, 2, 1) @ signs[:, kind]
    w = w.reshape(len(factors), 2, -1, kinds * _PROBES)  # of the first state, and of the second
    first = np.array([gtsam.symbolIndex(factor.keys()[0]) for factor in factors])
    right = np.zeros((keyframes, *w.shape[2:]))
    np.add.at(right, first, w[:, 0])
    np.add.at(right, first + 1, w[:, 1])
    products = np.sum(right * times_covariance(right), axis=(0, 1))
    predicted = products.reshape(kinds, _PROBES).mean(axis=1)
    redundancy = np.maximum(3.0 * len(factors) - predicted, 0.0) + _PRIOR_REDUNDANCY
    return np.asarray((squares + _PRIOR_REDUNDANCY) / redundancy)


def _residuals(
    factors: list[gtsam.CombinedImuFactor], values: gtsam.Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (M, 15), Jacobians (M, 15, 30) by pose, velocity, bias of both states, covariances.

    GTSAM's factor has pose and velocity of the first state, of the second, bias of the first and of
    the second.
    """
    by_state = np.r_[0:9, 18:24, 9:18, 24:30]
    linear = [gtsam.JacobianFactor(factor.linearize(values)).jacobian() for factor in factors]
    models: list[Any] = [factor.noiseModel() for factor in factors]
    unwhiten = np.linalg.inv(np.array([model.R() for model in models]))
    A = unwhiten @ np.array([whitened for whitened, _ in linear])[:, :, by_state]
    d = np.array([d for _, d in linear])
    return -(unwhiten @ d[:, :, None])[:, :, 0], A, unwhiten @ unwhiten.transpose(0, 2, 1)
