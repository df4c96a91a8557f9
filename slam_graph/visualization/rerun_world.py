# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Saved runs and recordings in Rerun, from what their files hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend import BackendConfig
from slam_graph.datasets import Sequence
from slam_graph.errors import DataError
from slam_graph.maps import SlamMap
from slam_graph.sensors import AidingData, CameraFrame, FeatureFrame, Packet, Rig
from slam_graph.visualization.rerun_blueprints import (
    KNOWN_MAP,
    RIG_M,
    SQUARE,
    WIDE,
    Eye,
    Shown,
    odometry,
)
from slam_graph.visualization.rerun_depth import DepthView
from slam_graph.visualization.rerun_fixes import FixLog, KnownPoseLog
from slam_graph.visualization.rerun_images import CameraViews
from slam_graph.visualization.rerun_map import log_map, places_in_map
from slam_graph.visualization.rerun_outcome import FinishedRun, OutcomeLog
from slam_graph.visualization.rerun_palette import TRUTH
from slam_graph.visualization.rerun_progress import add_imu, nis_rows
from slam_graph.visualization.rerun_series import SeriesLog
from slam_graph.visualization.rerun_stream import RerunStream

_FRUSTUM_PART, _FRUSTUM_M = 0.05, (0.04, 0.25)
"""Length of the cameras' frusta as a part of the extent of the flight, and its bounds, m."""

_IMU_PLOTS = frozenset({"imu/gyro", "imu/accel"})


@dataclass(frozen=True, eq=False)
class SavedDetails:
    """What the files of a run hold beside its trajectories.

    Attributes:
        rig: the sensors.
        points: (P, 3) the map of the run, m.
        timing: (F,) milliseconds of stages by their names, and `stamp_ns`.
        by_frame: (F,) columns of `frames.csv` by their titles; empty if there is none.
        log: lines.
        known_map: the map that the run was located in, if it is at hand.
        recording: that was run, if its images or tracks and IMU samples are to be shown.
        images: whether images of the recording are shown.
        aiding: settings by which the run used position fixes and known poses, if its world is
            theirs; else they are not shown.
    """

    rig: Rig | None
    points: FloatArray
    timing: Mapping[str, FloatArray]
    by_frame: Mapping[str, Any]
    log: Iterable[str] = ()
    known_map: SlamMap | None = None
    recording: Sequence | None = None
    images: bool = True
    aiding: BackendConfig | None = None


