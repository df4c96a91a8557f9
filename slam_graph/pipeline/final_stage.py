# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The last stage of a run: its frames are kept on the way, and solved as a whole at the end.

Whatever goes wrong in it is counted as a warning, and the causal result stays as it is.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError, SlamGraphError
from slam_graph.results.run_result import RunResult
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.smoothing.final_adjustment import Report, UndeterminedError, adjust_recording
from slam_graph.smoothing.frame_log import FrameLog

logger = logging.getLogger(__name__)

WORTH_SOLVING = ("ok", "low_coverage", "diverged")
"""Not what was interrupted: who does that does not want to wait."""


class FinalStage:
    """Keeps the frames of a run in a temporary folder; a context manager.

    Args:
        result: of the run; it gets the trajectory.
        diagnostics: counts what goes wrong.
    """

    def __init__(self, result: RunResult, diagnostics: Diagnostics) -> None:
        self._result = result
        self._diagnostics = diagnostics
        self._files, self._recording = ExitStack(), ExitStack()
        self._log: FrameLog | None = None

    def __enter__(self) -> Self:
        config = self._result.config.final_ba
        if config.enabled:
            try:
                folder = self._files.enter_context(TemporaryDirectory(prefix="slam_graph_"))
                recording = FrameLog.recording(self._result.rig, config, Path(folder))
                self._log = self._recording.enter_context(recording)
            except OSError as error:
                self._give_up(error)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._recording.close()
        self._files.close()

    def keep(self, imu: ImuData, frame: FeatureFrame, noise: tuple[float, float]) -> None:
        """Keep a frame with the samples since the one before (see `FrameLog.add`)."""
        if self._log is None:
            return
        try:
            self._log.add(imu, frame, noise)
        except (OSError, SlamGraphError) as error:
            self._give_up(error)

    def finish(self, report: Report) -> None:
        """Solve the recording as a whole, if there is something to begin with.

        Args:
            report: is told of each step.
        """
        result = self._result
        if self._log is not None and len(result.history) and result.status in WORTH_SOLVING:
            try:
                self._recording.close()
                self._solve(self._log, report)
            except UndeterminedError as reason:
                logger.info("no final bundle adjustment: %s", reason)
            except (RuntimeError, np.linalg.LinAlgError, SlamGraphError, OSError) as error:
                self._give_up(error)
            except KeyboardInterrupt:
                self._give_up(EstimationError("interrupted"))
            except Exception as error:
                logger.exception("internal error")
                self._give_up(error)
        result.warnings = +self._diagnostics.counts

    def _solve(self, log: FrameLog, report: Report) -> None:
        result = self._result
        latest = result.calibration.latest
        result.final_ba = adjust_recording(
            log,
            result.trajectory,
            result.rig if latest is None else latest.rig,
            result.config.backend,
            result.config.final_ba,
            report,
        )
        summary = result.final_ba.summary
        logger.info(
            "final bundle adjustment: %d keyframes, %d features, %d steps in %.1f s",
            summary.keyframes,
            summary.features,
            summary.iterations,
            summary.seconds,
        )

    def _give_up(self, error: Exception) -> None:
        self._log = None
        reason = " ".join(str(error).split())[:200]
        self._diagnostics.warn("final_ba_failed", f"only the causal estimate is left: {reason}")
