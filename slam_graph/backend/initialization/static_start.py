# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Start from standing still: gravity gives roll and pitch, the gyroscope its own bias."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import PriorConfig
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.measurements import ImuData


def state_at_rest(samples: ImuData, stamp_ns: int, prior: PriorConfig) -> NavState:
    """The state of a platform that stood still while the samples were taken.

    Position and yaw are zero: they define the world frame. The accelerometer bias cannot be told
    from a tilt and starts at zero; the prior leaves room for both.

    Args:
        samples: of the IMU at rest.
        stamp_ns: time of the state.
        prior: standard deviations of what the samples do not determine.
    """
    return NavState(
        stamp_ns,
        gtsam.Pose3(level_rotation(samples.accel.mean(axis=0)), np.zeros(3)),
        np.zeros(3),
        accel_bias=np.zeros(3),
        gyro_bias=samples.gyro.mean(axis=0),
        covariance=prior_covariance(prior),
    )


def level_rotation(specific_force: FloatArray) -> gtsam.Rot3:
    """world_R_body with zero yaw that turns a specific force (3,) at rest to world z."""
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

    No measurement of a camera or an IMU sees where the world's origin is, nor its heading
    (Kelly & Sukhatme 2011). What a start state says of their uncertainty would stay in every later
    covariance and hide how far the estimate has drifted.
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
