# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run that is watched in Rerun while it goes on."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Literal

import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend import Estimator
from slam_graph.geometry import AlignmentMode, StateHistory, Trajectory
from slam_graph.maps import SlamMap
from slam_graph.sensors import CameraFrame, Rig
from slam_graph.visualization.rerun_blueprints import KNOWN_MAP, RIG_M, Eye, Shown, odometry
from slam_graph.visualization.rerun_depth import DepthView
from slam_graph.visualization.rerun_fixes import FixViews
from slam_graph.visualization.rerun_images import CameraViews, ImagesMode
from slam_graph.visualization.rerun_map import MapLog, log_map, places_in_map
from slam_graph.visualization.rerun_objects import ObjectViews
from slam_graph.visualization.rerun_outcome import (
    KEYFRAME_RADIUS,
    POINT_RADIUS,
    FinishedRun,
    OutcomeLog,
)
from slam_graph.visualization.rerun_palette import (
    CAUSAL,
    GREEN,
    PURPLE,
    VERMILLION,
    YELLOW,
)
from slam_graph.visualization.rerun_progress import ShownFrame, StepSeries
from slam_graph.visualization.rerun_series import SeriesLog
from slam_graph.visualization.rerun_states import StateRows
from slam_graph.visualization.rerun_stream import RerunStream
from slam_graph.visualization.rerun_window import show_window

DetailMode = Literal["normal", "graph"]

_KEYFRAME_NS = 500_000_000
"""An image is sent so often where the algorithm has no keyframes."""

_ALIGN_FRAMES = 40
"""The truth is aligned with what there is of the run after so many frames."""


