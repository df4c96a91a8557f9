# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a run: trajectory, states, map, settings, metrics and timing."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slam_graph.config import dump_yaml
from slam_graph.errors import DataError
from slam_graph.evaluation.ape import ape
from slam_graph.geometry.trajectory import NavState, StateHistory, Trajectory, tum_lines
from slam_graph.geometry.trajectory_alignment import AlignmentMode
from slam_graph.results.map_output import MAP_NAME, save_map
from slam_graph.results.point_map import write_ply
from slam_graph.results.result_files import appearing, write_text
from slam_graph.sensors.kalibr_calibration import write_kalibr

if TYPE_CHECKING:
    from slam_graph.results.run_result import RunResult

STATE_COLUMNS = (
    "stamp_ns",
    *NavState.COMPONENTS[6:],
    *(f"sigma_{component}" for component in NavState.COMPONENTS),
)


def write_run(result: RunResult, folder: Path) -> list[Path]:
    """Write all files of a run, the trajectory first; each appears whole or not at all.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    trajectory = folder / "trajectory.tum"
    write_text(trajectory, tum_lines(result.trajectory))
    states = folder / "states.csv"
    write_text(states, state_lines(result.history))
    files = [trajectory, states]
    if result.final_ba is not None:
        files.append(folder / "trajectory_smoothed.tum")
        write_text(files[-1], tum_lines(result.final_ba.trajectory))
    if result.loops is not None:
        files += [folder / "trajectory_loop.tum", folder / "loops.csv", folder / "map_loop.ply"]
        write_text(files[-3], tum_lines(result.loops.correct(result.best_trajectory)))
        write_text(files[-2], result.loops.csv_lines())
        write_ply(files[-1], result.loops.points())
    if result.localization is not None:
        files += [folder / "trajectory_map.tum", folder / "localization.csv"]
        write_text(files[-2], tum_lines(result.localization.trajectory()))
        write_text(files[-1], result.localization.csv_lines())
    truth = result.truth_of_run()
    if truth is not None:
        files.append(folder / "groundtruth.tum")
        write_text(files[-1], tum_lines(truth))
    map_file, timing = folder / "map.ply", folder / "timing.csv"
    write_ply(map_file, result.points.points())
    write_text(timing, result.timing.csv_lines())
    config, calibration = folder / "config.yaml", folder / "calibration.yaml"
    write_text(config, [dump_yaml(result.config)])
    write_kalibr(result.rig, calibration)
    metrics = folder / "metrics.json"
    write_text(metrics, [json.dumps(result.metrics, indent=2, allow_nan=False), "\n"])
    files += [map_file, timing, config, calibration, metrics]
    if result.calibration.latest is not None:
        files += [folder / "calibration_estimated.yaml", folder / "calibration.csv"]
        write_kalibr(result.calibration.latest.rig, files[-2])
        write_text(files[-1], result.calibration.csv_lines())
    if truth is not None and write_picture(result, truth, folder / "trajectory.png"):
        files.append(folder / "trajectory.png")
    if result.slam_map is not None:  # last, as it is what a full disk is too small for
        files.append(folder / MAP_NAME)
        save_map(result.slam_map, files[-1], force=True)
    return files


def write_picture(result: RunResult, truth: Trajectory, path: Path) -> bool:
    """Draw the trajectory beside the truth; whether the two can be compared."""
    from slam_graph.visualization.plots import plot_errors

    alignment: AlignmentMode = "none" if result.start_was_given else "se3"
    try:
        position = ape(truth, result.trajectory, "trans_part", alignment)
        rotation = ape(truth, result.trajectory, "angle_deg", alignment)
    except DataError:
        return False
    title = f"{result.info.name}, {result.config.algorithm.name}, alignment: {alignment}"
    aligned = position.similarity.apply(result.trajectory)
    with appearing(path) as partial:
        plot_errors(
            partial, title, truth, aligned, position.values, rotation.values, position.stamps_ns
        )
    return True


def state_lines(history: StateHistory) -> Iterator[str]:
    """Velocities, biases and standard deviations as CSV; sigmas are empty where unknown."""
    yield ",".join(STATE_COLUMNS) + "\n"
    trajectory = history.trajectory()
    parts = (trajectory.velocities, trajectory.accel_biases, trajectory.gyro_biases)
    rows = np.hstack([*(part for part in parts if part is not None), history.sigmas()])
    # row by row: lists of all of them would take several times the memory of the arrays
    for stamp_ns, row in zip(trajectory.stamps_ns, rows, strict=True):
        cells = ("" if math.isnan(value) else f"{value:.9g}" for value in row.tolist())
        yield ",".join([str(stamp_ns), *cells]) + "\n"
