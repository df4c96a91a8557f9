# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of the IMU over a recording, estimated from the residuals at the minimum.

Variance components (Patterson & Thompson 1971; Teunissen & Amiri-Simkooei 2008): whitened residuals
e of covariance I before the adjustment have M = I - W P Wᵀ after it, W being their Jacobian and P
the covariance of the states. A ratio θ_k of the variance of one kind of noise changes the
covariance Q = L Lᵀ of a residual by θ_k^½ in its own rows and columns E_k, so that of the whitened
one by S_k = ½ (L⁻¹ E_k L + Lᵀ E_k L⁻ᵀ). The ratios explain the squares (Fisher scoring),

    Σ_l F_kl (θ_l - 1) = eᵀ S_k e - tr S_k M,   F_kl = tr S_k M S_l M.

The trace, the redundancy, is how many of the residuals the images can contradict; F is twice the
information on the ratios. White noise and random walk explain the same residuals in part, and F
tells them apart. Both are estimated by random signs (Hutchinson 1990), which takes solutions of the
linear problem in place of all covariances: with signs z, u_k = M S_k z follows from P Wᵀ S_k z, and

    tr S_k M = E zᵀ u_k,   F_kl = E u_kᵀ S_l Σ_k u_k,

as the S_k add up to I. What walks add to the other residuals within an interval counts for the
kinds of these: hundredths of their variance at EuRoC's calibration, a third where the walk of the
accelerometer is five times that. Rounds end at the truth all the same, but after more of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.adaptive_imu_noise import MAX_FACTOR
from slam_graph.backend.smoothing.state_elimination import STATE
from slam_graph.sensors import ImuNoise

_KINDS = np.repeat(np.eye(4), [3, 6, 3, 3], axis=1)
"""(4, 15) rows of a residual that show each kind of noise: rotation, position and velocity, both
biases."""
_SAME_FACTOR = 1.2
"""Noise densities whose ratio is below this are taken for the same."""
_PROBES = 16
"""Vectors of random signs."""
_PRIOR_INFORMATION = 10.0
"""What the assumed noise counts for in F, as ten residuals that nothing but it explains: what the
images cannot tell stays as it is."""
_LARGEST_RATIO = 9.0
"""Variances change by this factor at most in a round."""

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

    def bounded(self, gyro: float, accel: float) -> ImuNoiseFactors:
        """Those that `white` uses, so that many rounds do not lead far beyond its bounds.

        Args:
            gyro: factor on white noise of the gyroscope from the causal run.
            accel: the same of the accelerometer.
        """
        of_gyro, of_accel = self.white(gyro, accel)
        return replace(self, gyro=of_gyro / gyro, accel=of_accel / accel)

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
    """By how much variances of the IMU are larger than assumed, between 1/9 and 9.

    Args:
        factors: M of them between neighbouring keyframes, at whose residuals to look.
        values: the minimum.
        keyframes: number K of keyframes.
        times_covariance: the product of the covariance of their states with what it is given.

    Returns:
        (4,) of white noise of gyroscope and accelerometer, random walk of accelerometer and
        gyroscope.

    Raises:
        LinAlgError: if a covariance is not positive definite.
    """
    if not factors:
        return np.ones(len(_KINDS))
    r, A, Q = _residuals(factors, values)
    L = np.linalg.cholesky(Q)
    white = np.linalg.inv(L)
    W, e = white @ A, (white @ r[:, :, None])[:, :, 0]
    S = 0.5 * (white[:, None] * _KINDS[:, None, :]) @ L[:, None]  # (M, kinds, 15, 15)
    S += S.transpose(0, 1, 3, 2)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(factors), 1, S.shape[2], _PROBES))
    first = np.array([gtsam.symbolIndex(factor.keys()[0]) for factor in factors])
    given = S @ signs
    u = given - _explained(given, W, first, keyframes, times_covariance)
    F = np.einsum("mkap,mlap->kl", u, S @ u.sum(axis=1, keepdims=True)) / _PROBES
    F = 0.5 * (F + F.T) + _PRIOR_INFORMATION * np.eye(len(F))
    redundancy = np.einsum("map,mkap->k", signs[:, 0], u) / _PROBES
    squares = np.einsum("ma,mkab,mb->k", e, S, e)
    ratios = 1.0 + np.linalg.solve(F, squares - redundancy)
    return np.asarray(np.clip(ratios, 1.0 / _LARGEST_RATIO, _LARGEST_RATIO))


def _explained(
    given: FloatArray,
    W: FloatArray,
    first: IntArray,
    keyframes: int,
    times_covariance: TimesCovariance,
) -> FloatArray:
    """W P Wᵀ of whitened residuals: what the states explain of them.

    Args:
        given: (M, kinds, 15, probes) residuals.
        W: (M, 15, 30) derivatives by the states k and k + 1.
        first: (M,) the numbers k.
        keyframes: number of all states.
        times_covariance: the product of their covariance with what it is given.

    Returns:
        (M, kinds, 15, probes).
    """
    count, kinds, rows, probes = given.shape
    pairs = (W.transpose(0, 2, 1)[:, None] @ given).transpose(0, 2, 1, 3)
    pairs = pairs.reshape(count, 2, STATE, kinds * probes)
    right = np.zeros((keyframes, STATE, kinds * probes))
    np.add.at(right, first, pairs[:, 0])
    np.add.at(right, first + 1, pairs[:, 1])
    solved = times_covariance(right)
    explained = W @ np.concatenate([solved[first], solved[first + 1]], axis=1)
    return np.asarray(explained.reshape(count, rows, kinds, probes).transpose(0, 2, 1, 3))


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
