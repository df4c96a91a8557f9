# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of rolling shutters follow the velocities of the estimates, with right derivatives."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from flight import room
from gtsam.symbol_shorthand import B, V, X
from test_rolling_shutter import FAST, TIMES, rolling, seen_by, stepped

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.row_velocities import follow_estimates
from slam_graph.backend.marginalization.marginalize import unobservable_directions
from slam_graph.backend.online_calibration import GRAVITY
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import State, dims_of


def test_velocities_that_are_no_variables_follow_the_poses() -> None:
    """Poses move as another velocity would have moved them; the motions do so too."""
    velocity, stamps_s = np.array([0.4, -0.3, 0.2]), np.array([0.0, 0.05, 0.4])
    _, _, seen = seen_by(rolling(), room(60, np.random.default_rng(4)))
    state = State()
    for k, t_s in enumerate(stamps_s.tolist()):
        state.insert_imu_state(k, FAST.nav_state(t_s))
        state.motions[k] = replace(seen.motions[k], stamp_ns=round(t_s * 1e9))
    state.remove([V(0), V(1), B(0), B(1)])
    before, motions, moved = state.frames, dict(state.motions), gtsam.Values(state.frames)
    for k, t_s in enumerate(stamps_s.tolist()):
        pose = state.frames.atPose3(X(k))
        shifted = gtsam.Pose3(pose.rotation(), pose.translation() + velocity * t_s)
        moved.update(X(k), shifted)
    moved.update(V(2), state.frames.atVector(V(2)) + velocity)
    state.frames = moved
    follow_estimates(state, before, GRAVITY)
    for k in range(3):
        expected = moved.atPose3(X(k)).rotation().unrotate(velocity)
        if k == 2:
            expected += before.atPose3(X(k)).rotation().unrotate(before.atVector(V(2)))
            expected -= motions[k].rate[3:]
        change = state.motions[k].rate - motions[k].rate
        np.testing.assert_allclose(change, [0.0, 0.0, 0.0, *expected], atol=1e-12)


def test_derivatives_by_velocities_are_the_numerical_ones() -> None:
    mounted, step = rolling(), 1e-6
    obs, at, state = seen_by(mounted, room(60, np.random.default_rng(1)))
    projection = RigProjection(mounted).at(state).with_velocities(state, range(2, 5))
    by_pose, _, by_velocity = projection.all_jacobians(obs, at)
    layout = Layout(dims_of([*(X(k) for k in range(len(TIMES))), *projection.velocities.keys]))

    def moved(column: int, sign: float) -> FloatArray:
        other = state.copy()
        other.update(layout, sign * step * np.eye(layout.size)[column])
        projection.follow(other, state.frames)
        for i, motion in other.motions.items():  # that of the gravity in it is neglected
            other.motions[i] = replace(motion, change=state.motions[i].change)
        poses = projection.poses(other.estimate, obs.frames)
        there = projection.at(other)
        return obs.pixels - there.residuals(obs, Geometry(*poses, at.points))[0]

    for frame in range(2, 5):
        rows = obs.frame == frame
        for axis in range(6):
            column = layout.starts[X(frame)] + axis
            numerical = (moved(column, 1.0) - moved(column, -1.0)) / (2 * step)
            ours = by_pose[rows, :, axis]
            np.testing.assert_allclose(ours, numerical[rows], rtol=2e-6, atol=2e-3)
    for column in range(9):
        start = layout.starts[V(2)] + column
        numerical = (moved(start, 1.0) - moved(start, -1.0)) / (2 * step)
        np.testing.assert_allclose(by_velocity[:, :, column], numerical, atol=2e-3)


def test_a_turn_of_the_world_is_not_seen() -> None:
    """At first estimates, whatever the newest motions are."""
    mounted = rolling()
    obs, at, state = seen_by(mounted, room(60, np.random.default_rng(1)))
    plain = RigProjection(mounted).at(state)
    state.motions = {i: replace(m, rate=m.rate + 0.1) for i, m in state.motions.items()}
    projection = plain.with_velocities(state, range(len(TIMES))).at(state)
    by_pose, by_point, by_velocity = projection.all_jacobians(obs, at)
    keys = [*(X(k) for k in range(len(TIMES))), *projection.velocities.keys]
    layout = Layout(dims_of(keys))
    directions = unobservable_directions(state.first, layout)
    poses = directions[: 6 * len(TIMES)].reshape(-1, 6, 4)[obs.frame]
    points = np.zeros((len(obs), 3, 4))
    points[:, :, :3] = np.eye(3)
    points[:, :, 3] = np.cross([0.0, 0.0, 1.0], at.points[obs.feature])
    seen = by_pose @ poses + by_point @ points + by_velocity @ directions[6 * len(TIMES) :]
    np.testing.assert_allclose(seen, 0.0, atol=1e-8 * np.abs(by_point).max())


@pytest.mark.parametrize("name", ["msckf", "okvis"])
def test_rows_move_with_the_newest_estimates(name: str) -> None:
    window = stepped(name).window
    assert window is not None
    state = window.state
    moving = [*window.moving, window.frame]
    assert (len(moving) > 1) == (name == "okvis")
    assert set(state.motions) == {*window.past, window.frame}
    for i in moving:
        body_R_world = state.frames.atPose3(X(i)).rotation().inverse()
        velocity = body_R_world.rotate(state.frames.atVector(V(i)))
        np.testing.assert_allclose(state.motions[i].rate[3:], velocity, atol=1e-12)
