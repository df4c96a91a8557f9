# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The first state: from standstill or as given, its covariance, and the window that begins with it.

At standstill gravity gives roll and pitch, and the gyroscope measures its own bias.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.backend_config import BackendConfig, PriorConfig
from slam_graph.backend.online_calibration import CalibrationVariables
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of, imu_state_keys
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuData

_BLOCKS = 10
"""Blocks into which the samples at rest are divided, for the scatter of their mean."""
_LEAST_FORCE = 1.0
"""m/s²: a specific force at rest that is smaller is not that of gravity, and levels nothing."""


def state_at_rest(samples: ImuData, stamp_ns: int, prior: PriorConfig) -> NavState:
    """The state of a platform that stood still while the samples were taken.

    Position and yaw are zero: they define the world frame. The accelerometer bias is not observable
    apart from the tilt and starts at zero; the covariance has what they share.

    Args:
        samples: of the IMU at rest.
        stamp_ns: time of the state.
        prior: standard deviations.
    """
    force = samples.accel.mean(axis=0)
    return NavState(
        stamp_ns,
        gtsam.Pose3(level_rotation(force), np.zeros(3)),
        np.zeros(3),
        accel_bias=np.zeros(3),
        gyro_bias=samples.gyro.mean(axis=0),
        covariance=_covariance_at_rest(samples.accel, prior),
    )


def _covariance_at_rest(forces: FloatArray, prior: PriorConfig) -> FloatArray:
    """Covariance (15, 15) of a state whose tilt was taken from the specific force at rest.

    The mean force is that of gravity, g u in the body frame, the bias b, and its error n. With
    R = R̂ exp(δ) the levelled attitude R̂ u ∥ z has g u × (δ × u) = u × (b + n), that is
    δ = u × (b + n) / g across u. Left out, tilt and bias would be uncertain apart, and the first
    acceleration unknown by g times the tilt.

    Args:
        forces: (N, 3) specific forces, m/s².
        prior: standard deviations; that of the attitude is what neither the bias nor the scatter
            of the forces explains.
    """
    force = forces.mean(axis=0)
    tilt = skew(force) / max(float(force @ force), _LEAST_FORCE**2)  # u / g
    root = np.eye(15)
    root[:3, 9:12] = tilt
    covariance = root @ prior_covariance(prior) @ root.T
    covariance[:3, :3] += tilt @ _covariance_of_mean(forces) @ tilt.T
    return np.asarray(covariance)


def _covariance_of_mean(forces: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the mean of forces (N, 3), by the means of blocks of time.

    Vibration of motors is correlated from sample to sample, and hardly from block to block.
    """
    if len(forces) < 2 * _BLOCKS:
        return np.zeros((3, 3))
    means = np.array([block.mean(axis=0) for block in np.array_split(forces, _BLOCKS)])
    return np.asarray(np.cov(means, rowvar=False) / _BLOCKS)


def level_rotation(specific_force: FloatArray) -> gtsam.Rot3:
    """world_R_body with zero yaw that rotates a specific force (3,) at rest onto world z."""
    x, y, z = specific_force
    roll = np.arctan2(y, z)
    pitch = np.arctan2(-x, np.hypot(y, z))
    return gtsam.Rot3.RzRyRx(roll, pitch, 0.0)


def prior_covariance(prior: PriorConfig) -> FloatArray:
    """Covariance (15, 15) in the order of `NavState.covariance`."""
    sigmas = np.repeat(
        [prior.attitude_rad, prior.position_m, prior.velocity, prior.accel_bias, prior.gyro_bias], 3
    )
    return np.diag(sigmas**2)


def fix_gauge(state: NavState, prior: PriorConfig) -> NavState:
    """The state with its position and yaw taken as the definition of the world frame.

    Global position and yaw are unobservable to cameras and IMU (Kelly & Sukhatme 2011): their
    initial uncertainty would stay in every later covariance and hide the drift since the start.

    Args:
        state: with its covariance.
        prior: standard deviations of position and yaw in the new frame.
    """
    assert state.covariance is not None
    covariance = state.covariance.copy()
    up = state.world_T_body.rotation().matrix().T @ np.array([0.0, 0.0, 1.0])
    level = np.eye(15)
    level[:3, :3] -= np.outer(up, up)
    level[3:6, 3:6] = 0.0
    covariance = level @ covariance @ level.T
    covariance[:3, :3] += np.outer(up, up) * prior.yaw_rad**2
    covariance[3:6, 3:6] += np.eye(3) * prior.position_m**2
    return replace(state, covariance=covariance)


def start_from(
    given: NavState, config: BackendConfig, calibration: CalibrationVariables | None = None
) -> Window:
    """The window that begins with a given state.

    Args:
        given: with its covariance.
        config: whether the state defines the world frame.
        calibration: parameters of the rig that are estimated; they begin with their prior.
    """
    if config.initialization.fix_gauge:
        given = fix_gauge(given, config.initialization.prior)
    state = State()
    state.insert_imu_state(0, given)
    state.freeze(imu_state_keys(0))
    prior = prior_of(given)
    if calibration is None:
        return Window(0, given.stamp_ns, state, prior)
    prior = calibration.enter(state, prior)
    return Window(0, given.stamp_ns, state, prior, calibration=calibration.keys)


def prior_of(given: NavState, frame: int = 0) -> SquareRootInformation:
    """The Gaussian with the mean and covariance of a state, on the variables of a frame."""
    assert given.covariance is not None
    Rd = np.zeros((16, 16), order="F")
    Rd[:-1, :-1] = np.linalg.cholesky(np.linalg.inv(given.covariance)).T
    return SquareRootInformation(Layout(dims_of(imu_state_keys(frame))), Rd)
