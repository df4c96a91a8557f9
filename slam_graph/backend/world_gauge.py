# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position and yaw of the world, which cameras and IMU do not observe: the gauge of a trajectory.

A trajectory, or a segment of one, is known relative to a state that was given its position and yaw
(Kelly & Sukhatme 2011). To join segments, one is moved by these four numbers, and what is not known
of them is added to the covariances of its states.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry import NavState

_ERROR = len(NavState.COMPONENTS)
_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)


def level_motion(moving: gtsam.Pose3, fixed: gtsam.Pose3) -> gtsam.Pose3:
    """The motion of the world in position and yaw that moves one pose to the place of another."""
    turn = fixed.rotation().compose(moving.rotation().inverse())
    yaw = gtsam.Rot3.Yaw(turn.yaw())
    return gtsam.Pose3(yaw, fixed.translation() - yaw.rotate(moving.translation()))


def in_moved_world(states: list[NavState], motion: gtsam.Pose3) -> list[NavState]:
    """States in a world that is moved by `new_T_old`, in position and yaw."""
    return [
        replace(
            state,
            world_T_body=motion.compose(state.world_T_body),
            velocity=np.asarray(motion.rotation().rotate(state.velocity)),
        )
        for state in states
    ]


def gauge_motion(arms: FloatArray) -> FloatArray:
    """How (N, 6, 4) poses move with position and yaw of the world, with axes of the world.

    Args:
        arms: (N, 3) positions relative to the point about which the yaw turns.
    """
    motion = np.zeros((len(arms), 6, 4))
    motion[:, 2, 3] = 1.0
    motion[:, 3:, :3] = np.eye(3)
    motion[:, 3:, 3] = np.cross([0.0, 0.0, 1.0], arms)
    return motion


def gauge_covariance(state: NavState) -> FloatArray:
    """Covariance (4, 4) of position, in axes of the world, and yaw of a state."""
    assert state.covariance is not None
    R = state.world_T_body.rotation().matrix()
    given = np.zeros((4, _ERROR))
    given[:3, _POSITION] = R
    given[3, _ROTATION] = R[2]
    return np.asarray(given @ state.covariance @ given.T)


def in_gauge_of(link: NavState, states: list[NavState]) -> list[NavState]:
    """States of a segment with covariances relative to what those of an earlier one are.

    What is not known of position and yaw at the state where the segments join is added to all
    others, as if the two segments had independent errors.

    Args:
        link: the state of the earlier segment whose position and yaw the later one was given.
        states: of the later segment, with covariances relative to these.
    """
    if link.covariance is None:
        return states
    unknown, place = gauge_covariance(link), link.world_T_body.translation()
    return [with_unknown_gauge(state, unknown, place) for state in states]


def with_unknown_gauge(state: NavState, unknown: FloatArray, centre: FloatArray) -> NavState:
    """A state with the uncertainty (4, 4) of position and yaw of its world added.

    Args:
        state: with its covariance in that world; without one it stays as it is.
        unknown: covariance of position (m), in axes of the world, and yaw (rad).
        centre: (3,) the point about which the yaw turns.
    """
    if state.covariance is None:
        return state
    body_R_world = state.world_T_body.rotation().matrix().T
    N = np.zeros((_ERROR, 4))
    moved = gauge_motion((state.world_T_body.translation() - centre)[None])[0]
    N[_ROTATION], N[_POSITION] = body_R_world @ moved[:3], body_R_world @ moved[3:]
    N[_VELOCITY, 3] = np.cross([0.0, 0.0, 1.0], state.velocity)
    return replace(state, covariance=state.covariance + N @ unknown @ N.T)
