# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""True poses of moving objects: `objects_truth.csv` beside a recording.

Columns: time (ns, clock of the cameras), number of the object, position (m) and quaternion
(x, y, z, w) of its frame in the world of the ground truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from slam_graph.datasets.streams.csv_rows import read_rows
from slam_graph.datasets.streams.vector_lengths import lengths_of
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import Trajectory

OBJECT_TRUTH = "objects_truth.csv"

_HEADER = "#timestamp_ns,object,x_m,y_m,z_m,qx,qy,qz,qw\n"
_COLUMNS = [("stamp", "<i8"), ("object", "<i8"), ("position", "<f8", (3,)), ("q", "<f8", (4,))]
_UNIT_TOLERANCE = 1e-3
"""Largest error of the length of a quaternion."""


def object_truth_lines(truth: Mapping[int, Trajectory]) -> Iterator[str]:
    """The file's lines for poses by the numbers of the objects."""
    yield _HEADER
    for number, path in sorted(truth.items()):
        for stamp_ns, p, q in zip(path.stamps_ns, path.positions, path.quaternions, strict=True):
            numbers = ",".join(f"{value:.9g}" for value in (*p, *q))
            yield f"{stamp_ns},{number},{numbers}\n"


def object_truth_file(truth: Mapping[int, Trajectory]) -> dict[str, str]:
    """Name and text of the file for poses by the numbers of the objects; empty without objects."""
    return {OBJECT_TRUTH: "".join(object_truth_lines(truth))} if truth else {}


def read_object_truth(path: Path) -> dict[int, Trajectory]:
    """Poses by the numbers of the objects.

    Raises:
        DataError: if the file cannot be read, or times of an object do not increase.
    """
    blocks = [rows.parse(_COLUMNS, "true pose of an object") for rows in read_rows(path)]
    table = np.concatenate(blocks) if blocks else np.zeros(0, np.dtype(_COLUMNS))
    lengths = lengths_of(table["q"])
    measurable = Files.are_measurable(table["position"]).all() and np.isfinite(lengths).all()
    if not measurable or np.any(np.abs(lengths - 1.0) > _UNIT_TOLERANCE):
        raise DataError(
            f"{path}: a pose is not finite or too far, or a quaternion is not of unit length"
        )
    truth: dict[int, Trajectory] = {}
    for number in np.unique(table["object"]).tolist():
        rows = table[table["object"] == number]
        stamps = np.ascontiguousarray(rows["stamp"])
        if np.any(stamps[1:] <= stamps[:-1]) or not Files.are_times(stamps).all():
            raise DataError(f"{path}: the times of object {number} do not increase")
        truth[number] = Trajectory(stamps, rows["position"].copy(), rows["q"].copy())
    return truth
