# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The first state of the platform in the frame of an object, before any motion is seen.

An object has few points close together, so PnP from one frame to the next tells its turn and its
shift badly, and the two errors together: 2° and 0.2 m within 0.1 s on a box 3.5 m ahead, several
times what a state may be off that comes from a whole scene. Images before that state are lost, too.
So an object begins in its first frame, with a velocity of which next to nothing is known and an
angular rate that bodies have; the images tell the rest.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.backend_config import PriorConfig
from slam_graph.backend.dynamics import bias_covariance
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.visual_motion import depths_within
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig

_SPEED_SIGMA = 20.0
"""Standard deviation of each component of the velocity of the middle of an object, m/s."""
_RATE_SIGMA = 0.3
"""The same of its angular rate, rad/s."""


def first_state(
    frame: FeatureFrame, ego: EgoMotion, rig: Rig, prior: PriorConfig, min_points: int
) -> NavState | None:
    """The platform in the frame of an object that begins now, where that frame is the world's.

    The object moves by v about its middle c and turns by ω. In its frame the velocity of the
    platform at p is less by v + ω × (p - c), and its angular rate by ω.

    Args:
        frame: features of the object.
        ego: the motion of the platform, which has the frame.
        rig: the cameras.
        prior: standard deviations that fix the pose, which nothing determines.
        min_points: fewest features with a depth.

    Returns:
        The state as `constant_velocity` has it; None with fewer features, or without a pose.
    """
    known = depths_within(frame, rig)
    points = known.points[known.located]
    if len(points) < min_points or frame.stamp_ns not in ego.stamps_ns:
        return None
    row = ego.stamps_ns.index(frame.stamp_ns)
    pose = ego.poses[row]
    return NavState(
        frame.stamp_ns + round(rig.pose_offset_s * 1e9),
        pose,
        ego.velocities[row],
        accel_bias=np.zeros(3),
        gyro_bias=np.zeros(3),
        covariance=_covariance(pose, np.median(points, axis=0), prior),
    )


def _covariance(pose: gtsam.Pose3, middle: FloatArray, prior: PriorConfig) -> FloatArray:
    """Covariance (15, 15) of the first state by the middle (3,) of the object in the body frame."""
    R = pose.rotation().matrix()
    arm = -skew(R @ middle)  # (p - c) × ω
    covariance = np.zeros((15, 15))
    covariance[:6, :6] = np.diag(np.repeat([prior.yaw_rad**2, prior.position_m**2], 3))
    covariance[9:, 9:] = bias_covariance(_RATE_SIGMA)
    covariance[6:9, 6:9] = _SPEED_SIGMA**2 * np.eye(3) + _RATE_SIGMA**2 * arm @ arm.T
    covariance[6:9, 12:] = _RATE_SIGMA**2 * arm @ R  # the bias is ω in body axes
    covariance[12:, 6:9] = covariance[6:9, 12:].T
    return covariance
