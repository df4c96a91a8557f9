# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Adaptive IMU noise: estimated from how images correct the predictions of the IMU.

The noise densities of a data sheet do not hold on a vibrating airframe. If the densities are right,
the corrections of successive steps are white and have the covariance P⁻ - P⁺ (Mehra 1970; Mohamed
and Schwarz 1999). If the true noise is larger, corrections are larger, and because the filter
follows slowly they keep their direction over many steps. So densities are raised while corrections
are both too large and persistent, and fall back otherwise, never below those of the calibration.
Both conditions are needed: image errors that last, such as a feature that slides along an edge,
make small corrections persistent, and a noisier IMU would trust such images even more. Corrections
of the rotation are attributed to the gyroscope, those of the velocity to the accelerometer.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuNoise, preintegration_params

PERSISTENCE_TIME_S = 0.5
"""Time constant of the mean correction, which shows whether corrections keep their direction."""
SIZE_TIME_S = 2.0
"""Time constant of the mean squared correction."""
RESPONSE_TIME_S = 1.0
"""Time in which the variance grows by a factor of e if squares are twice as large as expected."""
MAX_FACTOR = 30.0
"""Largest factor on a density."""
MAX_SQUARE = 4.0
"""Mean squares are clipped here, which limits how fast the noise grows."""
IMU_GAP_SCALE = 1000.0
"""Factor on the noise densities between two frames where samples are missing: the IMU then hardly
counts."""
_ROTATION, _VELOCITY = slice(0, 3), slice(6, 9)
"""Rows of a state's covariance."""


class DensityScale:
    """The factor on the density of one sensor.

    Attributes:
        factor: on the noise density, at least one.
    """

    def __init__(self) -> None:
        self._direction = np.zeros(3)
        self._size = 1.0
        self.factor = 1.0

    def observe(self, correction: FloatArray, covariance: FloatArray, dt_s: float) -> None:
        """Update the factor by the correction of one step.

        Args:
            correction: (3,) of the predicted quantity, in the body frame or in the world.
            covariance: (3, 3) that it has if the densities are right, in the same frame.
            dt_s: time since the step before.
        """
        variances, axes = np.linalg.eigh(covariance)
        if not variances[0] > 0.0:  # no information in some direction
            return
        # whitened by the symmetric root, which keeps the axes, so that directions can be compared
        white = axes @ (axes.T @ correction / np.sqrt(variances))
        memory = np.exp(-dt_s / PERSISTENCE_TIME_S)
        self._direction = memory * self._direction + np.sqrt(1.0 - memory**2) * white
        memory = np.exp(-dt_s / SIZE_TIME_S)
        self._size = memory * self._size + (1.0 - memory) * float(white @ white) / 3.0
        persistence = float(self._direction @ self._direction) / 3.0
        surprise = min(persistence, self._size, MAX_SQUARE) - 1.0
        factor = self.factor * np.exp(0.5 * surprise * dt_s / RESPONSE_TIME_S)
        self.factor = float(np.clip(factor, 1.0, MAX_FACTOR))


class DynamicsNoise:
    """Noise parameters of the preintegration that adapt during the run."""

    def __init__(self, imu: ImuNoise, config: NoiseConfig) -> None:
        self._imu = imu
        self._config = config
        self._gyro = DensityScale()
        self._accel = DensityScale()

    def params(self, scale: float = 1.0) -> gtsam.PreintegrationCombinedParams:
        """Current parameters, with all densities multiplied by `scale`."""
        scale *= self._config.imu_scale
        return preintegration_params(self._imu, self._config.gravity, scale, *self.factors)

    @property
    def factors(self) -> tuple[float, float]:
        """Factors on the white noise densities of gyroscope and accelerometer, at least one."""
        return self._gyro.factor, self._accel.factor

    def learn(self, predicted: NavState, corrected: NavState, dt_s: float) -> None:
        """Compare the state that the IMU predicted with the state after the step.

        Args:
            predicted: with the covariance before the step's measurements.
            corrected: with the covariance after them.
            dt_s: time since the step before.
        """
        if not self._config.adaptive.enabled:
            return
        assert predicted.covariance is not None
        assert corrected.covariance is not None
        gained = predicted.covariance - corrected.covariance
        before, after = predicted.world_T_body.rotation(), corrected.world_T_body.rotation()
        rotation = gtsam.Rot3.Logmap(before.between(after))
        self._gyro.observe(rotation, gained[_ROTATION, _ROTATION], dt_s)
        velocity = corrected.velocity - predicted.velocity
        self._accel.observe(velocity, gained[_VELOCITY, _VELOCITY], dt_s)


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
