# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Velocities that the rows of rolling shutters depend on (Li, Kim and Mourikis 2013).

The row that is exposed s after the pose X(i) is seen from X(i) ⊕ m_i(s), and m_i moves by s Rᵀ v,
with the velocity v in the world and R = world_R_body. So an observation has derivatives by V(i), as
long as that is a variable, and others by the rotation than with a global shutter. Both are at first
estimates: together they are zero along a turn of the world about the vertical. m_i itself is in the
body frame, where that turn changes nothing, so that residuals may have it by the newest estimates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.solve.state import State


@dataclass(frozen=True, slots=True, eq=False)
class RowVelocities:
    """Velocities (3,) of frames in the world, at their linearisation points; none by default."""

    first: Mapping[int, FloatArray] = field(default_factory=dict)

    @staticmethod
    def of(state: State, frames: Iterable[int]) -> RowVelocities:
        """Those of some frames, as far as they are variables of a state."""
        found = (i for i in frames if state.frames.exists(V(i)))
        return RowVelocities({i: state.first_frames.atVector(V(i)) for i in found})

    @property
    def keys(self) -> tuple[int, ...]:
        """Of the variables, in the order of the columns."""
        return tuple(V(i) for i in self.first)

    def derivatives(
        self, obs: Observations, rotations: FloatArray, seconds: FloatArray, by_pose: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the projection by poses and by velocities.

        Args:
            obs: N observations.
            rotations: (F, 3, 3) world_R_body of their frames.
            seconds: (N,) from the poses to the exposures of the observed rows.
            by_pose: (N, 2, 6) derivatives by the poses under the motions m_i as they are.

        Returns:
            by_pose: (N, 2, 6) under velocities in the world as they are.
            by_velocity: (N, 2, 3 V).
        """
        by_move, by_pose = by_pose[:, :, 3:] * seconds[:, None, None], by_pose.copy()
        by_velocity = np.zeros((len(obs), 2, 3 * len(self.first)))
        for column, (i, velocity) in enumerate(self.first.items()):
            if i not in obs.frames:
                continue
            frame = obs.frames.index(i)
            rows, body_R_world = obs.frame == frame, rotations[frame].T
            by_velocity[rows, :, 3 * column : 3 * column + 3] = by_move[rows] @ body_R_world
            by_pose[rows, :, :3] += by_move[rows] @ skew(body_R_world @ velocity)
        return by_pose, by_velocity


def follow_estimates(state: State, before: gtsam.Values, gravity: FloatArray) -> None:
    """Renew the motions of all frames after their estimates have moved.

    Where the velocity of a frame is no longer a variable, it follows from the poses: with the same
    IMU samples, it changes by as much as the distance to the next frame does, over the time to it.

    Args:
        state: its motions are renewed.
        before: the estimates that the motions are those of.
        gravity: (3,) in the world, m/s².
    """
    frames, now = sorted(state.motions), state.frames
    for i, following in zip(frames, [*frames[1:], None], strict=True):
        motion, was, pose = state.motions[i], before.atPose3(X(i)), now.atPose3(X(i))
        rate, change = motion.rate.copy(), motion.change.copy()
        tilted = pose.rotation().unrotate(gravity) - was.rotation().unrotate(gravity)
        change[3:] += tilted
        if now.exists(V(i)):
            old, new = before.atConstantBias(B(i)), now.atConstantBias(B(i))
            rate[:3] += old.gyroscope() - new.gyroscope()
            rate[3:] = pose.rotation().unrotate(now.atVector(V(i)))
            change[3:] += old.accelerometer() - new.accelerometer()
        elif following is not None:
            seconds = 1e-9 * (state.motions[following].stamp_ns - motion.stamp_ns)
            moved = pose.transformTo(now.atPose3(X(following)).translation())
            moved -= was.transformTo(before.atPose3(X(following)).translation())
            rate[3:] += moved / seconds - 0.5 * seconds * tilted
        state.motions[i] = replace(motion, rate=rate, change=change)
