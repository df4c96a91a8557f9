# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All that a run found out, whole or cut short, and its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam_graph import evaluation
from slam_graph.arrays import FloatArray, IntArray
from slam_graph.config import RunConfig
from slam_graph.errors import DataError, EstimationError
from slam_graph.geometry import AlignmentMode, StateHistory, Trajectory
from slam_graph.results import metrics as tables
from slam_graph.results.folders_written import FoldersWritten
from slam_graph.results.localization_result import LocalizationLog
from slam_graph.results.map_output import PointMap
from slam_graph.results.object_files import objects_table
from slam_graph.results.run_input import Ending, RunInput, Status
from slam_graph.results.run_logs import RunLogs
from slam_graph.results.run_picture import (
    CAUSAL,
    SMOOTHED,
    PoseEstimate,
    RunView,
    with_covariances_after_alignment,
    with_path_in_map,
)
from slam_graph.results.run_summary import RunSummary
from slam_graph.results.segments import Segments
from slam_graph.sensors import AidingData, Rig

if TYPE_CHECKING:
    import gtsam

    from slam_graph.backend import FinalBa, MovingObjects, WindowGraph
    from slam_graph.loop_closure import LoopClosures
    from slam_graph.maps import SlamMap

_TRUTH_MARGIN_NS = 1_000_000_000
"""Ground truth is kept from this long before the part that was run to this long after it."""


