# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files of the moving objects of a run, and their table in `metrics.json`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np

from slam_graph import evaluation
from slam_graph.arrays import FloatArray
from slam_graph.files import Files
from slam_graph.results.map_output import write_ply
from slam_graph.results.result_files import ResultFolder
from slam_graph.results.run_input import RunInput

if TYPE_CHECKING:
    from slam_graph.objects import ObjectHistory, ObjectState

OBJECTS = "objects.csv"

_COLUMNS = (
    *("timestamp_ns", "object", "moving", "points", "label", "class"),
    *("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *("vx_m_s", "vy_m_s", "vz_m_s"),
    *(f"sigma_rotation_{axis}_rad" for axis in "xyz"),
    *(f"sigma_position_{axis}_m" for axis in "xyz"),
    *(f"sigma_v{axis}_m_s" for axis in "xyz"),
    *("step_s", *(f"step_rotation_{axis}_rad" for axis in "xyz")),
    *(f"step_{axis}_m" for axis in "xyz"),
    *(f"sigma_step_rotation_{axis}_rad" for axis in "xyz"),
    *(f"sigma_step_{axis}_m" for axis in "xyz"),
)


def save_objects(files: ResultFolder, objects: ObjectHistory) -> None:
    """Write `objects.csv`, and for each object its trajectory and its points."""
    files.text(OBJECTS, csv_lines(objects))
    if len(objects):
        Files.make_folder(files.folder / "objects")
    for number in objects.numbers:
        files.text(f"objects/{number}.tum", objects.trajectory(number).tum_lines())
        if len(objects.points.get(number, ())):
            write_ply(files.path(f"objects/{number}.ply"), objects.points[number])


def csv_lines(objects: ObjectHistory) -> Iterator[str]:
    """One row for each object and frame. Sigmas of poses and steps are in axes of the object."""
    yield ",".join(_COLUMNS) + "\n"
    for state in objects.all_states():
        named = objects.classes.get(state.label, "")
        cells = [str(state.stamp_ns), str(state.number), str(int(state.moving))]
        cells += [str(state.points), str(state.label), named]
        yield ",".join([*cells, *(f"{value:.9g}" for value in _numbers(state))]) + "\n"


def _numbers(state: ObjectState) -> Iterator[float]:
    pose = state.world_T_object
    quaternion: Any = pose.rotation().toQuaternion()  # a type that the stubs do not know
    yield from pose.translation()
    yield from quaternion.coeffs()
    yield from state.velocity
    yield from _sigmas(state.covariance)
    yield from _sigmas(state.velocity_covariance)
    if state.step is None:
        yield from [np.nan] * 13
        return
    yield state.step.seconds
    yield from gtsam.Rot3.Logmap(state.step.motion.rotation())
    yield from state.step.motion.translation()
    yield from _sigmas(state.step.covariance)


def _accuracy(objects: ObjectHistory, asked: RunInput) -> dict[str, float | int] | None:
    """Errors of motions and poses; None without true poses."""
    if asked.truth is None or not asked.object_truth:
        return None
    offset_ns = round(asked.rig.pose_offset_s * 1e9)
    true_body = replace(asked.truth, stamps_ns=asked.truth.stamps_ns - offset_ns)
    steps = [
        evaluation.ObjectStep(
            state.stamp_ns,
            state.step.before_ns,
            state.number,
            state.world_T_object,
            state.step.motion,
            state.step.covariance,
            state.world_T_body,
        )
        for state in objects.all_states()
        if state.step is not None
    ]
    return evaluation.object_errors(steps, asked.object_truth, true_body).table()


def _sigmas(covariance: FloatArray) -> FloatArray:
    """Standard deviations (n,) of a covariance (n, n)."""
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def objects_table(objects: ObjectHistory | None, asked: RunInput) -> dict[str, Any] | None:
    """What `metrics.json` says of the objects; None if none were looked for.

    Args:
        objects: as they were estimated.
        asked: the true poses, if they are known.
    """
    if objects is None:
        return None
    table: dict[str, Any] = {}
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
        "accuracy": _accuracy(objects, asked),
        "ms_per_frame": objects.milliseconds / max(objects.frames, 1),
    }
