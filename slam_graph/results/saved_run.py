# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The result of a run, read back from its folder."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.config import RunConfig, load_config
from slam_graph.datasets import read_kalibr
from slam_graph.errors import DataError
from slam_graph.geometry import AlignmentMode, Trajectory
from slam_graph.results import result_files as names
from slam_graph.results.frame_table import KEYFRAME, NEES, STATE
from slam_graph.results.map_output import load_map, read_ply
from slam_graph.results.result_files import LATEST, MAP_NAME
from slam_graph.results.run_picture import (
    CAUSAL,
    SMOOTHED,
    PoseEstimate,
    RunView,
    with_path_in_map,
)
from slam_graph.results.run_summary import RunSummary
from slam_graph.results.saved_metrics import fault_of_metrics, read_metrics
from slam_graph.sensors import Rig

if TYPE_CHECKING:
    import gtsam

    from slam_graph.maps import SlamMap


def load_result(folder: Path | str) -> SavedRun:
    """Read back what `RunResult.save` or `slam-graph run` wrote.

    Args:
        folder: of a run, or of the runs of a recording, of which the latest is taken.

    Raises:
        DataError: if there is no result of a run.
    """
    folder = Path(folder)
    for found in (folder, folder / LATEST):
        if (found / names.METRICS).is_file() and (found / names.TRAJECTORY).is_file():
            return SavedRun(found)
    raise DataError(
        f"{folder}: no result of a run here ({names.METRICS} and {names.TRAJECTORY}); "
        "name the folder that `slam-graph run` wrote"
    )


