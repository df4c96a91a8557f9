# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run: what its first seconds say about sensors and calibration.

A run with a wrong calibration may come to its end, with errors that nothing in it shows. So a run
that failed, or was not smooth, is followed by a diagnosis of the tracks around its start. If that
finds an error in what the run was given, the run is `suspect`, whatever it has estimated.
"""

from __future__ import annotations

import logging
from collections import deque

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.pipeline.stage import COMPLETED, EstimatedFrame, Stage, warn_on_failure
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, ImuData, Rig

_KEPT_NS, _AFTER_START_NS = 10_000_000_000, 8_000_000_000
"""So much of the recording is looked at, most of it after the start: that takes 2 s of work."""
_FAILED = ("not_initialized", "diverged", "low_coverage")
_DOUBTS = ("start_corrected", "new_segment", "scale_unknown")
"""Warnings after which an estimate that came to its end is doubted."""
_MAX_REJECTED = 0.05
"""The same for the share of features that the gate rejects. Of good recordings it is 2 to 4 %."""

logger = logging.getLogger(__name__)


class Verdict(Stage):
    """Keeps the frames around the start of a run, and judges by them whether it can be trusted.

    Args:
        result: of the run; its status and message say the verdict.
        diagnostics: of the run; it counts what goes wrong here, too.
    """

    def __init__(self, result: RunResult, diagnostics: Diagnostics) -> None:
        self._result, self._diagnostics = result, diagnostics
        self._kept: deque[tuple[FeatureFrame, ImuData]] = deque()
        self._started_ns: int | None = None

    def frame(self, frame: EstimatedFrame) -> None:
        """Keep a frame, unless there are enough after the start."""
        stamp_ns = frame.features.stamp_ns
        if frame.restarted or not frame.initialized:
            self._started_ns = None
        elif self._started_ns is None:
            self._started_ns = stamp_ns
        elif stamp_ns > self._started_ns + _AFTER_START_NS:
            return
        self._kept.append((frame.features, frame.imu))
        while self._kept[0][0].stamp_ns < stamp_ns - _KEPT_NS:
            self._kept.popleft()

    def finish(self) -> None:
        """Say what is wrong, if the run failed or is doubtful, and something shows."""
        status = self._result.status
        failed = status in _FAILED
        if not self._kept or not (failed or (status in COMPLETED and self._is_doubtful())):
            return
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "the cause is not looked for"):
            self._judge(failed)

    def _judge(self, failed: bool) -> None:
        """Diagnose what was recorded, under the calibration that the run began or ended with."""
        from slam_graph.diagnosis import Diagnosis  # runs that end well do not need it

        frames = [frame for frame, _ in self._kept]
        imu = ImuData.concatenate([samples for _, samples in self._kept])
        rig = self._result.input.rig if failed else self._final_rig()
        found = Diagnosis.of_tracks(rig, frames, imu)
        ending, guess = self._result.ending, found.best_guess()
        if failed and guess:
            ending.message += f"; slam-graph doctor says: {guess}"
        elif found.errors:
            likely = "; or ".join(finding.what for finding in found.errors[:2])
            ending.status = "suspect"
            ending.message = f"the estimate may be wrong: {likely}; see `slam-graph doctor`"
        else:
            return
        ending.error = EstimationError(ending.message)
        logger.error("%s", ending.message)

    def _final_rig(self) -> Rig:
        """The rig as calibrated, corrected or estimated, whichever came last."""
        latest = self._result.logs.calibration.latest
        return self._result.causal_rig if latest is None else latest.rig

    def _is_doubtful(self) -> bool:
        """Whether something happened that a good recording hardly ever shows."""
        counts, tested = self._diagnostics.counts, self._result.logs.innovations.columns()
        rejected = float(tested["rejected"].sum()) / max(float(tested["tested"].sum()), 1.0)
        return rejected > _MAX_REJECTED or any(counts[kind] for kind in _DOUBTS)
