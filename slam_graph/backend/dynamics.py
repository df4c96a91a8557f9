# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The dynamics as a policy: what predicts the state of the next frame.

`imu` preintegrates gyroscope and accelerometer. `constant_velocity` takes linear and angular
acceleration for white noise: the velocity keeps its direction in the world, the angular rate ω its
direction in the body. Its state has the same variables. The rate stands in the place of the bias of
the gyroscope, as -ω, because the model is that of an IMU that measures nothing in a world without
gravity: the noise of such an accelerometer is the acceleration, the random walk of such a
gyroscope's bias is the angular acceleration. So preintegration, the factor between frames, the
noise that is learned on the way, every algorithm and the final adjustment are the same for both.

Without an accelerometer nothing tells where down is: the world is the first camera's, and position
and all of the rotation are what the measurements do not observe.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, DynamicsConfig
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.errors import ConfigError
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuBuffer, ImuData, ImuNoise, Rig

_STEPS = 16
"""Steps of integration from frame to frame: variances of the rotation are exact to 9 %."""
_NOTHING = 1e-6
"""Noise densities that the model does not have; preintegration wants them positive."""
_NO_GAP_S = 1e9
"""No time between frames is a gap in the samples of the model."""
_ANGULAR_RATE_SIGMA = 3.0
"""Standard deviation of the angular rate of a given state, which does not have it, rad/s."""
_STATE_FEATURE_FRAMES = 2
"""Features enter the state when so many frames have seen them: without an IMU they are what holds
the pose from frame to frame."""

