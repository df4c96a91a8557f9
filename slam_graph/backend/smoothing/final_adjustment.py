# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Smoothing of a whole recording: one bundle adjustment, or several overlapping ones if it is long.

Without loop closures the estimate inside a segment hardly depends on what is far outside of it. So
a long recording is solved in overlapping segments. Each is aligned with the one before at a
keyframe in the middle of their overlap, in position and yaw, which no segment can observe. Where
position fixes tell these, segments are joined as in `segment_chain.py`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.smoothing.adjustment_figures import FinalBaSummary, summary_of, total_of
from slam_graph.backend.smoothing.adjustment_progress import Report, SegmentProgress
from slam_graph.backend.smoothing.calibration_equations import CalibrationEquations
from slam_graph.backend.smoothing.calibration_faults import CalibrationFault, calibration_faults
from slam_graph.backend.smoothing.causal_outliers import causal_outliers
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.imu_noise_estimation import ImuNoiseFactors
from slam_graph.backend.smoothing.keyframe_aiding import aiding_of_keyframes
from slam_graph.backend.smoothing.keyframe_states import (
    extended_by,
    in_unknown_world,
    states_at,
    with_angular_rates,
)
from slam_graph.backend.smoothing.pose_equations import PoseEquations
from slam_graph.backend.smoothing.recording_problem import BundleAdjustment
from slam_graph.backend.smoothing.recording_segment import RecordingSegment, read_segment
from slam_graph.backend.smoothing.segment_adjustment import (
    UndeterminedError,
    adjust_segment,
    check_minimum,
)
from slam_graph.backend.smoothing.segment_chain import SegmentChain, overlap_of, segments
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.backend.smoothing.smoothing_task import AdjustedSegment, SegmentStart, SmoothingTask
from slam_graph.backend.solve.single_thread import on_one_thread
from slam_graph.backend.world_gauge import in_gauge_of, in_moved_world, world_motion
from slam_graph.errors import EstimationError
from slam_graph.geometry import NavState, StateHistory, Trajectory
from slam_graph.sensors import AidingData, CalibrationEstimate, Rig

logger = logging.getLogger(__name__)


_STRIDE, _CONTEXT = 10, 40
"""Backward extension: keyframes per stride, and later keyframes that are adjusted with them."""
_MIN_KEYFRAMES = 3


