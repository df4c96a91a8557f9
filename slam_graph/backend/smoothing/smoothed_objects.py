# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States of an object by its adjustment: poses, motions and velocities, with covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.objects.object_state import ObjectMotion, ObjectState
from slam_graph.backend.objects.relative_motion import motion_between
from slam_graph.backend.smoothing.joint_objects import JointObject

_BLOCK = 50
"""States whose joint covariance is computed at once."""


def smoothed_states(
    states: Sequence[ObjectState], found: JointObject, offset_ns: int
) -> list[ObjectState]:
    """The states at the times of those on the way.

    Args:
        states: as they were estimated on the way, in the order of time.
        found: platform and object after the adjustment.
        offset_ns: from stamps of frames to the clock of its poses.

    Returns:
        Those that the adjustment has. Covariances of poses are relative to the first ones. Those of
        motions and velocities are NaN where platform and object are not joined.
    """
    known = _placed(states, found, offset_ns)
    result: list[ObjectState] = []
    for first in range(0, len(known), _BLOCK):
        begin, end = max(first - 1, 0), min(first + _BLOCK + 1, len(known))
        part = known[begin:end]
        stamps_ns = np.array([state.stamp_ns for state in part]) + offset_ns
        moving = _with_motions(part, found.covariance(stamps_ns))
        result += moving[first - begin : first - begin + _BLOCK]
    return result


def _placed(states: Sequence[ObjectState], found: JointObject, offset_ns: int) -> list[ObjectState]:
    """States with the poses that two smoothed poses of the platform give."""
    stamps_ns = np.array([state.stamp_ns for state in states]) + offset_ns
    both = [
        dict(zip(path.stamps_ns.tolist(), path, strict=True))
        for path in (found.platform.trajectory, found.relative.trajectory)
    ]
    placed = []
    for state, stamp_ns in zip(states, stamps_ns.tolist(), strict=True):
        if all(stamp_ns in poses for poses in both):
            X, Y = (poses[stamp_ns] for poses in both)
            placed.append(replace(state, world_T_object=X.compose(Y.inverse()), world_T_body=X))
    return placed


def _with_motions(states: Sequence[ObjectState], P: FloatArray) -> list[ObjectState]:
    """States with the motions and velocities that their poses have, and all covariances.

    Args:
        states: M neighbours, in the order of time.
        P: (6 M, 6 M) of their poses.
    """
    result, last = [], len(states) - 1
    for k, state in enumerate(states):
        covariance = P[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        state = replace(state, covariance=covariance, step=_motion(states, P, k))
        if last:
            pair = max(k - 1, 0), min(k + 1, last)
            velocity, covariance = _velocity([states[i] for i in pair], _joint(P, *pair))
            state = replace(state, velocity=velocity, velocity_covariance=covariance)
        result.append(state)
    return result


def _joint(P: FloatArray, i: int, j: int) -> FloatArray:
    """Covariance (12, 12) of two of the poses."""
    rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
    return np.asarray(P[np.ix_(rows, rows)])


def _motion(states: Sequence[ObjectState], P: FloatArray, k: int) -> ObjectMotion | None:
    """The motion since the frame before, where it is that of the state before."""
    now, step = states[k], states[k].step
    if k == 0 or step is None or states[k - 1].stamp_ns != step.before_ns:
        return None
    poses = states[k - 1].world_T_object, now.world_T_object
    motion, covariance = motion_between(*poses, _joint(P, k - 1, k))
    return ObjectMotion(step.before_ns, now.stamp_ns, motion, covariance)


def _velocity(pair: Sequence[ObjectState], P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean velocity (3,) of the origin between two states, in the world, and its covariance."""
    seconds = (pair[1].stamp_ns - pair[0].stamp_ns) * 1e-9
    before, after = (state.world_T_object for state in pair)
    J = np.zeros((3, 12))
    J[:, 3:6], J[:, 9:] = -before.rotation().matrix(), after.rotation().matrix()
    J /= seconds
    way = after.translation() - before.translation()
    return np.asarray(way / seconds), J @ P @ J.T