class SavedRun(RunSummary):
    """A result that was saved; each file is read when it is first asked for.

    It has the accessors of `RunResult` as far as the files allow; there are no full covariances.
    An accessor raises `DataError` if its file is missing or damaged.

    Args:
        folder: with the files.

    Attributes:
        folder: with the files.
    """

    fault_of_metrics = staticmethod(fault_of_metrics)

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)

    def __repr__(self) -> str:
        table = self.metrics
        extent = table["extent"]
        return (
            f"SavedRun({table['dataset']['name']}, {table['algorithm']}: {self.status}, "
            f"{extent['estimated_frames']} states of {extent['frames']} frames)"
        )

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The content of `metrics.json`."""
        return read_metrics(self.folder / names.METRICS)

    @property
    def status(self) -> str:
        """How the run ended, in one word."""
        return str(self.metrics["status"])

    @property
    def message(self) -> str:
        """Why the run did not end well; empty if it did."""
        return str(self.metrics["message"])

    @cached_property
    def config(self) -> RunConfig:
        """All settings of the run.

        Raises:
            ConfigError: if this version does not know a setting any more; the message says what
                became of it.
        """
        return load_config(self.folder / names.CONFIG)

    @cached_property
    def rig(self) -> Rig:
        """The sensors that were used, with the calibration from before the run."""
        return read_kalibr(self.folder / names.RIG)

    @cached_property
    def estimated_rig(self) -> Rig:
        """The calibration at the end: as given, corrected at a start, or estimated online."""
        path = self.folder / names.ESTIMATED_RIG
        if not path.is_file():
            return self.rig
        # files of earlier versions have one camera more where depth is measured
        return replace(self.rig, cameras=read_kalibr(path).cameras[: len(self.rig.cameras)])

    @cached_property
    def trajectory(self) -> Trajectory:
        """The causal estimate, with velocities and biases."""
        return self._with_states(names.TRAJECTORY, names.STATES)

    def _with_states(self, path: str, file: str) -> Trajectory:
        """The poses of a file with the velocities and biases of a file of states.

        Raises:
            DataError: if the two are not of the same times, or a state is not finite.
        """
        poses = names.read_tum(self.folder / path)
        stamps, states = names.read_states(self.folder / file)
        if not np.array_equal(stamps, poses.stamps_ns):
            raise DataError(f"{self.folder}: {file} and {path} differ in time")
        parts = [
            _columns(states, part) for part in (names.VELOCITY, names.ACCEL_BIAS, names.GYRO_BIAS)
        ]
        if not np.isfinite(parts).all():
            raise DataError(f"{self.folder / file}: a velocity or bias is not a finite number")
        velocities, accel_biases, gyro_biases = parts
        return replace(
            poses, velocities=velocities, accel_biases=accel_biases, gyro_biases=gyro_biases
        )

    @property
    def sigmas(self) -> FloatArray:
        """(N, 15) standard deviations of the states, in the order of `NavState.covariance`."""
        return _columns(self._states[1], names.SIGMAS)

    @cached_property
    def smoothed(self) -> Trajectory | None:
        """The trajectory of the final bundle adjustment, if there is one."""
        both = (names.SMOOTHED, names.SMOOTHED_STATES)
        if not all((self.folder / name).is_file() for name in both):  # or of an earlier version
            return _trajectory(self.folder, names.SMOOTHED)
        return self._with_states(names.SMOOTHED, names.SMOOTHED_STATES)

    @cached_property
    def smoothed_sigmas(self) -> FloatArray | None:
        """(N, 15) standard deviations of the smoothed states, as `sigmas`, if there are any."""
        path = self.folder / names.SMOOTHED_STATES
        return _columns(names.read_states(path)[1], names.SIGMAS) if path.is_file() else None

    @property
    def best_trajectory(self) -> Trajectory:
        """The smoothed trajectory if there is one, else the causal one."""
        return self.trajectory if self.smoothed is None else self.smoothed

    @cached_property
    def loop_closed(self) -> Trajectory | None:
        """The best trajectory after loop closure, if loops were to be closed."""
        return _trajectory(self.folder, names.LOOP_CLOSED)

    @cached_property
    def loop_ends_ns(self) -> IntArray:
        """(L, 2) times of the two keyframes of each accepted loop closure."""
        path = self.folder / names.LOOPS
        if not path.is_file():
            return np.zeros((0, 2), np.int64)
        table = names.read_table(path, names.LOOP_COLUMNS, "a table of loop closures")
        ends = np.column_stack([table[column] for column in names.LOOP_COLUMNS[:2]])
        return np.asarray(ends[table["accepted"] == 1])

    @property
    def timing(self) -> dict[str, Any]:
        """(F,) milliseconds of each frame by the names of the stages, and `stamp_ns`."""
        path = self.folder / names.TIMING
        if not path.is_file():
            return {}
        table = names.read_table(path, ["stamp_ns"], "the times of a run")
        return {title.removesuffix("_ms"): column for title, column in table.items()}

    @property
    def start_was_given(self) -> bool:
        """Whether the first state came with the data, in the world of the truth."""
        return bool(self.metrics["extent"].get("start_was_given", False))

    @property
    def unmeasured(self) -> AlignmentMode:
        """The alignment that takes away what nothing measured, and no more."""
        # runs of before recordings without an IMU were known do not say it
        mode: AlignmentMode = self.metrics["extent"].get("unmeasured", "yaw")
        return mode

    @cached_property
    def by_frame(self) -> dict[str, Any]:
        """(F,) columns of `frames.csv` by their titles; empty for runs of earlier versions."""
        path = self.folder / names.FRAMES
        if not path.is_file():
            return {}
        return names.read_table(path, ["stamp_ns", KEYFRAME, *NEES], "the frames of a run")

    @property
    def keyframes_ns(self) -> IntArray:
        """(K,) times of the states at the keyframes."""
        table = self.by_frame
        if not table:
            return np.zeros(0, np.int64)
        return np.unique(table.get(STATE, table["stamp_ns"])[table[KEYFRAME] == 1])

    @property
    def nees_series(self) -> tuple[IntArray, FloatArray] | None:
        """Times (K,) and NEES (K, 2) of position and orientation; None without a truth."""
        if not self.by_frame:
            return None
        values = _columns(self.by_frame, NEES)
        known = np.isfinite(values).all(axis=1)
        times_ns = self.by_frame.get(STATE, self.by_frame["stamp_ns"])[known]
        times_ns, rows = np.unique(times_ns, return_index=True)
        return (times_ns, values[known][rows]) if known.any() else None

    @cached_property
    def in_map(self) -> Trajectory | None:
        """Poses in the world of a known map, of the frames where they are known."""
        return _trajectory(self.folder, names.IN_MAP)

    @cached_property
    def groundtruth(self) -> Trajectory | None:
        """The ground truth around the part that was run, if there is one."""
        return _trajectory(self.folder, names.GROUNDTRUTH)

    @cached_property
    def points(self) -> FloatArray:
        """(P, 3) last estimates of the features that were in the state, in the world, m."""
        return read_ply(self.folder / names.POINTS)

    @cached_property
    def slam_map(self) -> SlamMap | None:
        """The map, if one was saved."""
        path = self.folder / MAP_NAME
        return load_map(path) if path.is_file() else None

    @property
    def coverage(self) -> float:
        """Estimated time over the time asked for, from 0 to 1."""
        return float(self.metrics["extent"]["coverage"])

    @property
    def scaled_camera(self) -> gtsam.Pose3 | None:
        """body_T_camera of the camera whose path is known up to a scale; None for metres."""
        unknown = self.metrics["extent"].get("scale") == "unknown"
        return self.rig.cameras[0].body_T_camera if unknown else None

    def _known_map(self) -> SlamMap | None:
        return self.slam_map

    def _view(self) -> RunView:
        estimates = {CAUSAL: PoseEstimate.of_sigmas(self.trajectory, self.sigmas)}
        if self.smoothed is not None:
            sigmas = self.smoothed_sigmas
            if sigmas is None:  # of an earlier version
                sigmas = np.full((len(self.smoothed), len(names.SIGMAS)), np.nan)
            estimates[SMOOTHED] = PoseEstimate.of_sigmas(self.smoothed, sigmas)
        view = RunView(
            estimates,
            self._paths_of_loops(),
            self.groundtruth,
            self.points,
            self.metrics["extent"]["start_ns"] + round(self.rig.pose_offset_s * 1e9),
            (self.metrics["loop_closure"] or {}).get("world_breaks_ns", []),
        )
        if self.scaled_camera is not None and view.truth is not None:
            view = view.at_camera(self.scaled_camera)
        extent = self.metrics["extent"]
        breaks = extent.get("world_breaks_ns", [])
        mode = extent.get("alignment", "none" if self.start_was_given else "yaw")
        if breaks or mode != "none":
            view = view.aligned(mode, breaks)
        return with_path_in_map(view, self.in_map, self.metrics["localization"])

    @cached_property
    def _states(self) -> tuple[IntArray, dict[str, FloatArray]]:
        return names.read_states(self.folder / names.STATES)


def _trajectory(folder: Path, name: str) -> Trajectory | None:
    """A trajectory of a folder, or None if there is none of this name."""
    path = folder / name
    return names.read_tum(path) if path.is_file() else None


def _columns(states: dict[str, FloatArray], columns: tuple[str, ...]) -> FloatArray:
    """Some columns side by side."""
    return np.column_stack([states[column] for column in columns])
