# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The dynamics model: the state of a new frame predicted by the IMU, and the factor between frames.

The residual x_{t+1} - g(x_t) of the dynamics is the preintegrated IMU factor of Forster et al. 2017
with the random walk of the biases (GTSAM's `CombinedImuFactor`); the integration itself is in
`ImuData.preintegrated` (`sensors.measurements`), the noise in `adaptive_imu_noise.py`.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.adaptive_imu_noise import DynamicsNoise
from slam_graph.backend.cost.vibration_covariance import VibrationCovariance
from slam_graph.backend.cost.zero_velocity import zero_velocity_factors
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuBuffer, ImuNoise

IMU_GAP_SCALE = 1000.0
"""Factor on the noise densities between two frames where samples are missing: the IMU then hardly
counts."""


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
    before, after = _jacobians(factor, values)
    root = np.linalg.solve(after, np.hstack([before @ np.linalg.cholesky(covariance), np.eye(15)]))
    return np.asarray(root @ root.T, dtype=np.float64)


def _jacobians(
    factor: gtsam.NonlinearFactor, values: gtsam.Values
) -> tuple[FloatArray, FloatArray]:
    """The whitened Jacobians (15, 15) of a dynamics factor by the earlier and the later state."""
    A, _ = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
    return np.hstack([A[:, :9], A[:, 18:24]]), np.hstack([A[:, 9:18], A[:, 24:]])


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
        self._vibration = VibrationCovariance(config.noise.imu_scale * imu.accel_noise_density)
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
        self._predict_vibration(factor, window)
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

    def _predict_vibration(self, factor: gtsam.CombinedImuFactor, window: Window) -> None:
        """Carry what vibration adds to the covariance on to the new frame."""
        if self._predicted is None or self._last is None:
            self._vibration.stay()
        elif self.noise.vibrates or not self._vibration.vanishes:
            before, after = _jacobians(factor, window.state.estimate)
            dt_s = (window.stamp_ns - self._last.stamp_ns) * 1e-9
            transition = np.asarray(-np.linalg.solve(after, before), dtype=np.float64)
            self._vibration.predict(transition, dt_s, self.noise.vibrates)

    def reported(self, state: NavState) -> NavState:
        """The state of the last frame with the covariance that vibration gives it."""
        return self._vibration.added_to(state)

    def learn(self, state: NavState) -> None:
        """Adapt the noise of the IMU to the difference of an estimate from its prediction."""
        if self._last is not None and self._predicted is not None:
            dt_s = (state.stamp_ns - self._last.stamp_ns) * 1e-9
            self.noise.learn(self._predicted, state, dt_s)
            if self.noise.vibrates or not self._vibration.vanishes:
                assert self._predicted.covariance is not None
                assert state.covariance is not None
                self._vibration.correct(self._predicted.covariance, state.covariance)
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
