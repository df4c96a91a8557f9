# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes and odometry on their way into the cost of each step.

The estimator begins in a world of its own. It waits until the fixes along its path tell where that
world is (`world_alignment.py`), and moves everything there once. From then on each fix is a factor
at the frame that follows it. Odometry is a factor between consecutive frames from the beginning.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.fix_factors import (
    FixGate,
    antenna,
    between_poses,
    fix_factor,
    pose_key,
)
from slam_graph.backend.aiding.odometry_factors import odometry_factor
from slam_graph.backend.aiding.world_alignment import WorldAlignment, align_world
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.solve.state import State
from slam_graph.backend.visual_motion import moved_to
from slam_graph.backend.world_gauge import in_moved_world, with_unknown_gauge
from slam_graph.geometry import NavState
from slam_graph.sensors import AidingData

_MOST_PAIRS = 300
"""Fixes that are remembered for the alignment."""
_HISTORY_NS = 5_000_000_000
"""How long what was measured is kept."""


class Aiding:
    """Takes fixes and odometry, and makes factors of them.

    Args:
        config: settings.
        level: whether gravity is measured.

    Attributes:
        aligned: whether the world is that of the fixes.
        used: whether there was anything to take so far.
    """

    def __init__(self, config: BackendConfig, level: bool) -> None:
        self._config, self._level = config, level
        self._arm = np.array(config.gnss.lever_arm_m)
        self._offset_ns = round(config.gnss.time_offset_s * 1e9)
        self._data = AidingData.empty()
        self.gate, self.used = FixGate(), False
        self.restart()

    def restart(self) -> None:
        """The estimate begins anew, in another world."""
        self.aligned = False
        self._states: list[NavState] = []
        self._waiting = AidingData.empty()
        self._pairs: list[tuple[FloatArray, FloatArray, FloatArray, float]] = []

    def add(self, data: AidingData) -> None:
        """Take measurements that follow those before; none say that there will be some."""
        self.used = True
        if not self._config.gnss.enabled:
            data = data.without_fixes()
        self._data = AidingData.concatenate([self._data, data.shifted(self._offset_ns)])
        if len(data.fix_stamps_ns) and not self.aligned:
            self._waiting = AidingData.concatenate([self._waiting, data.shifted(self._offset_ns)])

    # --- factors ---------------------------------------------------------------------------------

    def factors(
        self,
        state: State,
        frames: tuple[int, int],
        stamps_ns: tuple[int, int],
        known: FloatArray | None,
    ) -> list[gtsam.NonlinearFactor]:
        """Factors of what was measured from one frame to the next.

        Args:
            state: with the poses of both.
            frames: indices of the last and the new one.
            stamps_ns: their times.
            known: (6, 6) covariance of the new pose as it is predicted; None if it is not known.
        """
        self._data = self._data.within(stamps_ns[0] - _HISTORY_NS, None)
        first, last = (state.frames.atPose3(pose_key(i)) for i in frames)
        factors: list[gtsam.NonlinearFactor] = []
        if self._config.odometry.enabled:
            moved = self._data.odometry_between(*stamps_ns)
            if moved is not None:
                factors.append(odometry_factor(frames, moved, self._config.odometry))
        if not self.aligned:
            return factors
        fixes = self._data.within(*stamps_ns)
        for k, stamp_ns in enumerate(fixes.fix_stamps_ns.tolist()):
            share = (stamp_ns - stamps_ns[0]) / (stamps_ns[1] - stamps_ns[0])
            ahead = antenna(last, self._arm) - between_poses((first, last), share, self._arm)
            position, covariance = fixes.fix_positions[k] + ahead, fixes.fix_covariances[k]
            weight = 1.0
            if known is not None:
                weight = self.gate.weight(last, known, position, covariance, self._arm)
            if weight > 0.0:
                key = pose_key(frames[1])
                factors.append(fix_factor(key, position, covariance / weight, self._arm))
        return factors

    def by_odometry(self, before: NavState, predicted: NavState) -> NavState | None:
        """A predicted state where the odometry has it; None without odometry of this time.

        Args:
            before: the last state.
            predicted: the new one, by constant velocity.
        """
        if not self.used or not self._config.odometry.enabled:
            return None
        moved = self._data.odometry_between(before.stamp_ns, predicted.stamp_ns)
        if moved is None:
            return None
        motion = gtsam.Pose3(gtsam.Rot3.Expmap(moved[0]), moved[1])
        return moved_to(before, predicted, before.world_T_body.compose(motion))

    # --- the world -------------------------------------------------------------------------------

    def alignment(self, state: NavState | None) -> WorldAlignment | None:
        """Note the state of a frame; where its world is, as soon as the fixes tell it.

        Args:
            state: of the newest frame; None without one.
        """
        if state is None or not self.used or self.aligned:
            return None
        if self._states and state.stamp_ns <= self._states[-1].stamp_ns:
            return None
        self._states.append(state)
        if not self._pair(state):
            return None
        columns = zip(*self._pairs, strict=True)
        places, fixes, covariances, known = (np.array(column) for column in columns)
        # older fixes tell less of the world: the path has drifted since
        drift = np.maximum(_variance(state) - known, 0.0)
        covariances = covariances + drift[:, None, None] * np.eye(3)
        now = np.asarray(state.world_T_body.translation())
        return align_world(places, fixes, covariances, now, self._level)

    def _pair(self, state: NavState) -> bool:
        """Note the fixes up to a state with the antenna's place then; whether there are any."""
        if len(self._states) < 2:
            self._waiting = self._waiting.within(state.stamp_ns, None)
            return False
        before, count = self._states[-2], len(self._pairs)
        due = self._waiting.within(before.stamp_ns, state.stamp_ns)
        self._waiting = self._waiting.within(state.stamp_ns, None)
        poses = before.world_T_body, state.world_T_body
        for k, stamp_ns in enumerate(due.fix_stamps_ns.tolist()):
            share = (stamp_ns - before.stamp_ns) / (state.stamp_ns - before.stamp_ns)
            place = between_poses(poses, share, self._arm)
            fix, covariance = due.fix_positions[k], due.fix_covariances[k]
            self._pairs.append((place, fix, covariance, _variance(before)))
        grew, self._pairs = len(self._pairs) > count, self._pairs[-_MOST_PAIRS:]
        return grew

    def settle(self, found: WorldAlignment) -> list[NavState]:
        """Go on in the world of the fixes; all states so far in that world, the newest last."""
        states = in_moved_world(self._states, found.motion)
        states = [with_unknown_gauge(state, found.covariance, found.centre) for state in states]
        self.aligned, self._states, self._pairs = True, [], []
        self._waiting = AidingData.empty()
        return states


def _variance(state: NavState) -> float:
    """Of the position of a state, the sum of its axes, m²."""
    return 0.0 if state.covariance is None else float(np.trace(state.covariance[3:6, 3:6]))