@dataclass(eq=False, repr=False)
class RunResult(RunSummary):
    """What a run found out.

    The accessors that `SavedRun` has too (`trajectory`, `metrics`, …) say the same of a result
    that was saved and loaded again.

    Attributes:
        input: what was run.
        ending: how it ended.
        history: the causal estimate of every frame, with covariances.
        segments: stretches of it, each from a start to where the estimate was lost.
        start_was_given: whether the first state came with the data, in the world of the truth.
        fix_offset_s: added to the times of the fixes, beyond the given offset.
        fix_calibration: lever arm and clock of the fixes at the end, where they are estimated with
            the states.
        corrected_rig: the calibration with which the run began anew; None if it did not.
        point_map: last estimates of the features that were in the state.
        logs: what was noted at every frame. `Logs` is their class, for a front end alone.
        final_ba: the smoothed trajectory and its summary, if there is one.
        loops: loop closures, if loops were to be closed.
        slam_map: the map, if one was to be built.
        localization: poses in a known map, if there was one.
        objects: moving objects, if they were to be estimated.
        evidence: statistics of how consistent the run is by itself, by name; None if not judged.
        graphs: factor graphs of the back end by the stamps (ns) of their frames, if asked for.
        warnings: counted faults and rejections.
        folders_written: folders that have files of this run, which stay when it is saved again.
    """

    Logs = RunLogs

    input: RunInput
    ending: Ending = field(default_factory=Ending)
    history: StateHistory = field(default_factory=partial(StateHistory, compact=True))
    segments: Segments = field(default_factory=Segments)
    start_was_given: bool = False
    fix_offset_s: float = 0.0
    fix_calibration: AidingData.Calibration | None = None
    corrected_rig: Rig | None = None
    point_map: PointMap = field(default_factory=PointMap)
    logs: RunLogs = field(default_factory=RunLogs)
    final_ba: FinalBa | None = None
    loops: LoopClosures | None = None
    slam_map: SlamMap | None = None
    localization: LocalizationLog | None = None
    objects: MovingObjects | None = None
    evidence: Mapping[str, float | None] | None = None
    graphs: dict[int, WindowGraph] = field(default_factory=dict)
    warnings: Counter[str] = field(default_factory=Counter)
    folders_written: FoldersWritten = field(default_factory=FoldersWritten)

    def __repr__(self) -> str:
        return (
            f"RunResult({self.input.info.name}, {self.config.algorithm.name}: {self.status}, "
            f"{len(self.history)} states of {self.logs.frames} frames)"
        )

    def begin_localization(self, known: SlamMap) -> LocalizationLog:
        """Poses in a map are looked for, too: the table that they go in."""
        self.localization = LocalizationLog(known)
        return self.localization

    def forget_states(self, since_ns: int | None, moved: bool = False) -> None:
        """Take back the states from a time on, and what rests on them: map points, objects, logs.

        Args:
            since_ns: the time; None for all states.
            moved: whether they come back in another world. Objects and poses in a map stay then.
        """
        if since_ns is None:
            self.history, self.point_map = self.history.like(), PointMap()
            since_ns = np.iinfo(np.int64).min
        on_them = () if moved else (self.objects, self.localization)
        for part in (self.history, self.point_map, *on_them):
            if part is not None:
                part.forget_from(since_ns)
        self.logs.forget_states(since_ns)

    @property
    def georeferenced(self) -> bool:
        """Whether the world is that of the position fixes, in all segments."""
        return self.segments.all_of_fixes

    @property
    def in_world_of_truth(self) -> bool:
        """Whether the estimate lives in the world of the truth, so that NEES takes no alignment."""
        if self.georeferenced:
            return self.input.truth_of_fixes
        return self.start_was_given

    @property
    def config(self) -> RunConfig:
        """All settings of the run."""
        return self.input.config

    @property
    def rig(self) -> Rig:
        """The sensors that were used, with the calibration from before the run."""
        return self.input.rig

    @property
    def causal_rig(self) -> Rig:
        """The calibration that the causal estimate was made with, before any online estimate."""
        return self.corrected_rig or self.input.rig

    @property
    def estimated_rig(self) -> Rig:
        """The calibration at the end: as given, corrected at a start, or estimated online."""
        return self.logs.calibration.rig(self.causal_rig)

    @property
    def status(self) -> Status:
        """How the run ended, in one word."""
        return self.ending.status

    @property
    def message(self) -> str:
        """Why the run did not end well; empty if it did."""
        return self.ending.message

    @property
    def trajectory(self) -> Trajectory:
        """The causal estimate, `world_T_body` of every frame since initialisation."""
        return self.history.trajectory()

    @property
    def unmeasured(self) -> AlignmentMode:
        """The alignment that takes away what nothing measured, and no more."""
        return self.history.free

    @property
    def scaled_camera(self) -> gtsam.Pose3 | None:
        """body_T_camera of the camera whose path is known up to a scale; None for metres."""
        return self.history.scaled_camera

    @property
    def sigmas(self) -> FloatArray:
        """(N, 15) standard deviations of the states, in the order of `NavState.covariance`."""
        return self.history.sigmas()

    @property
    def smoothed(self) -> Trajectory | None:
        """The trajectory of the final bundle adjustment, if there is one."""
        return None if self.final_ba is None else self.final_ba.trajectory

    @property
    def smoothed_sigmas(self) -> FloatArray | None:
        """(N, 15) standard deviations of the smoothed states, as `sigmas`, if there are any."""
        return None if self.final_ba is None else self.final_ba.history.sigmas()

    @property
    def best_trajectory(self) -> Trajectory:
        """The smoothed trajectory if there is one, else the causal one."""
        return self.trajectory if self.smoothed is None else self.smoothed

    @property
    def loop_closed(self) -> Trajectory | None:
        """The best trajectory after loop closure, if loops were to be closed."""
        return None if self.loops is None else self.loops.correct(self.best_trajectory)

    @property
    def loop_ends_ns(self) -> IntArray:
        """(L, 2) times of the two keyframes of each accepted loop closure."""
        if self.loops is None:
            return np.zeros((0, 2), np.int64)
        return self.loops.accepted_ns()

    @property
    def _breaks_of_loops_ns(self) -> list[int]:
        """Times between the worlds that are left after loop closure."""
        return self.segments.breaks_ns(self.loop_ends_ns)

    @property
    def keyframes_ns(self) -> IntArray:
        """(K,) times of the states at the keyframes: of the algorithm, loop closure or the map."""
        own = self.logs.by_frame.keyframes_ns
        if len(own):
            return own
        if self.loops is not None:
            return np.array([keyframe.stamp_ns for keyframe in self.loops.keyframes], np.int64)
        if self.slam_map is not None:
            return self.slam_map.trajectory(len(self.slam_map.recordings) - 1).stamps_ns
        return own

    @property
    def nees_series(self) -> tuple[IntArray, FloatArray] | None:
        """Times (K,) and NEES (K, 2) of position and orientation; None without a truth."""
        if self.groundtruth is None or not len(self.history):
            return None
        try:
            aligned, breaks = self.in_world_of_truth, self.segments.breaks_ns()
            found, _ = evaluation.nees_of_run(
                self.groundtruth, self.history, aligned, self.final_ba, breaks
            )
        except DataError:
            return None
        return found.stamps_ns, np.column_stack([found.position, found.orientation])

    @property
    def in_map(self) -> Trajectory | None:
        """Poses in the world of a known map, of the frames where they are known."""
        return None if self.localization is None else self.localization.trajectory()

    @property
    def points(self) -> FloatArray:
        """(P, 3) last estimates of the features that were in the state, in the world, m."""
        return self.point_map.points()

    @cached_property
    def groundtruth(self) -> Trajectory | None:
        """The ground truth around the part that was run, if there is one."""
        truth = self.input.truth
        if truth is None:
            return None
        first, last = self.input.states_ns
        near = truth.stamps_ns >= first - _TRUTH_MARGIN_NS
        near &= truth.stamps_ns <= last + _TRUTH_MARGIN_NS
        if near.all():  # a copy would be kept as long
            return truth if len(truth) else None
        return truth.select(near) if near.any() else None

    @property
    def coverage(self) -> float:
        """Estimated time over the time asked for, from 0 to 1."""
        return tables.coverage(self.input.start_ns, self.input.end_ns, self.segments)

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The content of `metrics.json`; computed when it is first asked for."""
        asked, logs, truth = self.input, self.logs, self.groundtruth
        offset_ns = round(self.causal_rig.pose_offset_s * 1e9)
        extent = tables.extent_table(asked, offset_ns, logs.frames, self.trajectory, self.segments)
        frames = max(logs.frames, 1)
        located, camera = self.localization, self.scaled_camera
        breaks = self.segments.breaks_ns()
        # a start that was given does not define the world of the adjustment
        smoothed_in_it = self.georeferenced and self.in_world_of_truth
        table: dict[str, Any] = tables.finite(
            {
                "schema_version": tables.SCHEMA_VERSION,
                "status": self.status,
                "message": self.message,
                "dataset": asdict(asked.info),
                "algorithm": self.config.algorithm.name,
                "cameras": len(asked.rig.cameras),
                "seed": self.config.seed,
                "world": {
                    "of_fixes": self.georeferenced,
                    "datum": asked.datum,
                    "fix_offset_s": self.fix_offset_s,
                }
                | ({"of_truth": asked.truth_of_fixes} if self.georeferenced else {})
                | ({} if self.fix_calibration is None else self.fix_calibration.table()),
                "extent": extent
                | tables.world_table(
                    self.history, self.start_was_given, self.in_world_of_truth, breaks
                ),
                "segments": tables.segments_table(
                    self.segments, self.trajectory, truth, camera, self.smoothed
                ),
                "accuracy": tables.accuracy_table(truth, self.trajectory, camera, breaks),
                "final_ba": tables.final_ba_table(
                    self.final_ba, truth, breaks, of_truth=smoothed_in_it
                ),
                "loop_closure": tables.loop_closure_table(
                    self.loops, self.loop_closed, truth, camera, self._breaks_of_loops_ns
                ),
                "slam_map": None if self.slam_map is None else self.slam_map.summary(),
                "localization": (
                    None
                    if located is None
                    else located.table(asked.start_ns + offset_ns, logs.frames, asked.truth)
                ),
                "moving_objects": objects_table(self.objects, asked, self.estimated_rig),
                "nees": tables.consistency_table(
                    truth, self.history, self.in_world_of_truth, self.final_ba, breaks
                ),
                "nis": evaluation.innovation_report(logs.innovations.columns()),
                "evidence": self.evidence,
                "calibration": logs.calibration.table(),
                "timing": tables.timing_table(logs, asked.start_ns, self.ending.wall_s),
                "features_per_frame": {
                    name: total / frames for name, total in sorted(logs.features.items())
                },
                "map_points": len(self.point_map),
                "warnings": dict(sorted(self.warnings.items())),
                "peak_memory_mb": tables.peak_memory_mb(),
                "versions": tables.versions(),
            }
        )
        return table

    def check(self) -> None:
        """Raise what kept the run from ending well, if anything did.

        Raises:
            EstimationError: if it never initialised, diverged, covered less than was asked, or
                left no map although it was to.
            KeyboardInterrupt: if it was interrupted.
            BaseException: whatever else ended it.
        """
        if self.ending.error is not None:
            raise self.ending.error
        if self.status != "ok":
            raise EstimationError(self.message)

    def save(self, folder: Path | str) -> list[Path]:
        """Write all files of the run, the trajectory first; each appears whole or not at all.

        Files of another run in the folder are removed before, but a map or a recording that is not
        written anew is kept as `map-earlier.slam` or `recording-earlier.rrd`. Saved again the run
        replaces its own files, and leaves others as they are.

        Args:
            folder: made if it is missing.

        Returns:
            The files, in the order in which they were written.

        Raises:
            DataError: if the folder has a result of another kind, or a file cannot be written.
        """
        from slam_graph.results.run_files import save_run

        return save_run(self, Path(folder))

    def save_so_far(self, folder: Path | str, wall_s: float) -> None:
        """Write the estimate of a run that goes on (`slam_graph/results/snapshot.py`)."""
        from slam_graph.results.snapshot import save_so_far

        save_so_far(self, Path(folder), wall_s)

    def _known_map(self) -> SlamMap | None:
        return self.slam_map

    def _view(self) -> RunView:
        histories = {CAUSAL: self.history}
        if self.final_ba is not None:
            histories[SMOOTHED] = self.final_ba.history
        estimates = {name: PoseEstimate.of_history(found) for name, found in histories.items()}
        loops, truth, began_ns = self._paths_of_loops(), self.groundtruth, self.input.states_ns[0]
        left_ns = self._breaks_of_loops_ns
        view = RunView(estimates, loops, truth, self.points, began_ns, left_ns)
        view = with_covariances_after_alignment(
            view, histories, self.in_world_of_truth, self.final_ba, self.segments.breaks_ns()
        )
        return with_path_in_map(view, self.in_map, self.metrics["localization"])