@dataclass(frozen=True, slots=True, eq=False)
class FinalBa:
    """The smoothed trajectory of a recording.

    Attributes:
        history: states of all frames with their covariances, which are relative to position and yaw
            of the first state of the causal estimate; NaN if they could not be computed.
        summary: figures.
        aligned: (N, 6, 6) pose covariances of what is left after an alignment in position and yaw
            over all frames, in the body frame, rotation before position; None where positions
            determine no yaw, and of a recording in several segments.
        noise: learned factors on the noise of the IMU; of the last segment.
        equations: those at the minimum, which others can be joined to; None if they were not wanted
            or are not known, and where the recording was adjusted in several segments.
        fixes: lever arm and clock of the position fixes, where they are variables; of the last
            segment with fixes of its own.
        calibration: what the recording says of the rig, by one step from the calibration it was
            adjusted with; None if that is not known.
        checked: the equations that this comes from.
        fitting: the calibration with what is clearly off corrected; None if nothing is.
        within: (N, 6, 6) pose covariances as those of the history, but relative to position and yaw
            of a state of the same world; None where all states are in one.
        absolute: whether fixes tell the world of all states.
    """

    history: StateHistory
    summary: FinalBaSummary
    aligned: FloatArray | None
    noise: ImuNoiseFactors = field(default_factory=ImuNoiseFactors)
    equations: PoseEquations | None = None
    fixes: AidingData.Calibration | None = None
    within: FloatArray | None = None
    calibration: CalibrationEstimate | None = None
    checked: CalibrationEquations | None = None
    fitting: Rig | None = None
    absolute: bool = False

    @property
    def calibration_faults(self) -> list[CalibrationFault]:
        """What of the calibration is clearly off, the clearest first."""
        return [] if self.calibration is None else calibration_faults(self.calibration)

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all frames, with velocities and biases."""
        return self.history.trajectory()

    @staticmethod
    @on_one_thread
    def of_worlds(
        log: FrameLog,
        causal: Trajectory,
        worlds: Sequence[tuple[int, int | None, FloatArray, bool]],
        rig: Rig,
        backend: BackendConfig,
        config: FinalBaConfig,
        report: Report,
        joint: bool = False,
        consistent: bool = False,
    ) -> FinalBa | None:
        """Solve each part of a recording as a whole whose poses are in one world.

        Args:
            log: all frames.
            causal: as for `adjust_recording`.
            worlds: times of the first and the last state of each part, in the order of time, None
                for the end of the recording; the covariance of its gauge in the world of the
                first (4, 4) or (6, 6), m and rad; whether it is in the world of fixes. Frames
                before the first part belong to it.
            rig: as for `adjust_recording`.
            backend: noise and triangulation.
            config: settings.
            report: is given the progress after each step.
            joint: as for `adjust_recording`.
            consistent: whether features that do not fit the causal trajectory are left out.
        """
        parts: list[FinalBa] = []
        for number, (begin_ns, end_ns, unknown, of_fixes) in enumerate(worlds):
            inside = causal.stamps_ns >= begin_ns
            if end_ns is not None:
                inside &= causal.stamps_ns <= end_ns
            offset_ns = round(rig.pose_offset_s * 1e9)
            first_ns = None if number == 0 else begin_ns - offset_ns
            last_ns = None if end_ns is None else end_ns - offset_ns
            part = log.part(first_ns, last_ns, of_fixes)
            try:
                chosen = causal if inside.all() else causal.select(inside)
                if consistent:
                    task = SmoothingTask.of(rig, backend, config)
                    part = part.without(causal_outliers(part, chosen, task))
                known = joint and len(worlds) == 1
                found = adjust_recording(part, chosen, rig, backend, config, report, joint=known)
            except EstimationError as error:
                if len(worlds) == 1:
                    raise
                logger.warning("part %d of the recording is not smoothed: %s", number, error)
                continue
            if found is not None:
                within = found.history.pose_covariances() if len(worlds) > 1 else None
                history = in_unknown_world(found.history, unknown)
                parts.append(replace(found, history=history, within=within))
        if len(parts) < 2:
            return parts[0] if parts else None
        history = min((part.history for part in parts), key=lambda own: own.has_scale).like()
        for found in parts:
            history.extend(found.history)
        last = parts[-1]
        summary = total_of([found.summary for found in parts])
        own = np.concatenate([found.within for found in parts if found.within is not None])
        of_fixes = all(found.absolute for found in parts)
        whole = FinalBa(
            history, summary, None, last.noise, fixes=last.fixes, within=own, absolute=of_fixes
        )
        return whole.with_calibration([found.checked for found in parts], rig, backend)

    def about(self, nominal: Rig, backend: BackendConfig) -> FinalBa:
        """With the calibration as it is found with a prior about another one than that of it."""
        if self.calibration is None or self.checked is None:
            return self
        stamp_ns, rig = self.calibration.stamp_ns, self.calibration.nominal
        found = self.checked.estimate(rig, backend.calibration, stamp_ns, nominal)
        return replace(self, calibration=found)

    def with_calibration(
        self, parts: Sequence[CalibrationEquations | None], rig: Rig, backend: BackendConfig
    ) -> FinalBa:
        """With what parts of the recording say of the calibration.

        Args:
            parts: equations of each part, as far as they are known.
            rig: the calibration that it was adjusted with.
            backend: prior standard deviations.
        """
        checked = CalibrationEquations.total([part for part in parts if part is not None])
        if checked is None:
            return self
        end_ns = int(self.trajectory.stamps_ns[-1])
        found = checked.estimate(rig, backend.calibration, end_ns)
        return replace(self, checked=checked, calibration=found)


def adjust_recording(
    log: FrameLog,
    causal: Trajectory,
    rig: Rig,
    backend: BackendConfig,
    config: FinalBaConfig,
    report: Report,
    least_noise: float = 1.0,
    joint: bool = False,
) -> FinalBa | None:
    """Solve a recording as a whole.

    Args:
        log: all its frames.
        causal: the initial estimate, with velocities and biases, on the clock of the IMU. Its first
            pose keeps its position and yaw, so that both trajectories are in the same world; where
            that is the world of position fixes, these are used and the first pose is free.
        rig: the best calibration available.
        backend: noise and triangulation.
        config: settings.
        report: is given the progress after each step.
        least_noise: smallest factor on the noise of the IMU that is learned; one if the
            noise was calibrated.
        joint: whether the equations at the minimum are kept, which others can be joined to; not of
            a recording of several segments.

    Returns:
        The smoothed trajectory; None if there are too few observations to improve on the causal
        estimate, which is logged.

    Raises:
        EstimationError: if the minimum does not fit the observations.
    """
    try:
        task = SmoothingTask.of(rig, backend, config, least_noise)
        checks = config.check_calibration and rig.has_imu and rig.depth is None
        checks &= backend.dynamics.uses_imu(rig.has_imu)
        task = replace(task, joint=joint, calibration=checks)
        return _smoothed(log, causal, task, report)
    except UndeterminedError as reason:
        logger.info("no final bundle adjustment: %s", reason)
        return None


def _smoothed(log: FrameLog, causal: Trajectory, task: SmoothingTask, report: Report) -> FinalBa:
    """What `adjust_recording` returns where there are enough observations."""
    began = (time.perf_counter(), time.process_time())
    keyframes = log.keyframes
    if len(keyframes) < _MIN_KEYFRAMES or len(causal) == 0:
        raise UndeterminedError(f"{len(keyframes)} keyframes are too few")
    longest, began_ns = task.config.max_keyframes, causal.stamps_ns[0]
    if task.rig.needs_two_views:  # nothing predicts the frames before the start well enough
        stamps_ns = log.frames_ns[keyframes] + round(task.rig.pose_offset_s * 1e9)
        keyframes = keyframes[stamps_ns >= began_ns]
        if len(keyframes) < _MIN_KEYFRAMES:
            raise UndeterminedError(f"{len(keyframes)} keyframes are too few")
    else:
        causal = _extended_backward(
            log, causal, replace(task, joint=False, calibration=False), report
        )
    if len(keyframes) > longest:
        task = replace(task, joint=False)
    level = task.rig.has_imu
    history = StateHistory(level, None if log.georeferenced else task.rig.scaled_camera)
    chain, solved, all_absolute = SegmentChain(history), list[AdjustedSegment](), True
    for first, stop in segments(len(keyframes), longest):
        segment = _read(log, keyframes[first:stop], task)
        stamps_ns = segment.keyframe_stamps_ns
        if not _overlaps(causal, stamps_ns):
            continue
        # without an IMU errors are judged by the first pose, so that it defines the world
        anchor = int(np.searchsorted(stamps_ns[:-1], began_ns)) if level else 0
        if solved:
            anchor = min(overlap_of(longest) // 2, len(stamps_ns) - 1)
        link, known = chain.at(stamps_ns[anchor]), chain.known(stamps_ns[anchor])
        given = log.aiding, causal, task.backend, log.fix_calibration
        aiding = aiding_of_keyframes(stamps_ns, *given, known)
        segment, absolute = replace(segment, aiding=aiding), aiding.absolute
        all_absolute &= absolute
        start = states_at(causal, stamps_ns, segment.imu, task.preintegration)
        if not level:
            task = replace(task, causal=causal)
            start = with_angular_rates(start, segment.imu)
        begin = 0 if link is None else int(segment.keyframes[anchor])
        if link is not None and not absolute:
            start = _aligned(start, start[anchor], link, level)
        steps = sum(part.figures.iterations for part in solved)
        own = longest - overlap_of(longest) if stop < len(keyframes) else stop - first
        progress = _progress(report, (first, own, len(keyframes)), steps, task.config)
        joint = own + overlap_of(longest) // 2 if absolute and stop < len(keyframes) else None
        adjusted = adjust_segment(SegmentStart(segment, start, anchor, None, joint), task, progress)
        states = adjusted.states[begin:]
        if not absolute:
            held = states[int(segment.keyframes[anchor]) - begin]
            states = _placed(states, held, start[anchor], link, level)
        gains = None if adjusted.gains is None else adjusted.gains[begin:]
        chain.add(states, gains, linked=known is not None)
        aligned = None if solved else adjusted.aligned  # kept where one segment is all
        solved.append(replace(adjusted, states=[], gains=None, aligned=aligned))
    if not solved:
        raise EstimationError("the causal estimate covers none of the keyframes")
    chain.end()
    figures = [part.figures for part in solved]
    alone = solved[0] if len(solved) == 1 else None
    summary = summary_of(figures, len(history), began)
    whole = FinalBa(
        history,
        summary,
        None if alone is None else alone.aligned,
        solved[-1].noise,
        None if alone is None else alone.equations,
        next((part.fixes for part in reversed(solved) if part.fixes is not None), None),
        absolute=all_absolute,
    )
    checked = [part.calibration for part in solved]
    return whole.with_calibration(checked, task.rig, task.backend)


def _read(log: FrameLog, keyframes: IntArray, task: SmoothingTask) -> RecordingSegment:
    """The segment from the first of some keyframes to the last."""
    return read_segment(log, keyframes, task.rig, task.backend.zero_velocity)


def _extended_backward(
    log: FrameLog, causal: Trajectory, task: SmoothingTask, report: Report
) -> Trajectory:
    """A trajectory extended backward to (less than a stride after) the first frame.

    Backward IMU prediction alone holds for a few seconds only. So it is done in strides, each
    followed by a bundle adjustment of the frames around it.
    """
    keyframes = log.keyframes
    stamps_ns = log.frames_ns[keyframes] + round(task.rig.pose_offset_s * 1e9)
    while (before := int(np.searchsorted(stamps_ns, causal.stamps_ns[0]))) > _STRIDE:
        first = before - _STRIDE
        segment = _read(log, keyframes[first : before + _CONTEXT], task)
        known = segment.keyframe_stamps_ns
        if not _overlaps(causal, known):
            break
        states = states_at(causal, known, segment.imu, task.preintegration)
        start = SegmentStart(segment, states, min(_STRIDE, len(known) - 1))
        progress = _progress(report, (0, 0, len(keyframes)), 0, task.config)
        solved = BundleAdjustment(start, task, progress.solving).solve()
        check_minimum(solved)
        earlier = [s for s in solved.states if s.stamp_ns < causal.stamps_ns[0]]
        causal = extended_by(earlier, causal)
    return causal


def _aligned(
    states: list[NavState], moving: NavState, fixed: NavState, level: bool
) -> list[NavState]:
    """States moved by what the gauge leaves open, so that `moving` comes to `fixed`."""
    return in_moved_world(states, world_motion(moving.world_T_body, fixed.world_T_body, level))


def _placed(
    states: list[NavState], held: NavState, place: NavState, link: NavState | None, level: bool
) -> list[NavState]:
    """States of a segment in the world of those before, where no fixes tell it.

    Args:
        states: of the segment.
        held: that of its anchor, which steps leave where it was to some 1e-7 m.
        place: where the anchor is.
        link: the state of the segment before there; None for the first segment.
        level: whether gravity is measured.
    """
    moved = _aligned(states, held, place, level)
    return moved if link is None else in_gauge_of(link, moved, level)


def _progress(
    report: Report, extent: tuple[int, int, int], steps: int, config: FinalBaConfig
) -> SegmentProgress:
    """A report of the steps of a segment as those of the whole recording.

    Args:
        report: of the whole recording.
        extent: keyframes before the segment, those that it adds, and all.
        steps: before the segment.
        config: settings, which decide what is done.
    """
    return SegmentProgress(report, *extent, steps=steps, fuses=config.fuse_features)


def _overlaps(causal: Trajectory, stamps_ns: IntArray) -> bool:
    """Whether any of some times is within the causal estimate."""
    return bool(np.any((stamps_ns >= causal.stamps_ns[0]) & (stamps_ns <= causal.stamps_ns[-1])))
