# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run: what its recording says about calibration, units and clocks.

A run with a wrong calibration may come to its end, with errors that nothing in it shows. So every
run is followed by a quick diagnosis of the tracks after its start, and one that failed, was not
smooth, or contradicts that, by a full one. If that finds a fault in what the run was given, the run
is `suspect`, whatever it has estimated. A run that does not start is diagnosed while it waits, and
one that goes on 6 and 24 s after its start, after 12 s where 6 s did not rule out what would ruin
it, and at once where its start had to be corrected. After 24 s all frames are there that a
diagnosis takes. Before that an estimate whose images agree with its IMU as in good runs is not
diagnosed, if it learns the noise of the IMU. The time offset between camera and IMU is watched over
the whole run, as it may change later on.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError, EstimationError
from slam_graph.pipeline.clock_watch import ClockWatch
from slam_graph.pipeline.kept_frames import KEPT_NS, KeptFrames
from slam_graph.pipeline.run_doubts import RunDoubts
from slam_graph.pipeline.stage import COMPLETED, EstimatedFrame, NoObjects, Stage, warn_on_failure
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, ImuData, Rig

if TYPE_CHECKING:
    from slam_graph.backend import FinalBa
    from slam_graph.diagnosis import Diagnosis

_FIRST_CHECK_NS = 5_000_000_000
"""A run that has waited so long for a start is diagnosed, and again after twice that."""
_EARLY_CHECKS_NS = (KEPT_NS // 4, KEPT_NS // 2)
"""An estimate that goes on is diagnosed so long after its start, and again after `KEPT_NS`; one
whose start had to be corrected is doubted, and diagnosed at once as well."""
_HINDERING = {"gyroscope_scale": 0.1, "baseline": 0.3}
"""Logarithms of factors from which these keep a run from starting; smaller ones only harm it."""
_RUINING = _HINDERING | {"focal_length": 0.2}
"""Those from which an estimate that goes on is worth nothing."""
_RUINING_DEG = 6.0
"""The same for the error of a camera's mounting, in degrees."""
_FAILED = ("not_initialized", "diverged", "low_coverage")
_WORLD_NOT_CLEAR = (
    "something that moves covers so much of the images that it may have been taken for the world"
)
_FEWEST_SHARED = 0.25
"""An estimate is doubted where the second camera sees a smaller share of the features, if it sees
any: half of them and more where cameras are mounted side by side."""

logger = logging.getLogger(__name__)


_Matters = Callable[[str, Mapping[str, object]], bool]
"""Whether a fault matters, by its kind and its values."""


def _hinders(
    kind: str, values: Mapping[str, object], least: Mapping[str, float] = _HINDERING
) -> bool:
    """Whether the factor of a fault reaches the limit for its kind; true of faults without one."""
    factor = values.get("factor")
    return not isinstance(factor, float) or abs(math.log(factor)) >= least.get(kind, 0.0)


def _ruins(kind: str, values: Mapping[str, object]) -> bool:
    """Whether a fault makes an estimate worth nothing, though it goes on."""
    if kind == "mounting":
        turned = values.get("degrees")
        return isinstance(turned, float) and turned >= _RUINING_DEG
    return kind in _RUINING and _hinders(kind, values, _RUINING)


class Verdict(Stage):
    """Keeps frames around the start of a run, and judges by them whether it can be trusted.

    Args:
        result: of the run; its status and message say the verdict.
        diagnostics: of the run; it counts what goes wrong here, too.
        objects: knows what moves.
    """

    def __init__(
        self, result: RunResult, diagnostics: Diagnostics, objects: NoObjects | None = None
    ) -> None:
        self._result, self._diagnostics = result, diagnostics
        objects = objects or NoObjects()
        self._estimates_objects = type(objects) is not NoObjects
        rig = result.input.rig
        self._has_pairs = len(rig.cameras) > 1
        self._kept = KeptFrames(self._has_pairs, objects)
        self._clocks = ClockWatch(result, objects, diagnostics) if rig.has_imu else None
        self._doubts = RunDoubts(result, diagnostics)
        self._diagnosis: Diagnosis | None = None  # a quick one of all that is kept
        self._diagnosis_failed = False
        self._corrected = 0  # starts that were solved again so far
        self._early_checks_ns: tuple[int, ...] = _EARLY_CHECKS_NS  # those to come
        self._started_ns: int | None = None
        self._waits_since_ns: int | None = None
        self._check_ns = 0  # time of waiting after which the recording is diagnosed next
        config = result.config
        self._refuses = config.limits.refuse_wrong_setup
        self._refuses &= config.backend.initialization.check_calibration

    def frame(self, frame: EstimatedFrame) -> None:
        """Keep a frame, unless there are enough after the start, and watch the clocks.

        Raises:
            DataError: if what the run was given is certainly wrong, so that it cannot start, or its
                estimate is worth nothing.
        """
        stamp_ns = frame.features.stamp_ns
        if self._clocks is not None:
            self._clocks.add(frame)
        if frame.restarted:
            self._doubts.forget()
            self._diagnosis, self._diagnosis_failed = None, False
            corrected = self._diagnostics.counts["start_corrected"]
            self._early_checks_ns = (0,) * (corrected > self._corrected) + _EARLY_CHECKS_NS
            self._corrected = corrected
        self._doubts.add(frame)
        if frame.restarted or not frame.initialized:
            self._started_ns = None
        elif self._started_ns is None:
            self._started_ns = stamp_ns
        elif stamp_ns > self._started_ns + KEPT_NS:
            self._watch_full()
            return
        else:
            self._watch_early(stamp_ns - self._started_ns)
        self._kept.add(frame)
        if frame.initialized:
            self._waits_since_ns = None
        elif self._refuses:
            self._watch_start(stamp_ns, frame.corrected_rig or self._result.input.rig)

    def finish(self) -> None:
        """Say what is wrong, if the run failed or is doubtful, and something shows."""
        status = self._result.status
        failed = status in _FAILED
        if not len(self._kept) or not (failed or status in COMPLETED):
            return
        unusual, contradictions = False, list[str]()
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "evidence is left out"):
            unusual, contradictions = self._contradictions()
        clocks = self._clock_change()
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "the cause is not looked for"):
            if failed or unusual or clocks is not None or self._is_doubtful():
                self._judge(failed, contradictions, clocks)

    def _clock_change(self) -> Diagnosis | None:
        """A change of the time offset; None if there is none, or that cannot be said."""
        if self._clocks is None:
            return None
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "clocks are not compared"):
            found = self._clocks.finish()
            return found if found.findings else None
        return None

    def _contradictions(self) -> tuple[bool, list[str]]:
        """Whether the run by itself is unlike good ones, and what shows if that is beyond doubt.

        Without an IMU motion is a guess, whose errors are not white; and in the world of position
        fixes these tell more of the shift than the causal covariance does.
        """
        from slam_graph.diagnosis import Diagnosis  # it takes a moment to import

        result = self._result
        innovations, measured = result.logs.innovations.columns(), result.input.rig.has_imu
        adjusted = result.final_ba if measured and not result.georeferenced else None
        found = Diagnosis.of_run(
            innovations,
            self._doubts.noise_at_limit,
            result.history,
            None if adjusted is None else adjusted.history,
        )
        result.evidence = asdict(found)
        causes = list(found.causes) if found.contradicts else []
        if adjusted is not None:
            causes = [*self._calibration_faults(adjusted, found.agrees), *causes]
        unclear = self._diagnostics.counts["world_not_clear"] > 0
        if unclear:
            causes.append(_WORLD_NOT_CLEAR)
        return found.is_unusual or bool(causes), causes

    def _calibration_faults(self, adjusted: FinalBa, agrees: bool) -> list[str]:
        """What of the calibration is off by so much that the causal trajectory may be wrong.

        Args:
            adjusted: the adjustment at the end.
            agrees: whether it is as near to the causal trajectory as in good runs.
        """
        latest = self._result.logs.calibration.latest
        estimated = () if latest is None else latest.covariances  # which the run has found itself
        own = self._result.config.algorithm.engine == "square_root"
        return [
            f"{fault.what} (try --set {fault.setting}=true)" if own else fault.what
            for fault in adjusted.calibration_faults
            if fault.variable not in estimated and (fault.harms or not agrees)
        ][:2]

    def _watch_start(self, stamp_ns: int, rig: Rig) -> None:
        """Ask now and then what keeps a run from starting; after a loss at once as well.

        Raises:
            DataError: if what the run was given is certainly wrong.
        """
        lost = bool(self._result.segments.lost)
        if self._waits_since_ns is None:
            losses = self._losses
            # what the loss was is left out only where it is known when it began
            known = lost and not self._result.segments.lasted
            known = known and bool(losses) and stamp_ns - losses[-1][1] < _FIRST_CHECK_NS
            self._waits_since_ns, self._check_ns = stamp_ns, 0 if known else _FIRST_CHECK_NS
        waited_ns = stamp_ns - self._waits_since_ns
        if waited_ns < self._check_ns:
            return
        self._check_ns = max(2 * self._check_ns, _FIRST_CHECK_NS)
        waited = f"no start in {waited_ns * 1e-9:.1f} s"
        if lost:
            waited = f"the estimate was lost{', ' + waited if waited_ns else ''}"
        self._refuse(waited, rig, _ruins if self._result.segments.lasted else _hinders)

    def _watch_early(self, lasted_ns: int) -> None:
        """Ask now and then whether the estimate is worth anything, before all frames are there.

        A diagnosis that rules out what would ruin it is the last one of these (but for the scale of
        the gyroscope, which a quick one does not estimate).

        Raises:
            DataError: if what the run was given is certainly wrong, and by so much.
        """
        if not self._refuses or not self._early_checks_ns or lasted_ns <= self._early_checks_ns[0]:
            return
        if self._early_checks_ns[0] and self._doubts.imu_agrees:
            return
        found = self._quick_diagnosis()
        self._refuse_if_ruined(found)
        limits = {"mounting": _RUINING_DEG, "focal_length": _RUINING["focal_length"]}
        if self._has_pairs:
            limits["baseline"] = _RUINING["baseline"]
        clear = found is not None and found.rules_out(limits)
        later = (ns for ns in self._early_checks_ns if ns >= lasted_ns)
        self._early_checks_ns = () if clear else tuple(later)

    def _watch_full(self) -> None:
        """Ask whether the estimate is worth anything, once all frames for a diagnosis are there.

        Raises:
            DataError: if what the run was given is certainly wrong, and by so much.
        """
        if self._diagnosis is not None or self._diagnosis_failed:
            return
        self._diagnosis = self._quick_diagnosis()
        self._diagnosis_failed = self._diagnosis is None
        if self._refuses:
            self._refuse_if_ruined(self._diagnosis)

    def _quick_diagnosis(self) -> Diagnosis | None:
        """A quick diagnosis of what was recorded so far; None if it failed."""
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "the cause is not looked for"):
            return self._nearby(self._result.estimated_rig)
        return None

    def _refuse_if_ruined(self, found: Diagnosis | None) -> None:
        """Raise DataError if a quick diagnosis shows a fault that makes the estimate worthless."""
        if found is not None and found.setup_faults:
            self._refuse("the estimate is wrong", self._result.estimated_rig, _ruins)

    def _refuse(self, why: str, rig: Rig, matters: _Matters) -> None:
        """Raise DataError if what the run was given is certainly wrong, where that matters."""
        causes = ""
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "the cause is not looked for"):
            causes = self._certain_causes(rig, matters)
        if causes:
            raise DataError(f"{why}: {causes}; see `slam-graph doctor`")

    def _certain_causes(self, rig: Rig, matters: _Matters) -> str:
        """What matters, is certainly wrong, and neither estimated nor corrected in a start."""
        if not rig.cameras[0].rotation_known:
            return ""
        calibration = self._result.config.backend.calibration
        estimated = {
            "time_offset": True,  # a start corrects it
            "mounting": calibration.extrinsics,
            "focal_length": calibration.intrinsics,
        }
        found = self._diagnosed(rig, across_losses=False).certain_errors
        certain = [
            finding
            for finding in found
            if not estimated.get(finding.kind, False) and matters(finding.kind, finding.values)
        ]
        return "; or ".join([f.with_fix for f in certain[:1]] + [f.what for f in certain[1:2]])

    def _judge(self, failed: bool, contradictions: list[str], clocks: Diagnosis | None) -> None:
        """Diagnose what was recorded, under the calibration that the run began or ended with.

        Args:
            failed: whether the run did.
            contradictions: what shows in the run itself, if that is beyond doubt.
            clocks: a change of the time offset, if there is one.
        """
        found = self._diagnosed(self._result.input.rig if failed else self._result.estimated_rig)
        certain = failed or clocks is not None or not found.setup_faults or self._is_confirmed()
        if clocks is not None:
            found = found.with_clocks(clocks)
        ending, guess = self._result.ending, found.best_guess()
        faults = found.setup_faults
        if failed and guess:
            if found.certain_errors:  # what the estimator guesses may contradict it
                guess = found.certain_errors[0].with_fix
                ending.message = ending.message.removesuffix(ending.waiting_for)
            ending.message += f"; slam-graph doctor says: {guess}"
        elif faults and certain and not failed:
            likely = "; or ".join(finding.what for finding in faults[:2])
            self._suspect(f"{likely}; see `slam-graph doctor`")
        elif contradictions and not failed:
            self._suspect("; and ".join(contradictions))
        else:
            return
        ending.error = EstimationError(ending.message)
        logger.error("%s", ending.message)

    def _is_confirmed(self) -> bool:
        """Whether the features that the estimator used show a fault as well, or are too few.

        A board that moves before the camera looks like another mounting, focal length or clock.
        """
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "faults are not confirmed"):
            frames, rig = self._kept.used_frames, self._result.estimated_rig
            used = self._of_tracks(rig, frames, self._kept.imu) if frames else None
            return used is None or bool(used.setup_faults)
        return True

    def _suspect(self, why: str) -> None:
        """Say that the estimate may be wrong, and why."""
        ending = self._result.ending
        ending.status = "suspect"
        ending.message = f"the estimate may be wrong: {why}"

    def _diagnosed(self, rig: Rig, across_losses: bool = True) -> Diagnosis:
        """Diagnose what was recorded.

        Args:
            rig: the calibration.
            across_losses: whether times in which the estimate was lost are taken where too little
                else is left.
        """
        kept, losses = self._kept, self._result.segments.losses
        frames, imu = kept.frames, kept.imu
        if not across_losses:
            frames = [f for f in frames if not any(a < f.stamp_ns < b for a, b in self._losses)]
            good = np.ones(len(imu), bool)
            for begin_ns, end_ns in losses:
                good &= (imu.stamps_ns <= begin_ns) | (imu.stamps_ns >= end_ns)
            imu = ImuData(imu.stamps_ns[good], imu.gyro[good], imu.accel[good])
        return self._of_tracks(rig, frames, imu)

    def _of_tracks(self, rig: Rig, frames: list[FeatureFrame], imu: ImuData) -> Diagnosis:
        from slam_graph.diagnosis import Diagnosis  # it takes a moment to import

        return Diagnosis.of_tracks(rig, frames, imu, self._kept.pairs, self._losses)

    @property
    def _losses(self) -> list[tuple[int, int]]:
        """Times in which the estimate was lost, on the clock of the frames."""
        offset_ns = round(self._result.causal_rig.pose_offset_s * 1e9)
        return [(a - offset_ns, b - offset_ns) for a, b in self._result.segments.losses]

    def _is_doubtful(self) -> bool:
        """Whether something shows that a good recording hardly ever shows."""
        if self._doubts.exist:
            return True
        kept = self._kept
        if kept.pairs and kept.shared < _FEWEST_SHARED:
            return True
        changed = self._estimates_objects or self._result.logs.calibration.latest is not None
        if self._diagnosis is None or changed:  # more is known now of calibration or of what moves
            self._diagnosis = self._nearby(self._result.estimated_rig)
        return bool(self._diagnosis.setup_faults)

    def _nearby(self, rig: Rig) -> Diagnosis:
        """A quick diagnosis of what was recorded."""
        from slam_graph.diagnosis import Diagnosis  # it takes a moment to import

        kept = self._kept
        return Diagnosis.nearby(rig, kept.frames, kept.imu, self._losses)
