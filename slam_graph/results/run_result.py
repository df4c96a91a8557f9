# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All that a run found out, whole or cut short."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slam_graph.config import RunConfig
from slam_graph.datasets.sequence import SequenceInfo
from slam_graph.errors import EstimationError
from slam_graph.evaluation.truth_pairing import select
from slam_graph.geometry.trajectory import StateHistory, Trajectory
from slam_graph.loop_closure.close_loops import LoopClosures
from slam_graph.maps.map_model import SlamMap
from slam_graph.results.localization_result import LocalizationLog
from slam_graph.results.point_map import PointMap
from slam_graph.results.run_logs import CalibrationLog, InnovationLog, StepLog, TimingLog
from slam_graph.sensors.rig import Rig
from slam_graph.smoothing.final_adjustment import FinalBa

Status = Literal["ok", "interrupted", "not_initialized", "diverged", "low_coverage", "failed"]

TRUTH_MARGIN_NS = 1_000_000_000
"""How much of the ground truth before and after the part that was run is kept."""


@dataclass(eq=False)
class RunResult:
    """What a run found out.

    Attributes:
        info: the recording.
        config: all settings.
        rig: the sensors that were used.
        start_ns, end_ns: times of the first and the last frame that were asked for.
        truth: ground truth of this time, or None.
        status: how the run ended.
        message: why it did not end well; empty if it did.
        error: what ended the run, if something was raised.
        history: the causal estimate of every frame.
        final_ba: the trajectory that comes of the recording as a whole, if one was found.
        loops: what became of places that were seen again, if loops were to be closed.
        slam_map: the map, if it was asked for.
        localization: where the run was in a known map, if it was to be located in one.
        points: the map.
        timing: milliseconds of every stage of every frame.
        steps: Gauss-Newton steps of every frame, and the cost before and after.
        innovations: how far the images of every frame were from what was predicted.
        calibration: estimated parameters of the rig at every frame, where any are estimated.
        frames: number of frames that were read.
        features: sums over all frames of what the front end counts, by name.
        wall_s: time that the run took.
        last_frame_ns: time of the last frame that was read.
        start_was_given: whether the first state came with the data, in the world of the truth.
        warnings: counted faults and rejections.
    """

    info: SequenceInfo
    config: RunConfig
    rig: Rig
    start_ns: int
    end_ns: int
    truth: Trajectory | None = None
    status: Status = "ok"
    message: str = ""
    error: BaseException | None = None
    history: StateHistory = field(default_factory=StateHistory)
    final_ba: FinalBa | None = None
    loops: LoopClosures | None = None
    slam_map: SlamMap | None = None
    localization: LocalizationLog | None = None
    points: PointMap = field(default_factory=PointMap)
    timing: TimingLog = field(default_factory=TimingLog)
    steps: StepLog = field(default_factory=StepLog)
    innovations: InnovationLog = field(default_factory=InnovationLog)
    calibration: CalibrationLog = field(default_factory=CalibrationLog)
    frames: int = 0
    features: Counter[str] = field(default_factory=Counter)
    wall_s: float = 0.0
    last_frame_ns: int | None = None
    start_was_given: bool = False
    warnings: Counter[str] = field(default_factory=Counter)

    @property
    def trajectory(self) -> Trajectory:
        """The causal estimate, `world_T_body` of every frame since initialisation."""
        return self.history.trajectory()

    @property
    def best_trajectory(self) -> Trajectory:
        """The smoothed trajectory if there is one, else the causal one."""
        return self.trajectory if self.final_ba is None else self.final_ba.trajectory

    @property
    def recorded_s(self) -> float:
        """Length of the part that was asked for."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def coverage(self) -> float:
        """Estimated time over the time asked for, from 0 to 1."""
        if len(self.history) == 0:
            return 0.0
        stamps = self.trajectory.stamps_ns
        if self.end_ns <= self.start_ns:
            return 1.0
        return min(float(stamps[-1] - stamps[0]) / (self.end_ns - self.start_ns), 1.0)

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The content of `metrics.json`; computed when it is first asked for."""
        from slam_graph.results.metrics import metrics_table

        return metrics_table(self)

    def count_frame(
        self, stamp_ns: int, milliseconds: Mapping[str, float], frame_stats: Mapping[str, float]
    ) -> None:
        """Note a frame that was worked through: its time, how long it took, what was found."""
        self.frames += 1
        self.last_frame_ns = stamp_ns
        self.timing.append(stamp_ns, milliseconds)
        for name, count in frame_stats.items():
            if not name.endswith("_ms"):
                self.features[name] += int(count)

    def truth_of_run(self) -> Trajectory | None:
        """The ground truth around the part that was asked for."""
        if self.truth is None:
            return None
        stamps = self.truth.stamps_ns
        near = (stamps >= self.start_ns - TRUTH_MARGIN_NS) & (
            stamps <= self.end_ns + TRUTH_MARGIN_NS
        )
        kept = select(self.truth, np.flatnonzero(near))
        return kept if len(kept) else None

    def save(self, folder: Path | str) -> list[Path]:
        """Write all files of the run into a folder.

        Returns:
            The files, in the order in which they were written.
        """
        from slam_graph.results.run_writer import write_run

        return write_run(self, Path(folder))

    def check(self) -> None:
        """Raise what kept the run from ending well, if anything did.

        Raises:
            EstimationError: if it never initialised, diverged, or covered less than was asked.
            KeyboardInterrupt: if it was interrupted.
            BaseException: whatever else ended it.
        """
        if self.error is not None:
            raise self.error
        if self.status != "ok":
            raise EstimationError(self.message)
