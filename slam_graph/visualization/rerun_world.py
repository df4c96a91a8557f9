# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps, saved runs, recordings and comparisons in Rerun, from what their files hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets import Sequence
from slam_graph.maps import SlamMap
from slam_graph.sensors import CameraFrame, FeatureFrame, Rig
from slam_graph.visualization.rerun_blueprints import (
    KNOWN_MAP,
    RIG_M,
    SQUARE,
    Eye,
    Shown,
    odometry,
    space,
    whole,
    whole_axis,
    with_ticks,
)
from slam_graph.visualization.rerun_images import CameraViews
from slam_graph.visualization.rerun_map import log_map, places_in_map
from slam_graph.visualization.rerun_outcome import FinishedRun, OutcomeLog
from slam_graph.visualization.rerun_palette import CYCLE, CYCLE_NAMES, TRUTH
from slam_graph.visualization.rerun_series import SeriesLog
from slam_graph.visualization.rerun_stream import RerunStream

_SINCE_START = "since_start"
"""Timeline of comparisons."""


@dataclass(frozen=True, eq=False)
class SavedDetails:
    """What the files of a run hold beside its trajectories.

    Attributes:
        rig: the sensors.
        points: (P, 3) the map of the run, m.
        timing: (F,) milliseconds of stages by their names, and `stamp_ns`.
        log: lines.
        known_map: the map that the run was located in, if it is at hand.
    """

    rig: Rig | None
    points: FloatArray
    timing: Mapping[str, FloatArray]
    log: Iterable[str] = ()
    known_map: SlamMap | None = None


def show_saved_run(stream: RerunStream, run: FinishedRun, details: SavedDetails) -> None:
    """Log a run from its files: what a run that is watched shows, but images and features."""
    series = SeriesLog(stream)
    stamps_ns = np.asarray(details.timing.get("stamp_ns", run.trajectory.stamps_ns), np.int64)
    outcome = OutcomeLog(stream, "world", series, stamps_ns.tolist())
    stream.log("world", stream.rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    plots = outcome.show_states(run) | outcome.show(run)
    outcome.show_points(details.points)
    outcome.show_legend()
    if len(run.trajectory):
        outcome.show_gravity(run.trajectory.positions[0])
    plots |= _show_timing(series, stamps_ns, details.timing)
    if details.rig is not None:
        CameraViews(stream, details.rig, "world/body").mount(details.rig)
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
        plots=plots,
        log=bool(lines),
        in_map=run.in_map is not None,
        map_path=places_in_map(run, details.known_map),
        spans=series.spans,
    )
    stream.arrange(odometry(shown, Eye.on(best.positions, details.points, SQUARE, RIG_M)))


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


def show_recording(stream: RerunStream, sequence: Sequence, images: bool = True) -> None:
    """Log a recording as it is: images or tracks, IMU, ground truth.

    Args:
        stream: where it goes.
        sequence: the recording.
        images: whether images are sent.
    """
    series, rr = SeriesLog(stream), stream.rr
    cameras = CameraViews(stream, sequence.rig, "world/body")
    cameras.mount(sequence.rig)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    none = np.zeros(0, np.int64)
    stamps_ns: list[int] = []
    for number, packet in enumerate(sequence.packets()):
        stamps_ns.append(packet.frame.stamp_ns)
        stream.at(number, packet.frame.stamp_ns)
        if isinstance(packet.frame, CameraFrame) and images:
            cameras.show_images(packet.frame)
        elif isinstance(packet.frame, FeatureFrame):
            cameras.show_tracks(packet.frame, none, none)
        for row in range(0, len(packet.imu), 2):
            at = int(packet.imu.stamps_ns[row])
            series.add("imu/gyro", number, at, packet.imu.gyro[row])
            series.add("imu/accel", number, at, packet.imu.accel[row])
    series.flush()
    truth, eye = sequence.groundtruth(), None
    if truth is not None and stamps_ns:
        near = (truth.stamps_ns >= stamps_ns[0]) & (truth.stamps_ns <= stamps_ns[-1])
        truth = truth.select(near)
        outcome = OutcomeLog(stream, "world", series, stamps_ns)
        outcome.path("path/groundtruth", truth, TRUTH)
        columns = rr.Transform3D.columns(translation=truth.positions, quaternion=truth.quaternions)
        stream.send_columns("world/body", outcome.frames(truth.stamps_ns), truth.stamps_ns, columns)
        eye = Eye.on(truth.positions, around=RIG_M)
    plots = frozenset({"imu/gyro", "imu/accel"})
    shown = Shown(cameras=len(sequence.rig.cameras), plots=plots, title="Recording")
    stream.arrange(odometry(shown, eye))


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """One of several runs that are shown together.

    Attributes:
        name: of the algorithm or the folder.
        path: (S, 3) positions of all states in the world of the truth, or of the first run, m.
        time_s: (N,) since the first frame, of the states that have a true pose.
        errors: (N,) at these times, by the title of a plot.
    """

    name: str
    path: FloatArray
    time_s: FloatArray
    errors: Mapping[str, FloatArray]


