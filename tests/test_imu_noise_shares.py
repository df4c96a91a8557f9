# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What each kind of noise adds to preintegrated motion, against GTSAM's covariance."""

import gtsam
import numpy as np
import pytest

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.smoothing.imu_noise_shares import noise_shares
from slam_graph.sensors.measurements import ImuSteps

KINDS = ("gyro", "accel", "accel_walk", "gyro_walk")


def intervals(rng: np.random.Generator) -> list[ImuSteps]:
    """Fast motion over 0.2 s in steps of about 5 ms, some more in one interval than in another."""
    found = []
    for count in (37, 40, 43):
        rates = rng.normal(0.0, 1.5, 3) + rng.normal(0.0, 0.3, (count, 3))
        forces = rng.normal([0.0, 0.0, 9.8], 2.0) + rng.normal(0.0, 1.0, (count, 3))
        found.append(ImuSteps(rng.uniform(4.5e-3, 5.5e-3, count), rates, forces))
    return found


def covariance(steps: ImuSteps, bias: gtsam.imuBias.ConstantBias, kind: str | None) -> FloatArray:
    """That of the residuals of GTSAM's factor under noise of unit density of one kind."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    gyro, accel, accel_walk, gyro_walk = (
        np.eye(3) * (1.0 if kind == own else 1e-6) for own in KINDS
    )
    params.setGyroscopeCovariance(gyro)
    params.setAccelerometerCovariance(accel)
    params.setBiasAccCovariance(accel_walk)
    params.setBiasOmegaCovariance(gyro_walk)
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    factor = imu_factor(0, 1, steps.preintegrated(bias, params))
    return np.asarray(factor.noiseModel().covariance())


@pytest.mark.parametrize("number", range(len(KINDS)), ids=KINDS)
def test_the_shares_are_those_of_gtsam(number: int) -> None:
    rng = np.random.default_rng(3)
    steps = intervals(rng)
    biases = [gtsam.imuBias.ConstantBias(rng.normal(0.0, 0.1, 3), rng.normal(0.0, 0.02, 3))] * 3
    shares = noise_shares(
        [own.durations_s for own in steps],
        [own.gyro - bias.gyroscope() for own, bias in zip(steps, biases, strict=True)],
        [own.accel - bias.accelerometer() for own, bias in zip(steps, biases, strict=True)],
    )
    for own, bias, share in zip(steps, biases, shares[:, number], strict=True):
        expected = covariance(own, bias, KINDS[number]) - covariance(own, bias, None)
        sigmas = np.sqrt(np.maximum(np.diag(expected), 0.0))
        scale = np.outer(sigmas, sigmas) + 1e-9
        assert np.abs((share - expected) / scale).max() < 3e-3
