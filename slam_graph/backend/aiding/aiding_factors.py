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
from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.estimated_path import EstimatedPath, variances_of
from slam_graph.backend.aiding.fix_factors import (
    Fix,
    FixGate,
    PositionFix,
    fixes_of,
    pose_between,
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

_MOST_FIXES = 300
"""Fixes that are remembered for the alignment."""
_TIMINGS = 3
"""Alignments, each at the times that the one before has found."""
_UNTIMED, _MOST_UNTIMED = 0.5, 40
"""How far the path comes in the standard deviation of an estimated offset, in σ of a fix, at most;
with so many fixes it is taken as it is, as on a straight road at an even speed nothing tells it."""
_HISTORY_NS = 5_000_000_000
"""How long odometry and states are kept."""


class Aiding:
    """Takes fixes, known poses and odometry, and makes factors of them.

    Args:
        config: settings.
        level: whether gravity is measured.

    Attributes:
        aligned: whether the world is that of the fixes.
        used: whether there was anything to take so far.
        gates: of the sources of fixes, by name.
        offset_s: time that was found to be missing from those of position fixes.
    """

    def __init__(self, config: BackendConfig, level: bool) -> None:
        self._config, self._level = config, level
        self._data = AidingData.empty()
        self.gates: defaultdict[str, FixGate] = defaultdict(FixGate)
        self.used, self.offset_s, self._offset_sigma_s = False, 0.0, 0.0
        self.restart()

    def restart(self) -> None:
        """The estimate begins anew, in another world."""
        self.aligned = False
        self._path = EstimatedPath()
        self._waiting = self._offered = AidingData.empty()
        self._offered_ns = 0
        self._fixes: list[Fix] = []

    def add(self, data: AidingData) -> None:
        """Take measurements that follow those before; none say that there will be some."""
        self.used = True
        data = self._config.on_the_clock(data).shifted(round(self.offset_s * 1e9))
        self._data = AidingData.concatenate([self._data, data])
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
        first, last = (state.frames.atPose3(pose_key(i)) for i in frames)
        factors: list[gtsam.NonlinearFactor] = []
        if self._config.odometry.enabled:
            moved = self._data.odometry_between(*stamps_ns)
            if moved is not None:
                factors.append(odometry_factor(frames, moved, self._config.odometry))
        if not self.aligned:
            return factors
        for fix in self._due(stamps_ns):
            share = (fix.stamp_ns - stamps_ns[0]) / (stamps_ns[1] - stamps_ns[0])
            then = (
                pose_between(first, last, share) if share > 0.0 else self._path.pose(fix.stamp_ns)
            )
            if then is None:
                continue
            here = self._of_unsure_time(fix.moved(then, last), (first, last), stamps_ns)
            weight = 1.0 if known is None else self.gates[fix.source].weight(here, last, known)
            if weight > 0.0:
                factors.append(here.factor(pose_key(frames[1]), weight))
        return factors

    def _due(self, stamps_ns: tuple[int, int]) -> list[Fix]:
        """The fixes up to a new frame that no frame up to the last one has taken.

        GTSAM's smoothers predict frames that they do not keep: what was due for one is due again.
        """
        since_ns, stamp_ns = stamps_ns
        if self._offered_ns > since_ns:
            self._waiting = AidingData.concatenate([self._offered, self._waiting])
        self._offered, self._offered_ns = self._waiting.within(None, stamp_ns), stamp_ns
        self._waiting = self._waiting.within(stamp_ns, None)
        return fixes_of(self._offered, self._config)

    def _of_unsure_time(
        self, fix: Fix, poses: tuple[gtsam.Pose3, gtsam.Pose3], stamps_ns: tuple[int, int]
    ) -> Fix:
        """A fix with the noise that an offset of its clock which is not known well adds."""
        if not isinstance(fix, PositionFix) or not fix.is_timed or self._offset_sigma_s == 0.0:
            return fix
        velocity = (fix.of(poses[1]) - fix.of(poses[0])) / ((stamps_ns[1] - stamps_ns[0]) * 1e-9)
        along = self._offset_sigma_s * velocity
        return replace(fix, covariance=fix.covariance + np.outer(along, along))

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
        if state is None or not self.used or not self._path.append(state):
            return None
        if self.aligned:  # for fixes that come late
            if state.stamp_ns - self._path.states[0].stamp_ns > 2 * _HISTORY_NS:
                self._path.forget_before(state.stamp_ns - _HISTORY_NS)
            return None
        due = self._due((state.stamp_ns, state.stamp_ns))
        self._fixes = [*self._fixes, *due][-_MOST_FIXES:]
        return self._aligned(state) if due else None

    def _aligned(self, state: NavState) -> WorldAlignment | None:
        """Where the world is, by the fixes so far."""
        sigma_s, offset_s = self._config.gnss.time_offset_sigma_s, 0.0
        now = np.asarray(state.world_T_body.translation())
        found: WorldAlignment | None = None
        for _ in range(_TIMINGS if sigma_s > 0.0 else 1):
            pairs = [self._path.at(fix, round(offset_s * 1e9)) for fix in self._fixes]
            # older fixes tell less of the world: the path has drifted since
            drifted = [pair.after_drift(*variances_of(state)) for pair in pairs if pair is not None]
            expected_s = -self.offset_s - offset_s
            found = align_world(drifted, now, self._level, (expected_s, sigma_s))
            if found is None:
                return None
            offset_s += found.offset_s
        assert found is not None
        if self._is_untimed(found, round(offset_s * 1e9)):
            return None
        return replace(found, offset_s=offset_s)

    def _is_untimed(self, found: WorldAlignment, offset_ns: int) -> bool:
        """Whether the clock of the fixes is known so badly that it counts beside their noise."""
        if found.offset_sigma_s == 0.0:
            return False
        timed = [
            pair for fix in self._fixes if fix.is_timed and (pair := self._path.at(fix, offset_ns))
        ]
        if not 0 < len(timed) < _MOST_UNTIMED:
            return False
        speed = np.mean([np.linalg.norm(pair.velocity) for pair in timed])
        sigma = np.sqrt(np.mean([np.trace(pair.fix.covariance) / 3.0 for pair in timed]))
        return bool(found.offset_sigma_s * speed > _UNTIMED * sigma)

    def settle(self, found: WorldAlignment) -> list[NavState]:
        """Go on in the world of the fixes; all states so far in that world, the newest last."""
        states = in_moved_world(self._path.states, found.motion)
        states = [with_unknown_gauge(state, found.covariance, found.centre) for state in states]
        self.aligned, self._fixes, self._path.states = True, [], list(states)
        self.offset_s, self._offset_sigma_s = self.offset_s + found.offset_s, found.offset_sigma_s
        self._waiting = self._waiting.shifted(round(found.offset_s * 1e9))
        return states