def show_comparison(
    stream: RerunStream, runs: Iterable[ComparedRun], true_path: FloatArray | None
) -> None:
    """Log several runs over one another: their paths, and their errors over time.

    Args:
        stream: where it goes.
        runs: to compare.
        true_path: (M, 3) in the same world, if there is one.
    """
    import rerun.blueprint as rrb

    rr, titles, places = stream.rr, dict[str, str](), list[FloatArray]()
    stream.log("paths", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    rows, largest = [], dict[str, float]()
    for number, run in enumerate(runs):
        colour, name = CYCLE[number % len(CYCLE)], rr.escape_entity_path_part(run.name)
        places.append(run.path)
        line = rr.LineStrips3D(
            [run.path],
            colors=colour,
            radii=-1.2,
            labels=[run.name],
            show_labels=False,
        )
        stream.log(f"paths/{name}", line, static=True)
        row = [run.name, CYCLE_NAMES[number % len(CYCLE)]]
        for index, (title, values) in enumerate(run.errors.items()):
            entity = titles.setdefault(title, f"errors/{index}")
            style = rr.SeriesLines(colors=colour, names=run.name, widths=1.5)
            stream.log(f"{entity}/{name}", style, static=True)
            columns = rr.Scalars.columns(scalars=values)
            times = rr.TimeColumn(_SINCE_START, duration=run.time_s)
            stream.send_along(f"{entity}/{name}", times, columns)
            row.append(f"{np.sqrt(np.mean(values**2)):.4g}")
            largest[title] = max(largest.get(title, 0.0), float(np.max(values, initial=0.0)))
        rows.append("| " + " | ".join(row) + " |")
    if true_path is not None:
        line = rr.LineStrips3D(
            [true_path], colors=TRUTH, radii=-0.8, labels=["ground truth"], show_labels=False
        )
        stream.log("paths/ground_truth", line, static=True)
        places.append(true_path)
    head = "| RMSE | " + " | ".join(["colour", *titles]) + " |\n" + "|---" * (2 + len(titles))
    head += "|\n"
    grey = "" if true_path is None else "\n\nThin, light grey: ground truth."
    text = "# Comparison\n\n" + head + "\n".join(rows) + grey
    stream.log("summary", rr.TextDocument(text, media_type="text/markdown"), static=True)
    plots: list[Any] = [
        rrb.TimeSeriesView(
            name=title,
            origin=f"/{entity}",
            plot_legend=rrb.Corner2D.LeftTop,
            axis_x=whole_axis(),
            axis_y=rrb.ScalarAxis(range=with_ticks(0.0, largest[title])),
        )
        for title, entity in titles.items()
    ]
    plots.append(rrb.TextDocumentView(name="Summary", origin="/summary"))
    eye = Eye.on(np.concatenate([*places, np.zeros((0, 3))]), aspect=SQUARE)
    stream.arrange(
        whole(
            rrb.Horizontal(
                space("Paths", "/paths", eye=eye), rrb.Vertical(*plots), column_shares=[60, 40]
            ),
            timeline=_SINCE_START if titles else None,
        )
    )
