# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recovery: an estimate that is lost ends its segment, and the run starts again as a new one.

States from where the images began to contradict the estimate are taken back. The new segment is put
where the IMU predicts its start from the last good state; how well that is known is its joint.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise

import gtsam
import numpy as np

from slam_graph.backend import Estimator
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.pipeline.agreement import Agreement
from slam_graph.pipeline.divergence import DivergenceError, JumpError, check_sane
from slam_graph.results import RunResult

_MOST_SHORT = 3
"""After so many short segments in a row the run is given up: not a fault that passes is the cause,
but one that stays, such as a wrong calibration."""
_REMEMBERED_NS = 30_000_000_000
"""States are remembered for so long: one of them is the last good one when the estimate is lost."""
_MARGIN_NS = 500_000_000
"""States so long before a contradiction are taken back too: it shows late, as new features are
tested only after some frames."""
_SAME = 1e-6
"""States differ by no more than this, m and rad, if they differ by a motion of the world alone."""
_LONGEST_BLIND_S = 1.0
"""Longest time without frames and without IMU samples after which an estimate goes on."""


class Recovery:
    """Notes states by segments, and begins a new segment where the estimate is lost.

    Args:
        result: of the run; it is given the states and the segments.
        estimator: the back end.
        diagnostics: counts new segments.

    Attributes:
        world_motion: new_T_old, if the last frame has moved all states of the segment with their
            world.
        world_scale: by which these were scaled before that.
    """

    def __init__(self, result: RunResult, estimator: Estimator, diagnostics: Diagnostics) -> None:
        self._result, self._estimator, self._diagnostics = result, estimator, diagnostics
        self._agreement = Agreement(result.config)
        self._recent: deque[NavState] = deque()
        self._short = 0
        self.world_motion: gtsam.Pose3 | None = None
        self.world_scale = 1.0

    @property
    def agreement(self) -> Agreement:
        """Of the images with the present segment; its times are on the clock of the states."""
        return self._agreement

    @property
    def offset_ns(self) -> int:
        """How much later states are than the stamps of their frames, but for an online estimate."""
        return round(self._estimator.rig.pose_offset_s * 1e9)

    def append(self, states: list[NavState]) -> None:
        """Note new states; the first after a start begins a segment."""
        result = self._result
        joined, of_fixes = self._world()
        joint = self._estimator.joint if joined else None
        for state in states:
            if joint is None:
                result.segments.add(state.stamp_ns, of_fixes=of_fixes)
                result.history.append(state)
            else:
                result.segments.add(state.stamp_ns, joint.covariance, joint.holds, of_fixes)
                result.history.append(joint.added_to(state))
            self._recent.append(state)
            while self._recent[0].stamp_ns < state.stamp_ns - _REMEMBERED_NS:
                self._recent.popleft()
        self._note_unit()

    def _world(self) -> tuple[bool, bool]:
        """Whether the present segment continues the one before; whether fixes tell its world.

        One whose world fixes tell does not continue one that was never in that world, where its
        place, and perhaps its unit of length, are not known.
        """
        joint, of_fixes = self._estimator.joint, self._estimator.aiding.aligned
        ended = [segment for segment in self._result.segments if segment.ended_by]
        before = bool(ended) and ended[-1].of_fixes
        if of_fixes and not before:
            return False, True
        return True, of_fixes or (before and joint is not None and joint.holds)

    def _note_unit(self) -> None:
        """Note whether fixes tell the unit of length of all segments."""
        result = self._result
        told = result.segments.all_of_fixes
        result.history.scaled_camera = None if told else result.input.rig.scaled_camera

    def supersede(self, by: list[NavState]) -> None:
        """Forget the states of the present segment, as others come in their place.

        Args:
            by: those; they are still to be appended.
        """
        segments = self._result.segments
        segments.forget_last()
        since_ns = segments[-1].end_ns + 1 if len(segments) else None
        self.world_motion = self._motion_to(by, since_ns)
        rigid = self.world_motion is not None and self.world_scale == 1.0
        self._result.forget_states(since_ns, rigid)
        self._agreement = Agreement(self._result.config)
        self._recent = deque(s for s in self._recent if since_ns and s.stamp_ns < since_ns)

    def _motion_to(self, by: list[NavState], since_ns: int | None) -> gtsam.Pose3 | None:
        """The motion to the world of the fixes, if other states are those so far after it."""
        found, poses = self._estimator.aiding.found, {s.stamp_ns: s.world_T_body for s in by}
        recent = [s for s in self._recent if since_ns is None or s.stamp_ns >= since_ns]
        if found is None or not recent:
            return None
        for state in found.moved(recent):
            there = poses.get(state.stamp_ns)
            if there is None or not there.equals(state.world_T_body, _SAME):
                return None
        self.world_scale = found.scale
        return found.motion

    def check_recorded(self, time_ns: int) -> None:
        """Refuse to go on after a time of which nothing is recorded.

        Args:
            time_ns: of the next frame, on the clock of the IMU; the estimator has the samples up to
                it.

        Raises:
            DivergenceError: if neither frames nor samples were recorded for too long.
        """
        if not self._recent or not self._estimator.initialized:
            return
        last_ns = self._recent[-1].stamp_ns
        # all samples, as those before this frame may have come with an earlier one, on any clock
        stamps = self._estimator.imu_stamps_ns
        between = stamps[(stamps > last_ns) & (stamps < time_ns)]
        times_ns = [last_ns, *between.tolist(), time_ns]
        blind_s = max(later - earlier for earlier, later in pairwise(times_ns)) * 1e-9
        if blind_s > _LONGEST_BLIND_S:
            stamp_ns = time_ns - self.offset_ns
            message = f"lost at frame {stamp_ns}: nothing was recorded for {blind_s:.1f} s"
            raise DivergenceError(message)

    def begin_segment(self, lost: DivergenceError, noticed_ns: int) -> None:
        """End the segment where the images last agreed with it, and start again.

        Args:
            lost: why.
            noticed_ns: time, on the clock of the states, of the frame at which that was noticed.

        Raises:
            DivergenceError: the same, if a new start has no prospect or is not wanted.
        """
        result, measured = self._result, not isinstance(lost, JumpError)
        self.world_motion, self.world_scale = None, 1.0
        change = self._estimator.find_clock_change() if measured else None
        if change is not None:
            lost = DivergenceError(change.message)
        good_ns = self._good_until(None if change is None else change.good_ns)
        if good_ns is not None:
            result.segments.losses.append((good_ns, noticed_ns))
        if not result.config.limits.recovery:
            raise lost
        self._forget_bad_states(good_ns)
        before = self._recent[-1] if self._recent else None
        lasted_s = result.segments.end(good_ns, str(lost))
        self._note_unit()
        end_ns = result.segments[-1].end_ns if len(result.segments) else None
        result.forget_states(None if end_ns is None else end_ns + 1)
        self._short = self._short + 1 if lasted_s < result.segments.SHORT_S else 0
        if self._short >= _MOST_SHORT:
            raise lost
        self._agreement = Agreement(result.config)
        self._diagnostics.warn("new_segment", f"{lost}; the run starts again from here")
        try:
            self._estimator.begin_segment(before, measured)
            for state in self._estimator.states:
                check_sane(state, result.config)
        except (DivergenceError, RuntimeError, np.linalg.LinAlgError):
            # not with the frames that were there already: with those that follow
            self._estimator.begin_segment(before, measured)
        self.append(self._estimator.states)

    def _good_until(self, unchanged_ns: int | None) -> int | None:
        """Until when the states of the present segment are good; None if none is.

        Times are on the clock of the IMU, as those of states are.

        Args:
            unchanged_ns: until when the clock was as before, if it has changed.
        """
        segments, agreed_ns = self._result.segments, self._agreement.agreed_until()
        if unchanged_ns is not None:
            agreed_ns = unchanged_ns if agreed_ns is None else min(agreed_ns, unchanged_ns)
        if not segments.goes_on or agreed_ns is None:
            return None
        good_ns = agreed_ns - _MARGIN_NS
        return good_ns if good_ns > segments[-1].begin_ns else None

    def _forget_bad_states(self, good_ns: int | None) -> None:
        """Forget the states of the present segment after a time, or all of them if it is None."""
        segments = self._result.segments
        if not segments.goes_on:
            return
        last_ns = segments[-1].begin_ns - 1 if good_ns is None else good_ns
        while self._recent and self._recent[-1].stamp_ns > last_ns:
            self._recent.pop()
