# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Noise of the IMU that is estimated from residuals at a minimum."""

from typing import Any

import gtsam
import numpy as np
import pytest
from groups import slow
from gtsam.symbol_shorthand import B, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.smoothing.imu_noise_estimation import ImuNoiseFactors, variance_ratios
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dims_of
from slam_graph.sensors import ImuNoise
from slam_graph.sensors.measurements import ImuData

INTERVALS = 120
IMU = ImuNoise(
    gyro_noise_density=1.7e-4,
    accel_noise_density=2e-3,
    gyro_random_walk=2e-5,
    accel_random_walk=3e-3,
)


def chain(
    rng: np.random.Generator, real: ImuNoise = IMU, assumed: ImuNoise = IMU
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """IMU factors of an assumed noise between true states, with residuals of the real one."""
    params, drawn = assumed.preintegration_params(9.81), real.preintegration_params(9.81)
    stamps_ns = np.arange(0, 210_000_000, 10_000_000)
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    state, bias = gtsam.NavState(), gtsam.imuBias.ConstantBias()
    for k in range(INTERVALS + 1):
        values.insert(X(k), state.pose())
        values.insert(V(k), state.velocity())
        values.insert(B(k), bias)
        gyro, accel = rng.normal(0.0, 0.5, 3), rng.normal([0.0, 0.0, 9.81], 1.0)
        count = len(stamps_ns)
        data = ImuData(stamps_ns, np.tile(gyro, (count, 1)), np.tile(accel, (count, 1)))
        pim = data.preintegrated(bias, params)
        if k < INTERVALS:
            factors.push_back(imu_factor(k, k + 1, pim))
        model: Any = imu_factor(k, k + 1, data.preintegrated(bias, drawn)).noiseModel()
        noise = np.linalg.solve(model.R(), rng.normal(size=15))
        state = pim.predict(state, bias).retract(np.r_[noise[:6], noise[6:9]])
        bias = gtsam.imuBias.ConstantBias(
            bias.accelerometer() + noise[9:12], bias.gyroscope() + noise[12:15]
        )
    return factors, values


def minimum(
    factors: gtsam.NonlinearFactorGraph, truth: gtsam.Values, known: float
) -> tuple[gtsam.Values, Layout, FloatArray]:
    """The minimum with poses that are known to m and rad, and the covariance of all states."""
    fixed = gtsam.NonlinearFactorGraph(factors)
    for k in range(INTERVALS + 1):
        prior = gtsam.noiseModel.Isotropic.Sigma(6, known)
        fixed.push_back(gtsam.PriorFactorPose3(X(k), truth.atPose3(X(k)), prior))
    loose = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    fixed.push_back(gtsam.PriorFactorConstantBias(B(0), truth.atConstantBias(B(0)), loose))
    keys = [key(k) for k in range(INTERVALS + 1) for key in (X, V, B)]
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    values = gtsam.LevenbergMarquardtOptimizer(fixed, truth).optimize()
    P = np.asarray(np.linalg.inv(fixed.linearize(values).hessian(ordering)[0]), np.float64)
    return values, Layout(dims_of(keys)), P


def ratios_of(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, P: FloatArray
) -> FloatArray:
    """The ratios of the variances."""

    def times_covariance(right: FloatArray) -> FloatArray:
        return np.asarray((P @ right.reshape(len(P), -1)).reshape(right.shape))

    return variance_ratios(imu_factors(factors), values, INTERVALS + 1, times_covariance)


def imu_factors(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.CombinedImuFactor]:
    return [f for f in map(graph.at, range(INTERVALS)) if isinstance(f, gtsam.CombinedImuFactor)]


@pytest.mark.parametrize("known", [1e-6, 1e-3])
def test_ratios_by_random_signs_are_those_of_all_covariances(known: float) -> None:
    """With states that are known well and hardly better than by the IMU alone."""
    factors, truth = chain(np.random.default_rng(2))
    values, layout, P = minimum(factors, truth, known)
    found = ratios_of(factors, values, P)
    expected, sigmas = exact(imu_factors(factors), values, layout, P)
    assert np.all(np.abs(found - expected) < sigmas)  # 16 vectors tell less than the data do


@pytest.mark.parametrize("seed", [slow(3), 4, slow(5)])
def test_rounds_find_a_noise_that_is_not_as_assumed(seed: int) -> None:
    """White noise of both sensors and both walks; the gyroscope's must be large to be seen."""
    factors_of_noise = np.array([1.5, 0.7, 3.0, 20.0])
    assumed = np.array([1.0, 1.0, 1.0, 10.0])
    real, found = scaled(factors_of_noise), assumed.copy()
    away = [np.abs(np.log(found / factors_of_noise))]
    for _ in range(4):
        factors, truth = chain(np.random.default_rng(seed), real, scaled(found))
        values, layout, P = minimum(factors, truth, 1e-6)
        found *= np.sqrt(ratios_of(factors, values, P))
        away.append(np.abs(np.log(found / factors_of_noise)))
    _, sigmas = exact(imu_factors(factors), values, layout, P)
    assert np.all(away[2] < 0.6 * away[0])  # as many rounds as an adjustment takes
    assert np.all(away[4] < 4.0 * 0.5 * sigmas)  # 3 of the data, 1 of the random signs


def test_rounds_come_back_from_a_bound_at_once() -> None:
    """However many rounds have found less noise than is calibrated."""
    noise = ImuNoiseFactors()
    for _ in range(10):
        noise = noise.times(np.array([0.2, 0.2, 1.0, 1.0])).bounded(2.0, 1.0)
    assert noise.white(2.0, 1.0) == (1.0, 1.0)
    again = noise.times(np.array([4.0, 9.0, 1.0, 1.0])).bounded(2.0, 1.0)
    assert np.allclose(again.white(2.0, 1.0), (2.0, 3.0))


def scaled(factors: FloatArray) -> ImuNoise:
    """The noise with factors on white noise of gyroscope, accelerometer, and both walks."""
    gyro, accel, accel_walk, gyro_walk = factors.tolist()
    return ImuNoise(
        gyro_noise_density=IMU.gyro_noise_density * gyro,
        accel_noise_density=IMU.accel_noise_density * accel,
        gyro_random_walk=IMU.gyro_random_walk * gyro_walk,
        accel_random_walk=IMU.accel_random_walk * accel_walk,
    )


def exact(
    factors: list[gtsam.CombinedImuFactor], values: gtsam.Values, layout: Layout, P: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The ratios from all residuals and their covariance, and their standard deviations."""
    W, e = np.zeros((len(factors), 15, len(P))), np.zeros((len(factors), 15))
    S = np.zeros((4, len(factors), 15, 15))
    for number, factor in enumerate(factors):
        linear = gtsam.JacobianFactor(factor.linearize(values))
        A, b = linear.jacobian()
        noise: Any = factor.noiseModel()  # a type that the stubs do not know
        R = np.linalg.inv(noise.R())
        L = np.linalg.cholesky(R @ R.T)
        white = np.linalg.inv(L)
        W[number][:, layout.indices(linear.keys())] = white @ R @ A
        e[number] = white @ R @ b
        for kind, rows in enumerate((slice(0, 3), slice(3, 9), slice(9, 12), slice(12, 15))):
            half = white[:, rows] @ L[rows]
            S[kind, number] = 0.5 * (half + half.T)
    rows_of = W.reshape(-1, len(P))
    M = np.eye(len(rows_of)) - rows_of @ P @ rows_of.T
    SM = [(own @ M.reshape(len(factors), 15, -1)).reshape(M.shape) for own in S]
    F = np.array([[np.sum(one * other.T) for other in SM] for one in SM]) + 10.0 * np.eye(4)
    squares = np.einsum("ma,kmab,mb->k", e, S, e)
    ratios = 1.0 + np.linalg.solve(F, squares - [np.trace(own) for own in SM])
    return ratios, np.sqrt(2.0 * np.linalg.inv(F).diagonal())