_MORE_FEATURES, _MORE_WITH_DEPTH = 1.25, 2.5
"""How many times as many features are held in the state as with an IMU. Two cameras know far
points less exactly than a filter can linearise, so more features make it too sure: on simulated
flights of `msckf` the NEES of position and orientation is 4.6 and 4.1 with 60 features (1.5 times)
and 3.7 and 3.5 with 50, where 4.16 is the bar. With 100 the NEES of position is twice as large as
with 40. With 40 a box that begins to move pulls the pose by 0.04, 0.09 and 0.25 m in three of 13
flights."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """The problem as the engine solves it, under the dynamics that were chosen.

    Attributes:
        rig: the sensors; without an IMU its `imu` is the noise of the model.
        algorithm: the policies.
        config: settings that do not depend on the algorithm.
    """

    rig: Rig
    algorithm: AlgorithmConfig
    config: BackendConfig

    @staticmethod
    def of(rig: Rig, algorithm: AlgorithmConfig, config: BackendConfig) -> Dynamics:
        """The dynamics of `backend.dynamics.model`.

        Raises:
            ConfigError: if they want an IMU and there is none, or a setting wants one.
        """
        if config.dynamics.uses_imu(rig.has_imu):
            return Dynamics(rig, algorithm, config)
        return ConstantVelocity(
            model_rig(rig, config.dynamics),
            without_prediction(algorithm, rig),
            without_imu(config, rig.sees_depth),
        )

    def extend(self, imu: ImuBuffer, until_ns: int) -> None:
        """Add to the samples of an IMU what the model says of the time up to a frame."""

    def given(self, state: NavState) -> NavState:
        """A state that was given from outside, as a state of this model."""
        return state

    def reported(self, state: NavState) -> NavState:
        """A state of this model as users know it."""
        return state


class ConstantVelocity(Dynamics):
    """White noise on linear and angular acceleration; see the module."""

    def extend(self, imu: ImuBuffer, until_ns: int) -> None:
        """Add samples of an IMU that measures nothing."""
        newest_ns = imu.newest_ns() if len(imu.data) else None
        if newest_ns is None or newest_ns < until_ns:
            imu.add(motionless_samples(newest_ns, until_ns))

    def given(self, state: NavState) -> NavState:
        """The state with an unknown angular rate in the place of its biases."""
        assert state.covariance is not None
        covariance = state.covariance.copy()
        covariance[9:], covariance[:, 9:] = 0.0, 0.0
        covariance[9:, 9:] = bias_covariance(_ANGULAR_RATE_SIGMA)
        return replace(self.reported(state), covariance=covariance)

    def reported(self, state: NavState) -> NavState:
        """The state without biases: there is no sensor that has them."""
        return replace(state, accel_bias=np.zeros(3), gyro_bias=np.zeros(3))


def model_rig(rig: Rig, config: DynamicsConfig) -> Rig:
    """The rig with the noise of an IMU that measures nothing; see the module."""
    noise = ImuNoise(
        gyro_noise_density=_NOTHING,
        gyro_random_walk=config.angular_accel_density,
        accel_noise_density=config.accel_density,
        accel_random_walk=_NOTHING,
    )
    return replace(rig, imu=noise, has_imu=False)


def without_imu(config: BackendConfig, sees_depth: bool) -> BackendConfig:
    """The settings without gravity, and without all that compares images with an IMU.

    The gate compares observations with a prediction, which is vague here, so it lets tracks pass
    that are off by pixels. The loss has to see to them, and be one whose weight vanishes; not where
    lengths are not measured, as it may then lose the way from a poor scale.

    Args:
        config: the settings.
        sees_depth: whether the images of one time measure lengths.

    Raises:
        ConfigError: if a time offset is to be estimated, which wants an IMU.
    """
    if config.calibration.time_offset:
        raise ConfigError(
            "backend.calibration.time_offset compares cameras with an IMU, and none is used; "
            "remove it"
        )
    noise = config.noise.model_copy(
        update={"gravity": 0.0, "max_imu_gap_s": _NO_GAP_S, "imu_scale": 1.0}
    )
    gating = config.gating
    if sees_depth and gating.robust_loss is None:
        gating = gating.model_copy(update={"robust_loss": "cauchy"})
    return config.model_copy(
        update={
            "noise": noise,
            "gating": gating,
            "zero_velocity": config.zero_velocity.model_copy(update={"enabled": False}),
            "initialization": config.initialization.model_copy(
                update={"check_calibration": False, "fix_gauge": False}
            ),
        }
    )


def without_prediction(algorithm: AlgorithmConfig, rig: Rig) -> AlgorithmConfig:
    """The policies for frames whose poses nothing but their features tells.

    Features enter early, where nothing else was asked for. Where their distances are measured, more
    of them are held, and those that are lost are kept: they are what a turn there and back is
    measured against. In GTSAM's smoothers every frame is a state, and the lag is half as long, so
    that they hold about as many as with an IMU.
    """
    cost, smoother = algorithm.cost, algorithm.smoother
    if cost.max_state_features != 0 and cost.state_feature_frames is None:
        cost = cost.model_copy(update={"state_feature_frames": _STATE_FEATURE_FRAMES})
    if cost.max_state_features != 0 and rig.sees_depth:
        more = _MORE_FEATURES if rig.depth is None else _MORE_WITH_DEPTH
        update: dict[str, Any] = {}
        if cost.keep_lost_features is None:
            update["keep_lost_features"] = True
        if cost.max_state_features is not None:
            update["max_state_features"] = round(more * cost.max_state_features)
        cost = cost.model_copy(update=update)
    early: dict[str, Any] = {"spacing_s": 0.0, "lag_s": 0.5 * smoother.lag_s}
    if smoother.min_feature_frames is None:
        early["min_feature_frames"] = _STATE_FEATURE_FRAMES
    if smoother.min_parallax_rad is None:
        early["min_parallax_rad"] = 0.0
    return algorithm.model_copy(
        update={"cost": cost, "smoother": smoother.model_copy(update=early)}
    )


def motionless_samples(after_ns: int | None, until_ns: int) -> ImuData:
    """Samples of an IMU that measures nothing, after one time and up to another."""
    steps = np.array([until_ns])
    if after_ns is not None:
        steps = after_ns + (until_ns - after_ns) * np.arange(1, _STEPS + 1) // _STEPS
        if until_ns - after_ns < _STEPS:  # fewer nanoseconds than steps
            steps = np.unique(steps[steps > after_ns])
    none = np.zeros((len(steps), 3))
    return ImuData(steps, none, none)


def bias_covariance(angular_rate_sigma: float) -> FloatArray:
    """Covariance (6, 6) of the biases of a state of `constant_velocity`, accelerometer first."""
    return np.diag(np.repeat([_NOTHING**2, angular_rate_sigma**2], 3))
