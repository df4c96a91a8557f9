# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Noise of the IMU that is estimated from residuals at a minimum."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.smoothing.imu_noise_estimation import variance_ratios
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dims_of
from slam_graph.sensors import ImuNoise
from slam_graph.sensors.measurements import ImuData

INTERVALS = 120
IMU = ImuNoise(1.7e-4, 2e-3, 2e-5, 3e-3)


def chain(rng: np.random.Generator) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """IMU factors between states with residuals of the assumed noise."""
    params = IMU.preintegration_params(9.81)
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
        noise = np.linalg.cholesky(pim.preintMeasCov()) @ rng.normal(size=15)
        state = pim.predict(state, bias).retract(np.r_[noise[:6], noise[6:9]])
        bias = gtsam.imuBias.ConstantBias(
            bias.accelerometer() + noise[9:12], bias.gyroscope() + noise[12:15]
        )
    return factors, values


@pytest.mark.parametrize("known", [1e-6, 1e-3])
def test_redundancy_by_random_signs_is_that_of_the_covariances(known: float) -> None:
    """With states that are known well and hardly better than by the IMU alone."""
    rng = np.random.default_rng(2)
    factors, values = chain(rng)
    fixed = gtsam.NonlinearFactorGraph(factors)
    for k in range(INTERVALS + 1):
        prior = gtsam.noiseModel.Isotropic.Sigma(6, known)
        fixed.push_back(gtsam.PriorFactorPose3(X(k), values.atPose3(X(k)), prior))
    loose = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    fixed.push_back(gtsam.PriorFactorConstantBias(B(0), values.atConstantBias(B(0)), loose))
    keys = [key(k) for k in range(INTERVALS + 1) for key in (X, V, B)]
    layout, ordering = Layout(dims_of(keys)), gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    linear = fixed.linearize(values)
    P = np.linalg.inv(linear.hessian(ordering)[0])

    def times_covariance(right: FloatArray) -> FloatArray:
        return np.asarray((P @ right.reshape(len(P), -1)).reshape(right.shape))

    own = [factors.at(k) for k in range(INTERVALS)]
    found = variance_ratios(own, values, INTERVALS + 1, times_covariance)
    expected = exact(own, values, layout, P)
    np.testing.assert_allclose(found, expected, rtol=0.15)


def exact(
    factors: list[gtsam.CombinedImuFactor], values: gtsam.Values, layout: Layout, P: FloatArray
) -> FloatArray:
    """The ratios from the residuals and their covariances, factor by factor."""
    squares, redundancy = np.full(4, 10.0), np.full(4, 10.0)
    for factor in factors:
        linear = gtsam.JacobianFactor(factor.linearize(values))
        A, b = linear.jacobian()
        R = np.linalg.inv(factor.noiseModel().R())
        columns = layout.indices(linear.keys())
        predicted = R @ A @ P[np.ix_(columns, columns)] @ A.T @ R.T
        r, Q = R @ b, R @ R.T
        for kind, first in enumerate((0, 6, 9, 12)):
            rows = slice(first, first + 3)
            inverse = np.linalg.inv(Q[rows, rows])
            squares[kind] += r[rows] @ inverse @ r[rows]
            redundancy[kind] += 3.0 - np.trace(inverse @ predicted[rows, rows])
    return squares / redundancy