class RerunViewer:
    """Sends a run to Rerun; a `Viewer` of the pipeline.

    Args:
        stream: where it goes.
        images: of which frames images are sent.
        detail: `graph` adds the factor graph of every window and its information.
        known_map: the map that the run is located in, if there is one.
    """

    def __init__(
        self,
        stream: RerunStream,
        images: ImagesMode = "all",
        detail: DetailMode = "normal",
        known_map: SlamMap | None = None,
    ) -> None:
        self._stream, self._images, self._detail = stream, images, detail
        self._known_map = known_map
        self._series = SeriesLog(self._stream)
        self._steps = StepSeries(self._series)
        self._fixes = FixViews(self._stream)
        self._log_handler = _LogHandler(self._stream)
        self._truth: Trajectory | None = None
        self._stamps_ns: list[int] = []  # of the frames
        self._times_ns: list[int] = []  # of the states at them, on their clock
        self._begin("world")

    def _begin(self, world: str) -> None:
        """Begin with an empty world; a run that starts anew is in another one than before."""
        self._world = world
        self._outcome = OutcomeLog(self._stream, world, self._series, self._times_ns)
        self._history = StateHistory()
        self._states = StateRows(self._stream, world)
        self._ids, self._points = np.zeros(0, np.int64), np.zeros((0, 3))
        self._map = MapLog(self._stream, world)
        self._keyframes: set[int] = set()
        self._image_ns: int | None = None
        self._fixes.begin(world)

    def open(self, rig: Rig, truth: Trajectory | None) -> None:
        """Send what does not change, and the layout."""
        logging.getLogger("slam_graph").addHandler(self._log_handler)
        self._truth = truth
        if self._known_map is not None:
            log_map(self._stream, KNOWN_MAP, self._known_map)
        self._set_world(rig)

    def _set_world(self, rig: Rig) -> None:
        rr = self._stream.rr
        self._rig = rig
        self._stream.log(self._world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        brief = self._images == "none"
        self._cameras = CameraViews(self._stream, rig, f"{self._world}/body", brief)
        self._cameras.mount(rig)
        self._depth = DepthView(self._stream, f"{self._world}/depth", rig)
        self._objects = ObjectViews(self._stream, self._world, *self._cameras.first)
        self._outcome.style(f"{self._world}/path/causal", CAUSAL)
        for name, radius in {"features": -2.4, "map/points": POINT_RADIUS, "window": -3.0}.items():
            style = rr.Points3D.from_fields(radii=[radius])
            self._stream.log(f"{self._world}/{name}", style, static=True)
        self._outcome.show_legend()
        self._arrange()

    def _arrange(
        self,
        outcome_plots: frozenset[str] = frozenset(),
        eye: Eye | None = None,
        map_path: FloatArray | None = None,
        spans: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        """Send the layout."""
        plots = outcome_plots | StepSeries.PLOTS
        shown = Shown(
            self._world,
            len(self._rig.cameras),
            plots,
            log=True,
            window=self._detail == "graph",
            in_map=self._known_map is not None,
            map_path=map_path,
            spans=spans or {},
        )
        self._stream.arrange(odometry(shown, eye))

    def show(self, frame: ShownFrame, estimator: Estimator) -> None:
        """Send one frame.

        Args:
            frame: what became of it.
            estimator: after this frame.
        """
        features = frame.features
        number, stamp_ns = len(self._stamps_ns), features.stamp_ns
        time_ns = self._time_of_state(frame)
        self._stamps_ns.append(stamp_ns)
        self._times_ns.append(time_ns)
        self._stream.at(number, stamp_ns)
        if frame.restarted:
            self._states.flush()
            self._map.flush()
            self._begin(f"world_from_{number}")
            self._set_world(frame.corrected_rig or self._rig)
        images = frame.packet.frame
        if isinstance(images, CameraFrame) and self._wants_images(estimator, stamp_ns):
            self._cameras.show_images(images)
            if frame.state is not None and not frame.waits:
                self._depth.show(images, frame.state.world_T_body)
        self._cameras.show_tracks(features, frame.rejected, estimator.dynamic)
        if frame.objects is not None:
            self._objects.show(frame.objects, features)
        self._fixes.show(frame, estimator)
        self._steps.add(number, time_ns, frame, estimator)
        if frame.state is None:
            return
        if not frame.waits:
            ids, points = frame.landmark_ids, frame.landmarks
            self._cameras.show_residuals(features, frame.state, ids, points)
        if not len(self._history) and estimator.rig.has_imu:
            self._outcome.show_gravity(np.asarray(frame.state.world_T_body.translation()))
        self._history.append(frame.state)
        self._states.add(number, time_ns, frame.state)
        self._show_features(frame, estimator)
        self._show_window(estimator)
        if self._detail == "graph":
            show_window(self._stream, estimator)
        if self._truth is not None and number % _ALIGN_FRAMES == 0:
            free = StateHistory(estimator.rig.has_imu, estimator.scaled_camera).free
            alignment: AlignmentMode = "none" if estimator.start_is_given else free
            own, camera = self._history.trajectory(), estimator.scaled_camera
            self._outcome.show_truth(self._truth, own, alignment, camera)

    def _time_of_state(self, frame: ShownFrame) -> int:
        """Time of the state at a new frame, on the clock of the states, which the truth has too."""
        if frame.state is not None and not frame.waits:
            return frame.state.stamp_ns
        offset_ns = round(self._rig.pose_offset_s * 1e9)
        if self._times_ns:  # it may be estimated
            offset_ns = self._times_ns[-1] - self._stamps_ns[-1]
        return frame.features.stamp_ns + offset_ns

    def finish(self, result: FinishedRun) -> None:
        """Send what is known at the end only, and show everything at once."""
        self._series.flush()
        self._states.flush()
        self._stream.at(max(len(self._stamps_ns) - 1, 0), self._stamps_ns[-1])
        self._show_map(np.ones(len(self._ids), np.bool_))
        self._map.flush()
        plots = self._outcome.show(result)
        if not self._keyframes:
            self._outcome.show_keyframes(result)
        best = result.smoothed or result.trajectory
        ways = np.concatenate([best.positions, self._objects.places])
        eye = Eye.on(ways, self._map.points, around=RIG_M)
        self._arrange(plots, eye, places_in_map(result, self._known_map), self._series.spans)

    def close(self) -> None:
        """Send what is left; a saved file appears under its name."""
        logging.getLogger("slam_graph").removeHandler(self._log_handler)
        self._series.flush()
        self._states.flush()
        self._map.flush()
        self._stream.close()

    def _wants_images(self, estimator: Estimator, stamp_ns: int) -> bool:
        """Whether the images of this frame are sent."""
        if self._images != "keyframes":
            return self._images == "all"
        window = estimator.window
        keyframes = set() if window is None else set(window.keyframes)
        if keyframes - self._keyframes:
            self._image_ns = stamp_ns
            return True
        if self._image_ns is None or stamp_ns - self._image_ns >= _KEYFRAME_NS:
            self._image_ns = stamp_ns
            return True
        return False

    def _show_features(self, frame: ShownFrame, estimator: Estimator) -> None:
        """The landmarks of this frame by what they are, and those that left to the map."""
        window, ids, points = estimator.window, frame.landmark_ids, frame.landmarks
        colours = np.tile(np.array(YELLOW, np.uint8), (len(ids), 1))
        if window is not None:
            colours[np.isin(ids, window.state_features)] = GREEN
        colours[np.isin(ids, frame.rejected)] = VERMILLION
        named, kind = f"{self._world}/features", self._stream.rr.Points3D
        self._stream.log_rows(named, kind, positions=points, colors=colours)
        self._show_map(~np.isin(self._ids, ids))
        self._ids, self._points = ids, points

    def _show_map(self, rows: BoolArray) -> None:
        """Add landmarks to the map."""
        self._map.add(len(self._stamps_ns) - 1, self._stamps_ns[-1], self._points[rows])

    def _show_window(self, estimator: Estimator) -> None:
        """The past poses in the state, and new keyframes."""
        window = estimator.window
        if window is None:
            return
        rr, values = self._stream.rr, window.state.frames
        past = [number for number in window.past if values.exists(X(number))]
        poses = np.array([values.atPose3(X(number)).translation() for number in past])
        held = np.array([number in window.keyframes for number in past], np.bool_)
        colours = np.where(held[:, None], np.array(PURPLE), np.full(3, 255)).astype(np.uint8)
        self._stream.log_rows(
            f"{self._world}/window",
            rr.Points3D,
            positions=poses.reshape(-1, 3),
            colors=colours.reshape(-1, 3),
        )
        new = [n for n in past if n in window.keyframes and n not in self._keyframes]
        if new:
            places = [values.atPose3(X(number)).translation() for number in new]
            marks = rr.Points3D(places, colors=PURPLE, radii=KEYFRAME_RADIUS)
            self._stream.log(f"{self._world}/keyframes", marks)
        self._keyframes |= set(window.keyframes)


class _LogHandler(logging.Handler):
    """Sends the log of the package."""

    def __init__(self, stream: RerunStream) -> None:
        super().__init__(logging.INFO)
        self._stream = stream

    def emit(self, record: logging.LogRecord) -> None:
        """Send a line."""
        try:
            text = self._stream.rr.TextLog(self.format(record), level=record.levelname)
            self._stream.log("log", text)
        except Exception:  # a viewer that fails must not end what logs
            self.handleError(record)
