# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Segments of a recording, joined in the world of position fixes as a smoother joins time steps.

Forward, a segment begins with what the one before knows of the pose at the keyframe where they
join, and with the fixes that that one has not used. Backward, what it has learned of this pose
goes on to the states of the one before (Rauch, Tung & Striebel 1965, with segments as steps):

    x_i ← x_i + G_i (x' - x),   P_i ← P_i + G_i (P' - P) G_iᵀ,   G_i = cov(x_i, x) P⁻¹,

where x and P are pose and covariance at the joint in the earlier segment, and x' and P' in the
later one. So the trajectory has no step there, and a fix counts in all segments. Of the joint the
pose alone is carried over, as images tell velocity and biases of both segments, and a lever arm or
clock that is a variable is estimated in each. Images and IMU samples of the overlap count in both.
A segment without fixes before the first one with some is not joined so: it stays in the world of
the causal estimate.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.smoothing.keyframe_aiding import KnownPose
from slam_graph.geometry import NavState, StateHistory

OVERLAP = 50
"""Keyframes that consecutive segments share (10 s at the default spacing); half of a short one."""
_POSE = slice(0, 6)


def segments(keyframes: int, longest: int) -> Iterator[tuple[int, int]]:
    """First keyframe of each segment, and the one after its last.

    Args:
        keyframes: number of all keyframes.
        longest: most keyframes of a segment.
    """
    step = longest - overlap_of(longest)
    first = 0
    while True:
        stop = min(first + longest, keyframes)
        yield first, stop
        if stop == keyframes:
            return
        first += step


def overlap_of(longest: int) -> int:
    """Keyframes that consecutive segments share."""
    return min(OVERLAP, longest // 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """N states of a segment; how errors (N, 15, 6) follow from that of the pose at its joint."""

    states: list[NavState]
    gains: FloatArray | None


class SegmentChain:
    """States of consecutive segments on their way to a history.

    Args:
        history: where they go, as soon as no later segment changes them.
    """

    def __init__(self, history: StateHistory) -> None:
        self._history = history
        self._waiting: list[_Part] = []

    def at(self, stamp_ns: int) -> NavState | None:
        """The state of the last segment at a time; None before there is one."""
        if not self._waiting:
            return None
        states = self._waiting[-1].states
        return states[bisect_left(states, stamp_ns, key=_stamp_ns)]

    def known(self, stamp_ns: int) -> KnownPose | None:
        """What the last segment knows of the pose at a joint, if it is in the world of fixes."""
        state = self.at(stamp_ns)
        if state is None or state.covariance is None or self._waiting[-1].gains is None:
            return None
        until_ns = self._waiting[-1].states[-1].stamp_ns
        return KnownPose(stamp_ns, state.world_T_body, state.covariance[_POSE, _POSE], until_ns)

    def add(self, states: list[NavState], gains: FloatArray | None, linked: bool) -> None:
        """Go on with a segment; the one before ends where it begins.

        Args:
            states: of N frames, the first at the joint.
            gains: (N, 15, 6) G of these for the next joint; None if nothing is to go back to them.
            linked: whether the segment has begun with what the one before knows.
        """
        if self._waiting:
            before = self._waiting.pop()
            joint = bisect_left(before.states, states[0].stamp_ns, key=_stamp_ns)
            if linked and before.gains is not None:
                kept = slice(joint + 1)
                self._waiting.append(_Part(before.states[kept], before.gains[kept].copy()))
            else:
                self._waiting.append(_Part(before.states[: joint + 1], None))
                self._write(ended=False)
        self._waiting.append(_Part(states, gains))

    def end(self) -> None:
        """Write the states that have waited for another segment."""
        self._write(ended=True)

    def _write(self, ended: bool) -> None:
        """Go back through what waits, and write it.

        Args:
            ended: whether the last state belongs to it, and not to a segment behind.
        """
        found: list[list[NavState]] = []
        later: NavState | None = None
        for part in reversed(self._waiting):
            states = part.states
            if later is not None and part.gains is not None:
                states = _with_later(states, part.gains, later)
            later = states[0]
            found.append(states if ended and not found else states[:-1])
        for states in reversed(found):
            for state in states:
                self._history.append(state)
        self._waiting = []


def _with_later(states: list[NavState], gains: FloatArray, joint: NavState) -> list[NavState]:
    """States of a segment with what the next one has learned of the pose where they end.

    Args:
        states: N of them, the last at the joint.
        gains: (N, 15, 6) G of these.
        joint: the state there in the next segment.
    """
    before, after = states[-1].world_T_body, joint.world_T_body
    move = np.concatenate(
        [
            gtsam.Rot3.Logmap(before.rotation().between(after.rotation())),
            before.rotation().unrotate(after.translation() - before.translation()),
        ]
    )
    steps = gains @ move
    change = np.zeros((6, 6))  # of a segment without covariances the pose alone is known
    if joint.covariance is not None and states[-1].covariance is not None:
        change = (joint.covariance - states[-1].covariance)[_POSE, _POSE]
    changes = gains @ change @ gains.transpose(0, 2, 1)
    return [
        _moved(state, step, more) for state, step, more in zip(states, steps, changes, strict=True)
    ]


def _moved(state: NavState, step: FloatArray, more: FloatArray) -> NavState:
    """A state by a step (15,) of its error, with another covariance (15, 15) added to its own."""
    assert state.covariance is not None
    turn, shift, velocity, accel_bias, gyro_bias = step.reshape(5, 3)
    pose = state.world_T_body
    return replace(
        state,
        world_T_body=gtsam.Pose3(
            pose.rotation().compose(gtsam.Rot3.Expmap(turn)), pose.transformFrom(shift)
        ),
        velocity=state.velocity + velocity,
        accel_bias=state.accel_bias + accel_bias,
        gyro_bias=state.gyro_bias + gyro_bias,
        covariance=state.covariance + more,
    )


def _stamp_ns(state: NavState) -> int:
    return state.stamp_ns