def show_saved_run(stream: RerunStream, run: FinishedRun, details: SavedDetails) -> None:
    """Log a run from its files: what a run that is watched shows, but single features.

    Raises:
        DataError: if the recording that is given with it is another one.
    """
    series = SeriesLog(stream)
    stamps_ns = np.asarray(details.timing.get("stamp_ns", run.trajectory.stamps_ns), np.int64)
    times_ns = np.asarray(details.by_frame.get("state_ns", stamps_ns), np.int64)
    outcome = OutcomeLog(stream, "world", series, times_ns.tolist())
    stream.log("world", stream.rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    plots = outcome.show_states(run) | outcome.show(run)
    outcome.show_points(details.points)
    outcome.show_keyframes(run)
    outcome.show_legend()
    if len(run.trajectory) and (details.rig is None or details.rig.has_imu):
        outcome.show_gravity(run.trajectory.positions[0])
    plots |= _show_timing(series, stamps_ns, details.timing)
    plots |= _show_frames(series, details.by_frame)
    cameras = 0
    if details.rig is not None:
        views = CameraViews(stream, details.rig, "world/body")
        views.mount(details.rig)
        if details.recording is not None:
            plots |= _show_inputs(stream, series, views, details, stamps_ns)
            cameras = _cameras_shown(details.recording, details.images)
    if details.known_map is not None:
        log_map(stream, KNOWN_MAP, details.known_map)
    lines = list(details.log)
    if lines and len(stamps_ns):
        stream.at(len(stamps_ns) - 1, int(stamps_ns[-1]))
        for line in lines:
            level = next((word for word in ("ERROR", "WARNING") if f" {word} " in line), "INFO")
            stream.log("log", stream.rr.TextLog(line.rstrip(), level=level))
    best = run.smoothed or run.trajectory
    shown = Shown(
        cameras=cameras,
        plots=plots,
        log=bool(lines),
        in_map=run.in_map is not None,
        map_path=places_in_map(run, details.known_map),
        spans=series.spans,
    )
    aspect = WIDE if cameras else SQUARE
    stream.arrange(odometry(shown, Eye.on(best.positions, details.points, aspect, RIG_M)))


def _show_timing(
    series: SeriesLog, stamps_ns: IntArray, timing: Mapping[str, FloatArray]
) -> frozenset[str]:
    plots = {
        "backend/milliseconds": ("read", "frontend", "backend"),
        "backend/stages": (
            *("backend.propagation", "backend.cost"),
            *("backend.gauss_newton", "backend.marginalization"),
        ),
    }
    shown = set()
    for entity, stages in plots.items():
        if not any(stage in timing for stage in stages):
            continue
        nothing = np.full(len(stamps_ns), np.nan)
        values = np.column_stack([timing.get(stage, nothing) for stage in stages])
        series.send(entity, np.arange(len(stamps_ns)), stamps_ns, values)
        shown.add(entity)
    return frozenset(shown)


_COUNTS = ("tracked", "tracked_other_cameras", "estimated", "poses_in_state")
_REJECTED = ("rejected_ransac", "rejected_gate", "rejected_stereo")
_NIS = ("nis", "nis_dof", "nis_expected")
"""Columns of `frames.csv` (`results/frame_table.py`), in the order of the plots."""


def _show_frames(series: SeriesLog, table: Mapping[str, Any]) -> frozenset[str]:
    """Counts, rejections, cost and NIS of each frame."""
    if not table:
        return frozenset()
    # on the clock of the states, as what else is shown of them
    stamps_ns = np.asarray(table.get("state_ns", table["stamp_ns"]), np.int64)
    numbers = np.arange(len(stamps_ns))
    plots = {
        "backend/counts": _COUNTS,
        "backend/rejected": _REJECTED,
        "backend/cost": [name for name in table if name.startswith("cost_")],
    }
    shown = set()
    for entity, columns in plots.items():
        if not columns or any(name not in table for name in columns):
            continue
        values = np.column_stack([table[name] for name in columns])
        rows = np.isfinite(values).any(axis=1)
        series.send(entity, numbers[rows], stamps_ns[rows], values[rows])
        shown.add(entity)
    if all(name in table for name in _NIS):
        distance, dof, expected = (table[name] for name in _NIS)
        rows = dof > 0
        if rows.any():
            values, bounds = nis_rows(distance[rows], dof[rows], expected[rows])
            series.send("consistency/nis", numbers[rows], stamps_ns[rows], values)
            series.send("consistency/nis/bounds", numbers[rows], stamps_ns[rows], bounds)
            shown.add("consistency/nis")
    return frozenset(shown)


def _show_inputs(
    stream: RerunStream,
    series: SeriesLog,
    cameras: CameraViews,
    details: SavedDetails,
    stamps_ns: IntArray,
) -> frozenset[str]:
    """Images or tracks, and IMU samples, of the frames (F,) of a run.

    Raises:
        DataError: if the recording has none of these frames.
    """
    assert details.recording is not None
    inputs = _Inputs(stream, series, cameras, details.recording.rig, details.images, details.aiding)
    numbers, shown = {stamp_ns: k for k, stamp_ns in enumerate(stamps_ns.tolist())}, 0
    for packet in details.recording.packets():
        number = numbers.get(packet.frame.stamp_ns)
        if number is None:
            continue
        shown += 1
        inputs.show(number, packet)
    series.flush()
    if not shown:
        name = details.recording.info().name
        raise DataError(f"{name}: has none of the frames of the run; it is another recording")
    return _plots_of(details.recording)


def _plots_of(recording: Sequence) -> frozenset[str]:
    """Entities of the plots of what a recording has beside its frames."""
    return _IMU_PLOTS if recording.rig.has_imu else frozenset()


def _cameras_shown(recording: Sequence, images: bool) -> int:
    """Number of cameras of a recording of which anything is shown."""
    return len(recording.rig.cameras) if images or recording.info().content != "images" else 0


class _Inputs:
    """Logs the frames of a recording, and the IMU samples before each.

    Args:
        stream: where to.
        series: of the plots.
        cameras: of the world.
        rig: of the recording.
        images: whether images and depth are sent.
        aiding: as for `SavedDetails`.

    Attributes:
        depth: where depth images go.
    """

    def __init__(
        self,
        stream: RerunStream,
        series: SeriesLog,
        cameras: CameraViews,
        rig: Rig,
        images: bool,
        aiding: BackendConfig | None = None,
    ) -> None:
        self._fixes, self._poses = FixLog(stream, "world"), KnownPoseLog(stream, "world")
        self._aiding, self._waiting = aiding, AidingData.empty()
        self._stream, self._series, self._cameras = stream, series, cameras
        self.depth, self._images = DepthView(stream, "world/body/depth", rig), images

    def show(self, number: int, packet: Packet) -> None:
        """Log a frame by its number."""
        none = np.zeros(0, np.int64)
        self._stream.at(number, packet.frame.stamp_ns)
        if isinstance(packet.frame, CameraFrame) and self._images:
            self._cameras.show_images(packet.frame)
            self.depth.show(packet.frame)
        elif isinstance(packet.frame, FeatureFrame):
            self._cameras.show_tracks(packet.frame, none, none)
        if self._aiding is not None:
            data = packet.aiding or AidingData.empty()
            self._show_aiding(data, self._aiding, packet.frame.stamp_ns)
        add_imu(self._series, number, packet)

    def _show_aiding(self, data: AidingData, config: BackendConfig, until_ns: int) -> None:
        """Log the fixes and known poses that were used up to a frame."""
        later = config.on_the_clock(data.without_odometry())
        waiting = AidingData.concatenate([self._waiting, later])
        due, self._waiting = waiting.within(None, until_ns), waiting.within(until_ns, None)
        # files do not say which were rejected
        fixes, poses = len(due.fix_stamps_ns), len(due.pose_stamps_ns)
        self._fixes.add(due.fix_positions, due.fix_covariances, np.zeros(fixes, np.bool_))
        self._poses.add(due, np.zeros(poses, np.bool_))


def show_recording(stream: RerunStream, sequence: Sequence, images: bool = True) -> None:
    """Log a recording as it is: images or tracks, IMU, ground truth.

    Args:
        stream: where it goes.
        sequence: the recording.
        images: whether images are sent.
    """
    series, rr = SeriesLog(stream), stream.rr
    truth = sequence.groundtruth()
    cameras = CameraViews(stream, sequence.rig, "world/body")
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    inputs = _Inputs(stream, series, cameras, sequence.rig, images)
    stamps_ns: list[int] = []
    for number, packet in enumerate(sequence.packets()):
        stamps_ns.append(packet.frame.stamp_ns)
        inputs.show(number, packet)
    series.flush()
    eye, frustum_m = None, _FRUSTUM_M[1]
    outcome = OutcomeLog(stream, "world", series, stamps_ns)
    outcome.show_legend()
    if truth is not None and stamps_ns:
        near = (truth.stamps_ns >= stamps_ns[0]) & (truth.stamps_ns <= stamps_ns[-1])
        truth = truth.select(near)
        outcome.path("path/groundtruth", truth, TRUTH)
        columns = rr.Transform3D.columns(translation=truth.positions, quaternion=truth.quaternions)
        stream.send_columns("world/body", outcome.frames(truth.stamps_ns), truth.stamps_ns, columns)
        if len(truth):
            extent_m = float(np.linalg.norm(np.ptp(truth.positions, axis=0)))
            frustum_m = float(np.clip(_FRUSTUM_PART * extent_m, *_FRUSTUM_M))
        eye = Eye.on(truth.positions, around=max(RIG_M, inputs.depth.far_m))
    cameras.mount(sequence.rig, frustum_m)
    plots = _plots_of(sequence)
    shown = Shown(cameras=_cameras_shown(sequence, images), plots=plots, title="Recording")
    stream.arrange(odometry(shown, eye))
