# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files of the moving objects of a run, and their table in `metrics.json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from slam_graph.files import Files
from slam_graph.geometry import Trajectory
from slam_graph.results.map_output import write_ply
from slam_graph.results.result_files import ResultFolder
from slam_graph.results.run_input import RunInput
from slam_graph.sensors import Rig

if TYPE_CHECKING:
    from slam_graph.backend import MovingObjects

_Errors = Callable[[Mapping[int, Trajectory], Trajectory], Any]
"""Errors of objects, given their true poses and those of the platform."""

OBJECTS, SMOOTHED = "objects.csv", "objects_smoothed.csv"
DIRECTIONS = "object_directions.csv"


def save_objects(files: ResultFolder, objects: MovingObjects) -> None:
    """Write `objects.csv`, each trajectory and points; the same smoothed, if objects were.

    Of objects before a single camera there are directions only, and no file in metres.
    """
    if objects.single_camera:
        files.text(DIRECTIONS, objects.direction_lines())
        return
    files.text(OBJECTS, objects.csv_lines())
    if len(objects):
        Files.make_folder(files.folder / "objects")
    for number in objects.numbers:
        files.text(f"objects/{number}.tum", objects.trajectory(number).tum_lines())
        if len(objects.points.get(number, ())):
            write_ply(files.path(f"objects/{number}.ply"), objects.points[number])
    if objects.smoothed is not None:
        files.text(SMOOTHED, objects.smoothed.csv_lines())
        for number in objects.smoothed.numbers:
            path = objects.smoothed.trajectory(number)
            files.text(f"objects/{number}_smoothed.tum", path.tum_lines())


def _accuracy(errors: _Errors, asked: RunInput, offset_ns: int) -> dict[str, float | int] | None:
    """Errors of motions and poses, which have the stamps of frames; None without true poses.

    Args:
        errors: of the objects.
        asked: the true poses.
        offset_ns: from stamps of frames to the clock of the true poses.
    """
    if asked.truth is None or not asked.object_truth:
        return None
    true_body = replace(asked.truth, stamps_ns=asked.truth.stamps_ns - offset_ns)
    table: dict[str, float | int] = errors(asked.object_truth, true_body).table()
    return table


def objects_table(
    objects: MovingObjects | None, asked: RunInput, rig: Rig
) -> dict[str, Any] | None:
    """What `metrics.json` says of the objects; None if none were looked for.

    Args:
        objects: as they were estimated.
        asked: the true poses, if they are known.
        rig: the calibration at the end of the run.
    """
    if objects is None:
        return None
    if objects.single_camera:
        return {
            "scale": "unknown",
            "directions": _directions_table(objects),
            "ms_per_frame": objects.milliseconds / max(objects.frames, 1),
        }
    table: dict[str, Any] = {}
    smoothed, offset_ns = objects.smoothed, round(rig.pose_offset_s * 1e9)
    for number in objects.numbers:
        states = objects.states(number)
        speeds = [float(np.linalg.norm(state.velocity)) for state in states if state.moving]
        table[str(number)] = {
            "label": objects.label(number),
            "class": objects.classes.get(objects.label(number), ""),
            "frames": len(states),
            "begin_ns": states[0].stamp_ns,
            "end_ns": states[-1].stamp_ns,
            "moving_frames": len(speeds),
            "mean_speed_m_s": float(np.mean(speeds)) if speeds else 0.0,
            "points": float(np.mean([state.points for state in states])),
        }
    return {
        "objects": table,
        "accuracy": _accuracy(objects.errors, asked, offset_ns),
        "smoothed": None if smoothed is None else _accuracy(smoothed.errors, asked, offset_ns),
        "ms_per_frame": objects.milliseconds / max(objects.frames, 1),
    }


def _directions_table(objects: MovingObjects) -> dict[str, dict[str, float | int]]:
    """The objects before a single camera, by their numbers."""
    table: dict[str, dict[str, float | int]] = {}
    for number in sorted({seen.number for seen in objects.directions}):
        rows = [seen for seen in objects.directions if seen.number == number]
        table[str(number)] = {
            "frames": len(rows),
            "begin_ns": rows[0].stamp_ns,
            "end_ns": rows[-1].stamp_ns,
            "mean_rate_rad_s": float(np.mean([np.linalg.norm(seen.rate) for seen in rows])),
            "points": float(np.mean([seen.points for seen in rows])),
        }
    return table
