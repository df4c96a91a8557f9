# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The first state of the platform in the frame of an object."""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import skew
from slam_graph.backend.backend_config import PriorConfig
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.object_start import first_state
from slam_graph.backend.visual_motion import depths_within
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig
from slam_graph.simulation import simulate


def first_frame() -> tuple[FeatureFrame, EgoMotion, Rig]:
    """The first features of a flight, and a platform that flies past them."""
    sequence = simulate(duration_s=1.0, rate_hz=10.0, seed=1, tracks={"pixel_sigma": 0.5})
    frame = next(iter(sequence.frames()))
    assert isinstance(frame, FeatureFrame)
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.0), np.array([5.0, -2.0, 1.0]))
    velocity = np.array([1.0, 0.5, 0.0])
    none = np.zeros(3)
    state = NavState(frame.stamp_ns, pose, velocity, accel_bias=none, gyro_bias=none)
    flat = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((6, 6))
    return frame, EgoMotion((frame.stamp_ns,), (pose,), velocity[None], state, *flat), sequence.rig


def test_the_velocity_of_the_middle_is_unknown_and_the_rest_turns_about_it() -> None:
    frame, ego, rig = first_frame()
    state = first_state(frame, ego, rig, PriorConfig(), 6)
    assert state is not None
    assert state.covariance is not None
    assert state.stamp_ns == frame.stamp_ns + round(rig.pose_offset_s * 1e9)
    np.testing.assert_array_equal(state.velocity, ego.velocities[0])  # an object at rest
    points = depths_within(frame, rig)
    R = ego.poses[0].rotation().matrix()
    middle = R @ np.median(points.points[points.located], axis=0)
    # v of the middle by the velocity of the platform in the frame of the object, and the bias
    J = np.hstack([-np.eye(3), np.zeros((3, 3)), -skew(middle) @ R])
    P = J @ state.covariance[6:, 6:] @ J.T
    np.testing.assert_allclose(P, 20.0**2 * np.eye(3), atol=1e-6)
    np.testing.assert_allclose(state.covariance[12:, 12:], 0.3**2 * np.eye(3))
    assert np.all(np.linalg.eigvalsh(state.covariance) > 0.0)


def test_nothing_begins_with_too_few_depths() -> None:
    frame, ego, rig = first_frame()
    few = frame.only(np.sort(frame.ids)[:5])
    assert first_state(few, ego, rig, PriorConfig(), 6) is None
