# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run has found out, in Rerun: paths, map, loop closures, states and errors over time.

It takes what the files of a result hold, so that a run that was not watched can be seen as well.
"""

from __future__ import annotations

from typing import Any, Protocol

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend import BackendConfig
from slam_graph.errors import DataError
from slam_graph.evaluation import mean_bounds
from slam_graph.geometry import AlignmentMode, Similarity, Trajectory
from slam_graph.sensors import Rig
from slam_graph.visualization.rerun_palette import (
    CAUSAL,
    IN_MAP,
    LIGHT_GREY,
    LOOP,
    PURPLE,
    SMOOTHED,
    TRUTH,
    Colour,
    by_height,
)
from slam_graph.visualization.rerun_series import SeriesLog, three_sigma
from slam_graph.visualization.rerun_states import style_ellipsoids
from slam_graph.visualization.rerun_stream import RerunStream
from slam_graph.visualization.rerun_truth import JudgedRun, placed_truth

PATH_RADII = {CAUSAL: -2.0, SMOOTHED: -1.1, LOOP: -1.6, TRUTH: -0.7, IN_MAP: -2.6}
"""Of paths, negative: in pixels of the screen. They differ, as paths lie on one another."""

POINT_RADIUS, KEYFRAME_RADIUS, END_RADIUS = -1.3, -3.2, -6.0
"""Of points of maps, keyframes (they lie on paths), and ends of loop closures, in pixels."""

_TRUTH_POINTS = 2000
"""At most so many points of the true path are drawn."""

LEGEND = """\
# What is shown

**Space.** Light blue: causal path. Red: smoothed path. Light grey: ground truth, aligned in what
nothing measured (with an IMU yaw and position; without one rotation and position; with one camera
alone scale, too) over the whole run, or over each of its worlds. Small points: the map, coloured by
height (dark blue is low, yellow is high). Larger points are features of this frame: green, in the
state; yellow, used in this step; red, rejected by the gate. White points: past poses in the
window; purple: keyframes of the algorithm or, where it has none, of loop closure or of the map, at
the end of the run. Green: loop closures, large points at their ends, and the path after them. The
arrow at the start is gravity.
Ellipsoids at the body: 1σ and 3σ of its position. A dense cloud is the last depth image, coloured
by depth. Orange points with ellipsoids (1σ) are position fixes, with axes known poses; red,
rejected by the gate.

**Moving objects.** Each has a colour of its own: points, trail, arrow of its velocity, and in the
first camera its features and the region around them, with its number. Purple: what moves and is of
no object. Other features there go from green (static) to grey (it may move).

**Cameras.** Tails are the last 12 places of a feature; dark is young, yellow is old. Points: green,
tracked; yellow, new; light blue, seen by another camera too; red, rejected by the gate; orange,
rejected by RANSAC; purple, moves by itself. White points: landmarks projected into the image; red
lines: their residuals, ten times as long.

