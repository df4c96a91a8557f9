# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Smoothing as a stage: frames are kept on disk, and bundle adjusted as a whole at the end."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from slam_graph import backend
from slam_graph.arrays import FloatArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError, SlamGraphError
from slam_graph.kernels.free_memory import give_back
from slam_graph.pipeline.observers import Progress
from slam_graph.pipeline.stage import (
    COMPLETED,
    EstimatedFrame,
    NoObjects,
    Stage,
    warn_on_failure,
)
from slam_graph.pipeline.world_of_fixes import usable_aiding
from slam_graph.results import RunResult
from slam_graph.sensors import Rig

_SMOOTHED = (*COMPLETED, "diverged")
"""Run statuses after which the recording is bundle adjusted (not after Ctrl-C)."""

_FAILED = "no smoothed trajectory"
_UNCALIBRATED = "the calibration is not corrected in the smoothed trajectory"
_CALIBRATIONS = 3
"""How often the recording is adjusted again with the calibration that it shows."""
_SECOND = "no second adjustment with only what fits the causal trajectory"
_LEAST_LEFT = 0.6
"""Features that do not fit the causal trajectory are left out where this part of the observations
is left: where less is, it may be what is wrong."""

logger = logging.getLogger(__name__)


class Smoothing(Stage):
    """Keeps the frames of a run in a temporary folder and solves the recording as a whole.

    Whatever goes wrong is counted as a warning; the causal result stays as it is.

    Features that were found to move are left out. Where the minimum is far from the causal
    trajectory, the adjustment may have taken something that moves for static; then it is done again
    without the features that do not fit that trajectory.

    Args:
        result: of the run; it is given the smoothed trajectory.
        progress: told after each step of the adjustment.
        diagnostics: counts what goes wrong.
        objects: knows what moves.
    """

    def __init__(
        self, result: RunResult, progress: Progress, diagnostics: Diagnostics, objects: NoObjects
    ) -> None:
        self._result, self._objects = result, objects
        self._progress = progress
        self._diagnostics = diagnostics
        self._recording = ExitStack()
        self._log: backend.FrameLog | None = None

    def begin(self, resources: ExitStack) -> None:
        """Make the temporary folder."""
        rig, config = self._result.input.rig, self._result.config.final_ba
        try:
            folder = resources.enter_context(TemporaryDirectory(prefix="slam_graph_"))
            resources.enter_context(self._recording)  # released before the folder is removed
            recording = backend.FrameLog.recording(rig, config, Path(folder))
            self._log = self._recording.enter_context(recording)
        except OSError as error:
            self._give_up(error)

    def frame(self, frame: EstimatedFrame) -> None:
        """Keep a frame with the IMU samples since the one before."""
        if self._log is None:
            return
        try:
            packet = frame.packet
            aiding = usable_aiding(packet.aiding, self._result.input)
            self._log.add(packet.imu, frame.features, frame.imu_noise, aiding)
            if frame.clock_changes is not None:
                self._log.clock_changes = frame.clock_changes
            self._log.fix_offset_s = frame.fix_offset_s
            self._log.fix_calibration = frame.fix_calibration
        except (OSError, SlamGraphError) as error:
            self._give_up(error)

    def finish(self) -> None:
        """Solve the recording as a whole, if there is an estimate to start from."""
        result = self._result
        if self._log is None or not len(result.history) or result.status not in _SMOOTHED:
            return
        with warn_on_failure(self._diagnostics, "final_ba_failed", _FAILED):
            self._recording.close()
            give_back()  # the adjustment takes tens of MB
            self._solve(self._log)

    def _solve(self, log: backend.FrameLog) -> None:
        result = self._result
        log = log.without(self._objects.moved)
        found = self._adjusted(log)
        if found is None:
            return
        is_apart, causes = self._contradiction(found)
        consistent = False
        if is_apart:
            again = self._consistent(log, found)
            consistent, found = again is not None, again or found
            if again is None:
                self._diagnostics.warn("smoothed_contradicts", "; ".join(causes))
        result.final_ba = found  # not one that may contradict, and of which nothing is said yet
        if found.calibration_faults:
            result.final_ba = found = self._calibrated(log, found, consistent)
        summary = found.summary
        logger.info(
            "final bundle adjustment: %d keyframes, %d features, %d steps in %.1f s",
            summary.keyframes,
            summary.features,
            summary.iterations,
            summary.seconds,
        )

    def _calibrated(
        self, log: backend.FrameLog, first: backend.FinalBa, consistent: bool
    ) -> backend.FinalBa:
        """The adjustment with the calibration that it shows, as that it had is clearly wrong.

        Loop closure, maps and objects hold what was seen under the calibration of the run, and go
        with a trajectory under that one.

        Args:
            log: all frames.
            first: the adjustment with the calibration of the run.
            consistent: as for `_adjusted`.
        """
        found, settings = first, self._result.config
        assert first.calibration is not None
        nominal = first.calibration.nominal
        off = {fault.variable for fault in first.calibration_faults}
        fitting = self._corrected(first, nominal, off)
        others = settings.objects, settings.loop_closure, settings.map
        for _ in range(0 if any(other.enabled for other in others) else _CALIBRATIONS):
            rig, again = fitting, None
            with warn_on_failure(self._diagnostics, "calibration_off", _UNCALIBRATED):
                again = self._adjusted(log, rig, consistent)
            if again is None or again.calibration is None:
                break
            more = {fault.variable for fault in again.calibration_faults}
            off |= more
            fitting = self._corrected(again, nominal, off)
            found = _with_all_steps(again.about(nominal, settings.backend), found)
            if not more:
                break
        if not found.calibration_faults:  # it was but a little above a limit
            found = first
        latest = self._result.logs.calibration.latest
        estimated = () if latest is None else latest.covariances  # which the run has found itself
        what = "; ".join(f.what for f in found.calibration_faults if f.variable not in estimated)
        if what:
            corrected = "; the smoothed trajectory has it corrected" if found is not first else ""
            self._diagnostics.warn("calibration_off", what + corrected)
        return replace(found, fitting=fitting)

    def _corrected(self, found: backend.FinalBa, nominal: Rig, off: set[str]) -> Rig:
        """The calibration of an adjustment, after a step of what is off; all else is right then.

        Args:
            found: the adjustment.
            nominal: the calibration of the run, that the prior is about.
            off: variables, as in `CalibrationEstimate`.
        """
        assert found.checked is not None
        assert found.calibration is not None
        config, rig = self._result.config.backend.calibration, found.calibration.nominal
        stamp_ns = found.calibration.stamp_ns
        return found.checked.estimate(rig, config, stamp_ns, nominal, off).rig

    def _adjusted(
        self, log: backend.FrameLog, rig: Rig | None = None, consistent: bool = False
    ) -> backend.FinalBa | None:
        """The adjustment of a log; None if it has too few observations.

        Args:
            log: all frames.
            rig: the calibration; that of the run if not said.
            consistent: whether features that do not fit the causal trajectory are left out.
        """
        result = self._result
        segments = result.segments
        parts: list[tuple[int, int | None, FloatArray, bool]] = [
            (
                *(group[0].begin_ns, group[-1].end_ns, group[0].joint_covariance),
                all(segment.of_fixes for segment in group),
            )
            for group in segments.worlds()
        ]
        if segments.goes_on:  # the last one has the rest of the recording
            parts[-1] = parts[-1][0], None, *parts[-1][2:]
        return backend.FinalBa.of_worlds(
            log,
            result.trajectory,
            parts,
            rig or result.logs.calibration.rig(result.causal_rig),
            result.config.backend,
            result.config.final_ba,
            self._progress.adjusting,
            result.config.objects.enabled,
            consistent,
        )

    def _consistent(self, log: backend.FrameLog, first: backend.FinalBa) -> backend.FinalBa | None:
        """The adjustment of what fits the causal trajectory, if it agrees with that.

        Args:
            log: all frames.
            first: the adjustment with all features.
        """
        found = None
        with warn_on_failure(self._diagnostics, "smoothed_contradicts", _SECOND):
            try:
                found = self._adjusted(log, consistent=True)
            except EstimationError as error:
                logger.info("what fits the causal trajectory has no minimum: %s", error)
        if found is None:
            return None
        left = found.summary.observations / max(first.summary.observations, 1)
        _, causes = self._contradiction(found)
        logger.info(
            "of what fits the causal trajectory %.0f%% is left; %s", 100 * left, causes or "agrees"
        )
        return found if left >= _LEAST_LEFT and not causes else None

    def _contradiction(self, found: backend.FinalBa) -> tuple[bool, list[str]]:
        """Whether an adjustment is so far from the causal trajectory that one of them is wrong.

        Without an IMU motion is a guess, whose errors are not white; and in the world of position
        fixes these tell more of it than the causal covariance does.

        Returns:
            That, and in words what is beyond the usual; [] if it is as near as in good runs.
        """
        from slam_graph.diagnosis import Diagnosis  # it takes a moment to import

        result = self._result
        if not result.input.rig.has_imu or result.georeferenced:
            return False, []
        innovations = result.logs.innovations.columns()
        evidence = Diagnosis.of_run(innovations, None, result.history, found.history)
        return evidence.is_apart, evidence.causes

    def _give_up(self, error: Exception) -> None:
        self._log = None
        with warn_on_failure(self._diagnostics, "final_ba_failed", _FAILED):
            raise error


def _with_all_steps(found: backend.FinalBa, before: backend.FinalBa) -> backend.FinalBa:
    """An adjustment whose summary has the steps and the time of the one before, too."""
    own, other = found.summary, before.summary
    summary = replace(
        own,
        iterations=own.iterations + other.iterations,
        seconds=own.seconds + other.seconds,
        cpu_seconds=own.cpu_seconds + other.cpu_seconds,
    )
    return replace(found, summary=summary)
