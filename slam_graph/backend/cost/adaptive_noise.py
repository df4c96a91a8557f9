# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How noisy the IMU really is, learned from how the images correct what it predicts.

The densities of a data sheet do not hold for an IMU on a shaking airframe. If they do hold, the
corrections of successive steps are white, and as large as their covariance P⁻ - P⁺ says (Mehra
1970; Mohamed and Schwarz 1999). If the noise is larger, corrections are larger, and since the
filter is slow to follow they keep their direction over many steps. So densities are raised as long
as corrections are both too large and too persistent, and fall back, though never under those of
the calibration. Both must hold because errors of the images that last, as those of a feature that
creeps along an edge, make small corrections persistent as well, and a noisier IMU would trust such
images even more. Corrections of the rotation tell of the gyroscope, those of the velocity of the
accelerometer.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import AdaptiveNoiseConfig, NoiseConfig
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.imu_buffer import preintegration_params
from slam_graph.sensors.rig import ImuNoise

MOST_SURPRISE = 4.0
"""Mean squares above this raise the noise no faster."""
ROTATION, VELOCITY = slice(0, 3), slice(6, 9)
"""Rows of a state's covariance."""


class DensityScale:
    """The factor on the density of one sensor.

    Attributes:
        factor: on the density, at least one.
    """

    def __init__(self, config: AdaptiveNoiseConfig) -> None:
        self._config = config
        self._direction = np.zeros(3)
        self._size = 1.0
        self.factor = 1.0

    def observe(self, correction: FloatArray, covariance: FloatArray, dt_s: float) -> None:
        """Learn from the correction of one step.

        Args:
            correction: (3,) of the predicted quantity by the step.
            covariance: (3, 3) that it should have.
            dt_s: time since the step before.
        """
        variances, axes = np.linalg.eigh(covariance)
        if not variances[0] > 0.0:  # nothing new in some direction: nothing to compare with
            return
        # by the symmetric root, which keeps the frame, so that steps can be compared
        white = axes @ (axes.T @ correction / np.sqrt(variances))
        config = self._config
        memory = np.exp(-dt_s / config.whiteness_s)
        self._direction = memory * self._direction + np.sqrt(1.0 - memory**2) * white
        memory = np.exp(-dt_s / config.size_s)
        self._size = memory * self._size + (1.0 - memory) * float(white @ white) / 3.0
        persistence = float(self._direction @ self._direction) / 3.0
        surprise = min(persistence, self._size, MOST_SURPRISE) - 1.0
        factor = self.factor * np.exp(0.5 * surprise * dt_s / config.response_s)
        self.factor = float(np.clip(factor, 1.0, config.max_factor))


class DynamicsNoise:
    """Parameters of the preintegration that follow the noise of the flight."""

    def __init__(self, imu: ImuNoise, config: NoiseConfig) -> None:
        self._imu = imu
        self._config = config
        self._gyro = DensityScale(config.adaptive)
        self._accel = DensityScale(config.adaptive)

    def params(self, scale: float = 1.0) -> gtsam.PreintegrationCombinedParams:
        """Parameters now, all densities multiplied by `scale`."""
        scale *= self._config.imu_scale
        return preintegration_params(self._imu, self._config.gravity, scale, *self.factors)

    @property
    def factors(self) -> tuple[float, float]:
        """On the white noise densities of gyroscope and accelerometer, at least one."""
        return self._gyro.factor, self._accel.factor

    def learn(self, predicted: NavState, corrected: NavState, dt_s: float) -> None:
        """Compare what the IMU predicted with what the step made of it.

        Args:
            predicted: with the covariance before the step's measurements.
            corrected: with that after them.
            dt_s: time since the step before.
        """
        if not self._config.adaptive.enabled:
            return
        assert predicted.covariance is not None
        assert corrected.covariance is not None
        gained = predicted.covariance - corrected.covariance
        before, after = predicted.world_T_body.rotation(), corrected.world_T_body.rotation()
        turned = gtsam.Rot3.Logmap(before.between(after))
        self._gyro.observe(turned, gained[ROTATION, ROTATION], dt_s)
        faster = corrected.velocity - predicted.velocity
        self._accel.observe(faster, gained[VELOCITY, VELOCITY], dt_s)


def predicted_covariance(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, covariance: FloatArray
) -> FloatArray:
    """The covariance (15, 15) of the state that a dynamics factor predicts.

    Args:
        factor: between the six variables of two IMU states, in the order of
            `gtsam.CombinedImuFactor`.
        values: of both states.
        covariance: (15, 15) of the earlier one: pose, velocity, bias.
    """
    A, _ = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
    before, after = np.hstack([A[:, :9], A[:, 18:24]]), np.hstack([A[:, 9:18], A[:, 24:]])
    root = np.linalg.solve(after, np.hstack([before @ np.linalg.cholesky(covariance), np.eye(15)]))
    return np.asarray(root @ root.T, dtype=np.float64)