**Plots.** x red, y green, z light blue, thin lines ±3σ. Errors are in the axes of
the body, in metres; with one camera alone those of the camera, in its axes.
"""


class RunSettings(Protocol):
    """The part of the settings of a run that is needed here."""

    @property
    def backend(self) -> BackendConfig:
        """Settings of the back end."""
        ...


class FinishedRun(Protocol):
    """What is known at the end of a run: `RunResult`, or `SavedRun`."""

    @property
    def config(self) -> RunSettings:
        """Its settings."""
        ...

    @property
    def rig(self) -> Rig:
        """The sensors."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """The causal estimate."""
        ...

    @property
    def sigmas(self) -> FloatArray:
        """(N, 15) standard deviations, in the order of `NavState.COMPONENTS`."""
        ...

    @property
    def smoothed(self) -> Trajectory | None:
        """The trajectory of the final bundle adjustment."""
        ...

    @property
    def groundtruth(self) -> Trajectory | None:
        """The true path."""
        ...

    @property
    def metrics(self) -> dict[str, Any]:
        """What `metrics.json` has."""
        ...

    @property
    def loop_closed(self) -> Trajectory | None:
        """The trajectory after loop closure."""
        ...

    @property
    def loop_ends_ns(self) -> IntArray:
        """(L, 2) times of the ends of accepted loop closures."""
        ...

    @property
    def keyframes_ns(self) -> IntArray:
        """(K,) times of keyframes."""
        ...

    @property
    def in_map(self) -> Trajectory | None:
        """Poses in a known map."""
        ...

    @property
    def nees_series(self) -> tuple[IntArray, FloatArray] | None:
        """Times (K,), and NEES (K, 2) of position and orientation."""
        ...


class OutcomeLog:
    """Logs what is known at the end of a run.

    Args:
        stream: where it goes.
        world: entity of the world of the run.
        series: of the plots.
        times_ns: of the states at all frames, on their clock, by which rows get the numbers of
            their frames.
    """

    def __init__(
        self, stream: RerunStream, world: str, series: SeriesLog, times_ns: list[int]
    ) -> None:
        self._stream, self._world, self._series = stream, world, series
        self._times_ns = times_ns
        self._truth_sent = False

    def show(self, run: FinishedRun) -> frozenset[str]:
        """Log everything but the causal states.

        Returns:
            Entities of the plots that have values.
        """
        if run.smoothed is not None:
            self.path("path/smoothed", run.smoothed, SMOOTHED)
        self._show_loops(run)
        if run.in_map is not None:
            self.path("/known_map/path", run.in_map, IN_MAP)
        plots = {"error/position", "error/orientation"} if self._show_errors(run) else set()
        nees = run.nees_series
        if nees is not None and len(nees[0]):
            self._show_nees(*nees)
            plots.add("consistency/nees")
        return frozenset(plots)

    def show_states(self, run: FinishedRun) -> frozenset[str]:
        """Log the causal states, as a run that is watched logs them one by one.

        Returns:
            Entities of the plots that have values.
        """
        causal, rr = run.trajectory, self._stream.rr
        frames = self.frames(causal.stamps_ns)
        body = f"{self._world}/body"
        self.path("path/causal", causal, CAUSAL)
        columns = rr.Transform3D.columns(
            translation=causal.positions, quaternion=causal.quaternions
        )
        self._stream.send_columns(body, frames, causal.stamps_ns, columns)
        self._show_ellipsoids(frames, causal.stamps_ns, run.sigmas[:, 3:6])
        rows: dict[str, tuple[FloatArray | None, FloatArray | None]] = {
            "state/velocity": (causal.velocities, None),
            "state/accel_bias": (causal.accel_biases, run.sigmas[:, 9:12]),
            "state/gyro_bias": (causal.gyro_biases, run.sigmas[:, 12:15]),
        }
        shown = set()
        for entity, (values, sigmas) in rows.items():
            if values is None:
                continue
            shown.add(entity)
            self._series.send(entity, frames, causal.stamps_ns, values)
            if sigmas is not None:
                bounds = three_sigma(values, sigmas)
                self._series.send(f"{entity}/bounds", frames, causal.stamps_ns, bounds)
        return frozenset(shown)

    def frames(self, times_ns: IntArray) -> IntArray:
        """(N,) numbers of the last frames whose states are at or before some times."""
        found = np.searchsorted(self._times_ns, times_ns, "right") - 1
        return np.asarray(np.maximum(found, 0), np.int64)

    def path(self, entity: str, trajectory: Trajectory, colour: Colour) -> None:
        """Log a path that grows: one entity with a piece for each frame."""
        if len(trajectory) < 2:
            return
        rr, positions = self._stream.rr, trajectory.positions
        pieces = np.stack([positions[:-1], positions[1:]], axis=1)
        stamps_ns = trajectory.stamps_ns[1:]
        name = entity.removeprefix("/") if entity.startswith("/") else f"{self._world}/{entity}"
        self.style(name, colour)
        columns = rr.LineStrips3D.columns(strips=list(pieces))
        self._stream.send_columns(name, self.frames(stamps_ns), stamps_ns, columns)

    def style(self, entity: str, colour: Colour) -> None:
        """Say how the pieces of a path look; each piece has its points only."""
        lines = self._stream.rr.LineStrips3D.from_fields(
            colors=[colour], radii=[PATH_RADII[colour]]
        )
        self._stream.log(entity, lines, static=True)

    def show_truth(
        self,
        truth: Trajectory,
        estimate: Trajectory,
        alignment: AlignmentMode,
        camera: gtsam.Pose3 | None = None,
    ) -> None:
        """Log the true path in the world of the estimate, fitted over what both share.

        Args:
            truth: of the body.
            estimate: of the body.
            alignment: of the two.
            camera: body_T_camera of the camera whose path is known up to a scale, by which they are
                aligned then.
        """
        fitted = (estimate, truth)
        if camera is not None:
            fitted = (estimate.mounted(camera), truth.mounted(camera))
        try:
            onto = placed_truth(*fitted, alignment)
        except DataError:
            return
        if not self._truth_sent and len(truth):
            self._truth_sent = True
            self._send_truth([truth.positions])
        self._place_truth(onto)

    def _send_truth(self, paths: list[FloatArray]) -> None:
        """Log true paths, each (M, 3)."""
        step = -(-sum(map(len, paths)) // _TRUTH_POINTS)
        thinned = [path[::step] for path in paths if len(path)]
        line = self._stream.rr.LineStrips3D(thinned, colors=TRUTH, radii=PATH_RADII[TRUTH])
        self._stream.log(f"{self._world}/path/groundtruth", line, static=True)

    def _place_truth(self, onto: Similarity) -> None:
        """Log where the true paths are in the world of the estimate."""
        matrix = onto.scale * onto.rotation
        placed = self._stream.rr.Transform3D(translation=onto.translation, mat3x3=matrix)
        self._stream.log(f"{self._world}/path/groundtruth", placed, static=True)

    def show_gravity(self, position: FloatArray) -> None:
        """Log the direction of gravity at the start of the path."""
        arrow = self._stream.rr.Arrows3D(
            vectors=[[0.0, 0.0, -0.6]],
            origins=[position],
            colors=LIGHT_GREY,
            radii=-1.5,
            labels=["gravity"],
            show_labels=True,
        )
        self._stream.log(f"{self._world}/gravity", arrow, static=True)

    def show_points(self, points: FloatArray) -> None:
        """Log a map whose points are known only as they are at the end."""
        cloud = self._stream.rr.Points3D(points, colors=by_height(points), radii=POINT_RADIUS)
        self._stream.log(f"{self._world}/map/points", cloud, static=True)

    def show_keyframes(self, run: FinishedRun) -> None:
        """Log the places of the keyframes, each from its time on."""
        best = run.trajectory if run.smoothed is None else run.smoothed
        stamps_ns = run.keyframes_ns
        if not len(best) or not len(stamps_ns):
            return
        rr, entity = self._stream.rr, f"{self._world}/keyframes"
        style = rr.Points3D.from_fields(colors=[PURPLE], radii=[KEYFRAME_RADIUS])
        self._stream.log(entity, style, static=True)
        rows = np.clip(np.searchsorted(best.stamps_ns, stamps_ns), 0, len(best) - 1)
        columns = rr.Points3D.columns(positions=best.positions[rows])
        self._stream.send_columns(entity, self.frames(stamps_ns), stamps_ns, columns)

    def _show_ellipsoids(self, frames: IntArray, stamps_ns: IntArray, sigmas: FloatArray) -> None:
        """1σ and 3σ of the position (N, 3) along the axes of the body: files have no covariances.

        States without standard deviations have none.
        """
        known = np.isfinite(sigmas).all(axis=1)
        entity = f"{self._world}/body/position_sigma"
        style_ellipsoids(self._stream, entity)
        sizes = np.stack([sigmas[known], 3 * sigmas[known]], axis=1)
        columns = self._stream.rr.Ellipsoids3D.columns(half_sizes=sizes.reshape(-1, 3))
        lengths = [2] * len(sizes)
        self._stream.send_columns(
            entity, frames[known], stamps_ns[known], columns.partition(lengths)
        )

    def show_legend(self) -> None:
        """Log what the colours mean."""
        text = self._stream.rr.TextDocument(LEGEND, media_type="text/markdown")
        self._stream.log("legend", text, static=True)

    def _show_loops(self, run: FinishedRun) -> None:
        """The loop-closed path, and lines between the places that were recognised."""
        closed, loops_ns = run.loop_closed, run.loop_ends_ns
        if closed is None:
            return
        self.path("path/loop_closed", closed, LOOP)
        if len(loops_ns) == 0 or len(closed) == 0:
            return
        rows = np.clip(np.searchsorted(closed.stamps_ns, loops_ns), 0, len(closed) - 1)
        rr, ends, entity = self._stream.rr, closed.positions[rows], f"{self._world}/loop_closures"
        self._stream.log(entity, rr.LineStrips3D(ends, colors=LOOP, radii=-1.2), static=True)
        # both ends are at one place: the line between them alone would hardly be seen
        marks = rr.Points3D(ends.reshape(-1, 3), colors=LOOP, radii=END_RADIUS)
        self._stream.log(f"{entity}/ends", marks, static=True)

    def _show_errors(self, run: FinishedRun) -> bool:
        """The true path and the errors of the causal estimate; False without a truth."""
        truth, causal = run.groundtruth, run.trajectory
        if truth is None or len(causal) == 0:
            return False
        judged = JudgedRun.of(run, truth)
        try:
            if judged.breaks_ns:
                self._send_truth(judged.true_paths(truth))
                self._place_truth(Similarity.identity())
            else:
                self.show_truth(truth, run.smoothed or causal, judged.alignment, judged.camera)
            stamps_ns, errors = judged.errors()
        except DataError:
            return False
        frames = self.frames(stamps_ns)
        for entity, (values, sigmas) in errors.items():
            self._series.send(entity, frames, stamps_ns, values)
            band = three_sigma(np.zeros_like(values), sigmas)
            self._series.send(f"{entity}/bounds", frames, stamps_ns, band)
        return True

    def _show_nees(self, stamps_ns: IntArray, values: FloatArray) -> None:
        frames = self.frames(stamps_ns)
        self._series.send("consistency/nees", frames, stamps_ns, values)
        low, high = mean_bounds(3, 1)
        bounds = np.tile([high, low], (len(values), 1))
        self._series.send("consistency/nees/bounds", frames, stamps_ns, bounds)
