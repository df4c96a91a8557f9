# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The path that was estimated, at the times of absolute measurements."""

from __future__ import annotations

from bisect import bisect_left

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.fix_factors import Fix, PositionFix, pose_between
from slam_graph.backend.aiding.path_of_fixes import PathFix
from slam_graph.geometry import NavState


class EstimatedPath:
    """States in the order of time, with what is between them.

    Attributes:
        states: the states.
    """

    def __init__(self) -> None:
        self.states: list[NavState] = []

    def append(self, state: NavState) -> bool:
        """Take a state; False if it is not later than those before."""
        if self.states and state.stamp_ns <= self.states[-1].stamp_ns:
            return False
        self.states.append(state)
        return True

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the states before a time."""
        del self.states[: bisect_left(self.states, stamp_ns, key=_stamp_ns)]

    def around(self, stamp_ns: int) -> tuple[NavState, NavState] | None:
        """The states before and after a time; None where there are not both."""
        later = bisect_left(self.states, stamp_ns, key=_stamp_ns)
        if not 0 < later < len(self.states):
            return None
        return self.states[later - 1], self.states[later]

    def pose(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """Of the body at a time; None where the path has none."""
        around = self.around(stamp_ns)
        return None if around is None else _between(around, stamp_ns)

    def velocity(self, fix: PositionFix) -> FloatArray:
        """Of the sensor (3,) of a fix at its time, m/s; zero where the path has none."""
        around = self.around(fix.stamp_ns)
        return np.zeros(3) if around is None else _velocity(fix, around)

    def at(self, fix: Fix, offset_ns: int) -> PathFix | None:
        """A fix with the path at its time; None where it has none.

        Args:
            fix: an absolute measurement.
            offset_ns: added to its time if that of its source is estimated.
        """
        stamp_ns = fix.stamp_ns + (offset_ns if fix.is_timed else 0)
        around = self.around(stamp_ns)
        if around is None:
            return None
        velocity = np.zeros(3)
        if isinstance(fix, PositionFix) and fix.is_timed:
            velocity = _velocity(fix, around)
        variances = variances_of(around[0])
        return PathFix(fix, _between(around, stamp_ns), *variances, velocity)


def variances_of(state: NavState) -> tuple[float, float]:
    """Of the position (m²) and the orientation (rad²) of a state, the sums of their axes."""
    if state.covariance is None:
        return 0.0, 0.0
    variances = np.diag(state.covariance)
    return float(variances[3:6].sum()), float(variances[:3].sum())


def _velocity(fix: PositionFix, around: tuple[NavState, NavState]) -> FloatArray:
    before, after = around
    seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
    return fix.velocity(before.world_T_body, after.world_T_body, seconds)


def _between(around: tuple[NavState, NavState], stamp_ns: int) -> gtsam.Pose3:
    before, after = around
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return pose_between(before.world_T_body, after.world_T_body, share)


def _stamp_ns(state: NavState) -> int:
    return state.stamp_ns
