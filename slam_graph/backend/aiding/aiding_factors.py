# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes, known poses and odometry on their way into the cost of each step.

The estimator begins in a world of its own. It waits until the absolute measurements along its path
tell where that world is (`world_alignment.py`), and moves everything there once. From then on each
of them is a factor at the frame that follows it. Odometry is a factor between consecutive frames
from the beginning.
"""

from __future__ import annotations

from collections import defaultdict

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.fix_factors import (
    FixGate,
    fixes_of,
    on_the_clock,
    pose_between,
    pose_key,
)
from slam_graph.backend.aiding.odometry_factors import odometry_factor
from slam_graph.backend.aiding.world_alignment import PathFix, WorldAlignment, align_world
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
    """Takes fixes, known poses and odometry, and makes factors of them.

    Args:
        config: settings.
        level: whether gravity is measured.

    Attributes:
        aligned: whether the world is that of the fixes.
        used: whether there was anything to take so far.
        gates: of the sources of fixes, by name.
    """

    def __init__(self, config: BackendConfig, level: bool) -> None:
        self._config, self._level = config, level
        self._data = AidingData.empty()
        self.gates: defaultdict[str, FixGate] = defaultdict(FixGate)
        self.used = False
        self.restart()

    def restart(self) -> None:
        """The estimate begins anew, in another world."""
        self.aligned = False
        self._states: list[NavState] = []
        self._waiting = AidingData.empty()
        self._pairs: list[PathFix] = []

    def add(self, data: AidingData) -> None:
        """Take measurements that follow those before; none say that there will be some."""
        self.used = True
        data = on_the_clock(data, self._config)
        self._data = AidingData.concatenate([self._data, data])
        if not self.aligned:
            self._waiting = AidingData.concatenate([self._waiting, data])

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
        first, last = (state.estimate.atPose3(pose_key(i)) for i in frames)
        factors: list[gtsam.NonlinearFactor] = []
        if self._config.odometry.enabled:
            moved = self._data.odometry_between(*stamps_ns)
            if moved is not None:
                factors.append(odometry_factor(frames, moved, self._config.odometry))
        if not self.aligned:
            return factors
        for fix in fixes_of(self._data.within(*stamps_ns), self._config):
            share = (fix.stamp_ns - stamps_ns[0]) / (stamps_ns[1] - stamps_ns[0])
            here = fix.moved(pose_between(first, last, share), last)
            weight = 1.0 if known is None else self.gates[fix.source].weight(here, last, known)
            if weight > 0.0:
                factors.append(here.factor(pose_key(frames[1]), weight))
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
        position, rotation = _variances(state)
        now = np.asarray(state.world_T_body.translation())
        # older fixes tell less of the world: the path has drifted since
        drifted = [pair.after_drift(position, rotation) for pair in self._pairs]
        return align_world(drifted, now, self._level)

    def _pair(self, state: NavState) -> bool:
        """Note the fixes up to a state with the pose of the body then; whether there are any."""
        due = self._waiting.within(None, state.stamp_ns)
        self._waiting = self._waiting.within(state.stamp_ns, None)
        if len(self._states) < 2:
            return False
        before, count = self._states[-2], len(self._pairs)
        due = due.within(before.stamp_ns, None)
        for fix in fixes_of(due, self._config):
            share = (fix.stamp_ns - before.stamp_ns) / (state.stamp_ns - before.stamp_ns)
            pose = pose_between(before.world_T_body, state.world_T_body, share)
            self._pairs.append(PathFix(fix, pose, *_variances(before)))
        grew, self._pairs = len(self._pairs) > count, self._pairs[-_MOST_PAIRS:]
        return grew

    def settle(self, found: WorldAlignment) -> list[NavState]:
        """Go on in the world of the fixes; all states so far in that world, the newest last."""
        states = in_moved_world(self._states, found.motion)
        states = [with_unknown_gauge(state, found.covariance, found.centre) for state in states]
        self.aligned, self._states, self._pairs = True, [], []
        self._waiting = AidingData.empty()
        return states


def _variances(state: NavState) -> tuple[float, float]:
    """Of the position (m²) and the orientation (rad²) of a state, the sums of their axes."""
    if state.covariance is None:
        return 0.0, 0.0
    variances = np.diag(state.covariance)
    return float(variances[3:6].sum()), float(variances[:3].sum())
