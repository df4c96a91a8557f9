# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position and yaw of the world, which cameras and IMU do not observe: the gauge of a trajectory.

A trajectory, or a segment of one, is known relative to a state that was given its position and yaw
(Kelly & Sukhatme 2011). To join segments, one is moved by these four numbers, and what is not known
of them is added to the covariances of its states. Without an IMU nothing measures gravity, and they
are six: position and all of the rotation. A covariance of the gauge has the position first, in axes
of the world, then the rotation: about the vertical (4, 4), or about the axes of the world (6, 6).
One camera alone does not know its unit of length either: then they are seven, and the logarithm of
the scale comes last (7, 7).
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry import NavState

_ERROR = len(NavState.COMPONENTS)
_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)


def world_motion(moving: gtsam.Pose3, fixed: gtsam.Pose3, level: bool) -> gtsam.Pose3:
    """The motion of the world that moves one pose to the place of another.

    Args:
        moving: the pose that is moved.
        fixed: where it goes.
        level: whether gravity is measured, so that the motion is one in position and yaw.
    """
    if not level:
        return fixed.compose(moving.inverse())
    turn = fixed.rotation().compose(moving.rotation().inverse())
    yaw = gtsam.Rot3.Yaw(turn.yaw())
    return gtsam.Pose3(yaw, fixed.translation() - yaw.rotate(moving.translation()))


def in_moved_world(states: list[NavState], motion: gtsam.Pose3) -> list[NavState]:
    """States in a world that is moved by `new_T_old`, with their covariances."""
    turn = np.eye(_ERROR)  # errors of poses and biases are in axes of the body
    turn[_VELOCITY, _VELOCITY] = motion.rotation().matrix()
    return [
        replace(
            state,
            world_T_body=motion.compose(state.world_T_body),
            velocity=np.asarray(motion.rotation().rotate(state.velocity)),
            covariance=None if state.covariance is None else turn @ state.covariance @ turn.T,
        )
        for state in states
    ]


def turned_axes(level: bool) -> FloatArray:
    """Axes (1, 3) or (3, 3) of the world about which nothing measures its rotation."""
    return np.eye(3)[2:] if level else np.eye(3)


def gauge_motion(arms: FloatArray, level: bool = True) -> FloatArray:
    """How (N, 6, 4 or 6) poses move with the gauge, with axes of the world.

    Args:
        arms: (N, 3) positions relative to the point about which the world turns.
        level: whether it turns about the vertical only.
    """
    axes = turned_axes(level)
    motion = np.zeros((len(arms), 6, 3 + len(axes)))
    motion[:, :3, 3:] = axes.T
    motion[:, 3:, :3] = np.eye(3)
    motion[:, 3:, 3:] = np.cross(axes, arms[:, None]).transpose(0, 2, 1)
    return motion


def gauge_covariance(state: NavState, level: bool = True) -> FloatArray:
    """Covariance of the gauge, (4, 4) if it is level or (6, 6), that a state gives its world."""
    assert state.covariance is not None
    R = state.world_T_body.rotation().matrix()
    axes = turned_axes(level)
    given = np.zeros((3 + len(axes), _ERROR))
    given[:3, _POSITION] = R
    given[3:, _ROTATION] = axes @ R
    return np.asarray(given @ state.covariance @ given.T)


def in_gauge_of(link: NavState, states: list[NavState], level: bool = True) -> list[NavState]:
    """States of a segment with covariances relative to what those of an earlier one are.

    What is not known of position and yaw at the state where the segments join is added to all
    others, as if the two segments had independent errors.

    Args:
        link: the state of the earlier segment whose position and yaw the later one was given.
        states: of the later segment, with covariances relative to these.
        level: whether gravity is measured.
    """
    if link.covariance is None:
        return states
    unknown, place = gauge_covariance(link, level), link.world_T_body.translation()
    return [with_unknown_gauge(state, unknown, place) for state in states]


def with_unknown_gauge(
    state: NavState, unknown: FloatArray, centre: FloatArray, camera: gtsam.Pose3 | None = None
) -> NavState:
    """A state with the uncertainty of the gauge of its world added.

    Args:
        state: with its covariance in that world; without one it stays as it is.
        unknown: (4, 4), (6, 6) or (7, 7) covariance of the gauge (m, rad, logarithm of the scale).
        centre: (3,) the point about which the world turns and is scaled.
        camera: body_T_camera of the camera whose path is scaled; what turns of the body add to its
            velocity is neglected.
    """
    if state.covariance is None:
        return state
    level = len(unknown) == 4
    body_R_world = state.world_T_body.rotation().matrix().T
    N = np.zeros((_ERROR, len(unknown)))
    moved = gauge_motion((state.world_T_body.translation() - centre)[None], level)[0]
    given = slice(0, moved.shape[1])
    N[_ROTATION, given], N[_POSITION, given] = body_R_world @ moved[:3], body_R_world @ moved[3:]
    axes = turned_axes(level)
    N[_VELOCITY, 3 : 3 + len(axes)] = np.cross(axes, state.velocity).T
    if camera is not None:
        seen_from = state.world_T_body.transformFrom(camera.translation())
        N[_POSITION, -1], N[_VELOCITY, -1] = body_R_world @ (seen_from - centre), state.velocity
    return replace(state, covariance=state.covariance + N @ unknown @ N.T)
