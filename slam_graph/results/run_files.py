# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a run that are read back too: their names, and the table of states."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets import read_groundtruth
from slam_graph.errors import DataError
from slam_graph.geometry import NavState, StateHistory, Trajectory

TRAJECTORY = "trajectory.tum"
SMOOTHED = "trajectory_smoothed.tum"
LOOP_CLOSED = "trajectory_loop.tum"
IN_MAP = "trajectory_map.tum"
GROUNDTRUTH = "groundtruth.tum"
STATES = "states.csv"
POINTS = "map.ply"
CONFIG = "config.yaml"
RIG = "calibration.yaml"
METRICS = "metrics.json"

VELOCITY = NavState.COMPONENTS[6:9]
ACCEL_BIAS = NavState.COMPONENTS[9:12]
GYRO_BIAS = NavState.COMPONENTS[12:15]
SIGMAS = tuple(f"sigma_{component}" for component in NavState.COMPONENTS)
_COLUMNS = (*VELOCITY, *ACCEL_BIAS, *GYRO_BIAS, *SIGMAS)


def state_lines(history: StateHistory) -> Iterator[str]:
    """Velocities, biases and standard deviations as CSV; sigmas are empty where unknown."""
    yield ",".join(["stamp_ns", *_COLUMNS]) + "\n"
    trajectory = history.trajectory()
    parts = (trajectory.velocities, trajectory.accel_biases, trajectory.gyro_biases)
    rows = np.hstack([*(part for part in parts if part is not None), history.sigmas()])
    # row by row: lists of all of them would take several times the memory of the arrays
    for stamp_ns, row in zip(trajectory.stamps_ns, rows, strict=True):
        cells = ("" if math.isnan(value) else f"{value:.9g}" for value in row.tolist())
        yield ",".join([str(stamp_ns), *cells]) + "\n"


def read_states(path: Path) -> tuple[IntArray, dict[str, FloatArray]]:
    """Read what `state_lines` wrote; the columns may be in any order.

    Returns:
        Times (N,) in ns, and the other columns (N,) by name, NaN where empty.

    Raises:
        DataError: if the file is missing or another table.
    """
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines()
        names = header.split(",")[1:]
        missing = [name for name in _COLUMNS if name not in names]
        if missing:
            raise ValueError(f"no column '{missing[0]}'")
        cells = [line.split(",") for line in lines]
        stamps = np.array([int(row[0]) for row in cells], dtype=np.int64)
        values = [[float(cell) if cell else math.nan for cell in row[1:]] for row in cells]
        table = np.array(values, dtype=np.float64).reshape(len(stamps), len(names))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise DataError(f"{path}: not the states of a run ({error})") from error
    return stamps, dict(zip(names, table.T, strict=True))


def read_tum(path: Path) -> Trajectory:
    """Read a trajectory, which may be empty.

    Raises:
        DataError: if the file is missing or not a trajectory.
    """
    if path.is_file() and path.stat().st_size == 0:
        return Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
    return read_groundtruth(path)
