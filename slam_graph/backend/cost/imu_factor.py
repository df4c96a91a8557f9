# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The dynamics model: prediction by the IMU, the factor between frames, and its adaptive noise.

Adaptive IMU noise: estimated from how images correct the predictions of the IMU. The noise
densities of a data sheet do not hold on a vibrating airframe. If the densities are right, the
corrections of successive steps are white and have the covariance P⁻ - P⁺ (Mehra 1970; Mohamed and
Schwarz 1999). If the true noise is larger, corrections are larger, and because the filter follows
slowly they keep their direction over many steps. So densities are raised while corrections are both
too large and persistent, and fall back otherwise, never below those of the calibration. Both
conditions are needed: image errors that last, such as a feature that slides along an edge, make
small corrections persistent, and a noisier IMU would trust such images even more. Corrections of
the rotation are attributed to the white noise of the gyroscope, those of the velocity to that of
the accelerometer, and those of the biases to their random walks: errors of scale and alignment of a
real IMU change with the motion, slower than white noise and faster than a bias at rest. What was
learned of a random walk is kept for longer, as it shows in some motions only.

The dynamics model: the state of a new frame predicted by the IMU, and the factor between frames.
The residual x_{t+1} - g(x_t) of the dynamics is the preintegrated IMU factor of Forster et al. 2017
with the random walk of the biases (GTSAM's `CombinedImuFactor`); the integration itself is in
`ImuData.preintegrated` (`sensors.measurements`).
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, NoiseConfig
from slam_graph.backend.cost.zero_velocity import zero_velocity_factors
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuBuffer, ImuNoise

PERSISTENCE_TIME_S = 0.5
"""Time constant of the mean correction, which shows whether corrections keep their direction."""
SIZE_TIME_S = 2.0
"""Time constant of the mean squared correction."""
RESPONSE_TIME_S = 1.0
"""Time in which the variance grows by a factor of e if squares are twice as large as expected."""
_SLOW_FALL_TIME_S = 10.0
"""The same for random walks and the accelerometer while they fall back."""
_FIRST_ACCEL, _FIRST_ACCEL_WALK = 3.0, 2.0
"""Factors on the densities of the accelerometer at the start, where nothing is learned yet. Motors
shake it, and errors of its scale and alignment show in the first motions: a start that believes the
data sheet takes both for a tilt."""
MAX_FACTOR = 30.0
"""Largest factor on a density."""
_MAX_SQUARE = 4.0
"""Mean squares are clipped here, which limits how fast the noise grows."""
IMU_GAP_SCALE = 1000.0
"""Factor on the noise densities between two frames where samples are missing: the IMU then hardly
counts."""
_ROTATION, _VELOCITY = slice(0, 3), slice(6, 9)
_ACCEL_BIAS, _GYRO_BIAS = slice(9, 12), slice(12, 15)
"""Rows of a state's covariance."""


class DensityScale:
    """The factor on one density of one sensor.

    Attributes:
        factor: on the noise density, at least one.
    """

    def __init__(self, fall_time_s: float = RESPONSE_TIME_S, factor: float = 1.0) -> None:
        """Begin with a multiple of the calibrated density.

        Args:
            fall_time_s: takes the place of `RESPONSE_TIME_S` while the factor falls.
            factor: at the start.
        """
        self._fall_time_s = fall_time_s
        self._direction = np.zeros(3)
        self._size = 1.0
        self.factor = factor

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
        surprise = min(persistence, self._size, _MAX_SQUARE) - 1.0
        response_s = RESPONSE_TIME_S if surprise > 0.0 else self._fall_time_s
        factor = self.factor * np.exp(0.5 * surprise * dt_s / response_s)
        self.factor = float(np.clip(factor, 1.0, MAX_FACTOR))


class DynamicsNoise:
    """Noise parameters of the preintegration that adapt during the run."""

    def __init__(self, imu: ImuNoise, config: NoiseConfig) -> None:
        self._imu = imu
        self._config = config
        adapts = config.adaptive.enabled
        self._gyro = DensityScale()
        self._accel = DensityScale(_SLOW_FALL_TIME_S, _FIRST_ACCEL if adapts else 1.0)
        self._gyro_walk = DensityScale(_SLOW_FALL_TIME_S)
        self._accel_walk = DensityScale(_SLOW_FALL_TIME_S, _FIRST_ACCEL_WALK if adapts else 1.0)

    def params(self, scale: float = 1.0) -> gtsam.PreintegrationCombinedParams:
        """Current parameters, with all densities multiplied by `scale`."""
        scale *= self._config.imu_scale
        imu = replace(
            self._imu,
            gyro_random_walk=self._imu.gyro_random_walk * self._gyro_walk.factor,
            accel_random_walk=self._imu.accel_random_walk * self._accel_walk.factor,
        )
        return imu.preintegration_params(self._config.gravity, scale, *self.factors)

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
        accel_bias = corrected.accel_bias - predicted.accel_bias
        self._accel_walk.observe(accel_bias, gained[_ACCEL_BIAS, _ACCEL_BIAS], dt_s)
        gyro_bias = corrected.gyro_bias - predicted.gyro_bias
        self._gyro_walk.observe(gyro_bias, gained[_GYRO_BIAS, _GYRO_BIAS], dt_s)


def _predicted_covariance(
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


def imu_factor(
    i: int, j: int, pim: gtsam.PreintegratedCombinedMeasurements
) -> gtsam.CombinedImuFactor:
    """The dynamics residual between frames i and j."""
    return gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim)


class Propagation:
    """Appends a new frame to a window by the dynamics model.

    Attributes:
        noise: of the IMU; it adapts to the innovations where the settings ask for it.
    """

    def __init__(self, imu: ImuNoise, config: BackendConfig, diagnostics: Diagnostics) -> None:
        self.config = config
        self.diagnostics = diagnostics
        self.noise = DynamicsNoise(imu, config.noise)
        self._last: NavState | None = None
        self._predicted: NavState | None = None

    def append_frame(self, window: Window, imu: ImuBuffer, stamp_ns: int, still: bool) -> None:
        """Make a new frame the current one.

        Args:
            window: gets the predicted state of the new frame, and the factors between it and the
                frame before.
            imu: samples up to the frame.
            stamp_ns: time of the frame on the clock of the IMU.
            still: whether the platform has not moved.
        """
        i, j = window.frame, window.frame + 1
        previous = window.state.nav_state(i, window.stamp_ns, None)
        samples = imu.between(window.stamp_ns, stamp_ns)
        bias = window.state.estimate.atConstantBias(B(i))
        pim = samples.preintegrated(bias, self._params(imu, window.stamp_ns, stamp_ns))
        predicted = previous.predicted(pim, stamp_ns)
        window.state.insert_imu_state(j, predicted)
        window.past.append(i)
        window.moving.append(i)
        window.frame, window.stamp_ns = j, stamp_ns
        factor = imu_factor(i, j, pim)
        window.factors.append(factor)
        self._predicted = None if still else self._with_covariance(predicted, factor, window)
        if still:
            window.factors += zero_velocity_factors(i, j)

    def _with_covariance(
        self, predicted: NavState, factor: gtsam.CombinedImuFactor, window: Window
    ) -> NavState | None:
        """A prediction from the last state, with its covariance where that is known."""
        last = self._last
        if last is None or last.covariance is None:
            return None
        covariance = _predicted_covariance(factor, window.state.estimate, last.covariance)
        return replace(predicted, covariance=covariance)

    def learn(self, state: NavState) -> None:
        """Adapt the noise of the IMU to the difference of an estimate from its prediction."""
        if self._last is not None and self._predicted is not None:
            dt_s = (state.stamp_ns - self._last.stamp_ns) * 1e-9
            self.noise.learn(self._predicted, state, dt_s)
        self._last = state

    def _params(
        self, imu: ImuBuffer, start_ns: int, end_ns: int
    ) -> gtsam.PreintegrationCombinedParams:
        """Parameters of the preintegration; where samples are missing, with much larger noise."""
        gap_s = imu.largest_gap_s(start_ns, end_ns)
        if gap_s <= self.config.noise.max_imu_gap_s:
            return self.noise.params()
        self.diagnostics.warn("imu_gap_bridged", f"{gap_s:.3f} s without IMU samples")
        return self.noise.params(IMU_GAP_SCALE)
