# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth: read from EuRoC's CSV, a TUM file, or an EuRoC folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets.calibration.euroc_calibration import read_body_T_sensor
from slam_graph.datasets.streams.csv_rows import (
    STAMP_TEXT,
    Rows,
    check_times,
    read_rows,
    stamps_from_seconds,
)
from slam_graph.datasets.streams.pairing import in_order
from slam_graph.datasets.streams.vector_lengths import lengths_of
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import Trajectory

FOLDERS = ("state_groundtruth_estimate0", "mocap0", "vicon0")
"""Folders of poses in EuRoC and similar recordings, in the order of preference."""

_EUROC_COLUMNS = {7: "pose", 10: "pose and velocity", 16: "pose, velocity and biases"}
"""Values after the time stamp of an EuRoC ground truth: p, q (w x y z), v, gyro and accel bias."""

_SMALLEST_QUATERNION = 0.5
"""A quaternion shorter than this is a missing value, not a rounded unit quaternion."""


def find_groundtruth(mav0: Path) -> Path | None:
    """The ground truth file of an EuRoC folder, or None."""
    for name in FOLDERS:
        if (mav0 / name / "data.csv").is_file():
            return mav0 / name / "data.csv"
    return None


def resolve_groundtruth(path: Path) -> Path:
    """The ground truth file of a path: itself, or the one in an EuRoC folder or its parent."""
    if path.is_file():
        return path
    for folder in (path / "mav0", path):
        found = find_groundtruth(folder)
        if found is not None:
            return found
    if (path / "data.csv").is_file():
        return path / "data.csv"
    looked = ", ".join(f"{name}/data.csv" for name in FOLDERS)
    raise DataError(f"{path}: no ground truth here; expected a CSV or TUM file, or {looked}")


def check_groundtruth(path: Path) -> None:
    """Refuse a file without data rows or with an unknown number of columns."""
    for rows in read_rows(path, 1):
        _layout(rows)
        return
    raise DataError(f"{path}: no ground truth rows in this file")


def read_groundtruth(path: str | Path, diagnostics: Diagnostics | None = None) -> Trajectory:
    """Read poses of the body (IMU) in the world.

    A comma-separated file is read as EuRoC's (time in ns, p, q as w x y z, and then nothing, the
    velocity, or velocity, gyroscope and accelerometer bias); one separated by white space as TUM's
    (time in seconds, p, q as x y z w). Where an EuRoC ``sensor.yaml`` lies beside the file, its
    `T_BS` takes the poses from the tracked frame to the body.

    Args:
        path: file, or folder as in `resolve_groundtruth`.
        diagnostics: counts `groundtruth_not_finite` and `groundtruth_out_of_order` rows, which are
            dropped.

    Raises:
        DataError: if the file is missing, empty, or a row cannot be read.
    """
    path = resolve_groundtruth(Path(path))
    check_groundtruth(path)
    diagnostics = diagnostics if diagnostics is not None else Diagnostics()
    return _to_body(_trajectory(*usable_states(path, _parse_block, diagnostics)), path)


def usable_states(
    path: Path,
    parse: Callable[[Rows], tuple[IntArray, FloatArray]],
    diagnostics: Diagnostics,
) -> tuple[IntArray, FloatArray]:
    """The states in a file that are finite, have a rotation, and are in the order of time.

    Args:
        path: of the file.
        parse: gives stamps (N,) in ns and values (N, 7 or more) of some rows: position, quaternion
            x y z w, and what else there is.
        diagnostics: counts the others, as in `read_groundtruth`.

    Raises:
        DataError: if the file cannot be read, or holds none.
    """
    blocks = []
    for rows in read_rows(path):
        stamps, values = parse(rows)
        whole = _whole(rows, values, diagnostics)
        blocks.append((stamps[whole], values[whole], np.array(rows.numbers)[whole]))
    if not sum(len(stamps) for stamps, _, _ in blocks):
        raise DataError(f"{path}: no usable state in this file")
    stamps, values, lines = (np.concatenate(parts) for parts in zip(*blocks, strict=True))

    def dropped(k: int, _: int) -> None:
        diagnostics.warn("groundtruth_out_of_order", f"{path}:{lines[k]}: row dropped")

    kept = in_order(stamps, dropped)
    return stamps[kept], values[kept]


def _layout(rows: Rows) -> tuple[str | None, int]:
    """Delimiter and number of values after the stamp, from the first row."""
    line = rows.lines[0].strip().rstrip(",")
    if "," in line:
        values = line.count(",")
        if values not in _EUROC_COLUMNS:
            known = ", ".join(f"{n} ({what})" for n, what in _EUROC_COLUMNS.items())
            raise DataError(
                f"{rows.where(0)}: {values} values after the time stamp; ground truth has {known}"
            )
        return ",", values
    if len(line.split()) != 8:
        raise DataError(
            f"{rows.where(0)}: {len(line.split())} columns; a TUM trajectory has 8 "
            "(time, position xyz, quaternion xyzw)"
        )
    return None, 7


def _parse_block(rows: Rows) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) and values (N, 7, 10 or 16) with the quaternion as x y z w."""
    delimiter, count = _layout(rows)
    columns = tuple(range(count + 1))
    if delimiter is None:
        dtype: list[tuple[Any, ...]] = [("stamp", STAMP_TEXT), ("values", "f8", (count,))]
        table = rows.parse(dtype, "time [s], position, quaternion xyzw", columns, None)
        return stamps_from_seconds(rows, table["stamp"]), table["values"]
    dtype = [("stamp", "i8"), ("values", "f8", (count,))]
    table = rows.parse(dtype, f"stamp [ns] and {count} numbers", columns)
    check_times(rows, table["stamp"])
    values = table["values"].copy()
    values[:, 3:7] = table["values"][:, [4, 5, 6, 3]]
    return table["stamp"], values


def _whole(rows: Rows, values: FloatArray, diagnostics: Diagnostics) -> NDArray[np.intp]:
    """Indices of the rows that are finite and have a rotation; the others are counted."""
    whole = Files.are_measurable(values).all(axis=1)
    lengths = lengths_of(values[:, 3:7])
    whole &= (lengths > _SMALLEST_QUATERNION) & np.isfinite(lengths)
    for k in np.flatnonzero(~whole):
        diagnostics.warn("groundtruth_not_finite", f"{rows.where(int(k))}: row dropped")
    return np.flatnonzero(whole)


def _trajectory(stamps: IntArray, values: FloatArray) -> Trajectory:
    quaternions = values[:, 3:7] / np.linalg.norm(values[:, 3:7], axis=1, keepdims=True)
    full = values.shape[1] == 16
    return Trajectory(
        stamps,
        values[:, :3].copy(),
        quaternions,
        values[:, 7:10].copy() if values.shape[1] >= 10 else None,
        accel_biases=values[:, 13:16].copy() if full else None,
        gyro_biases=values[:, 10:13].copy() if full else None,
    )


def _to_body(trajectory: Trajectory, path: Path) -> Trajectory:
    """Poses of the IMU, where ``sensor.yaml`` files give the pose of the tracked frame.

    The velocities and biases of another frame are dropped; EuRoC's files that have them track the
    body itself.
    """
    sensor, imu = path.parent / "sensor.yaml", path.parent.parent / "imu0" / "sensor.yaml"
    if path.name != "data.csv" or not sensor.is_file():
        return trajectory
    sensor_T_body = read_body_T_sensor(sensor).inverse()
    if imu.is_file():
        sensor_T_body = sensor_T_body.compose(read_body_T_sensor(imu))
    if sensor_T_body.equals(gtsam.Pose3(), 1e-9):
        return trajectory
    poses = [trajectory.pose(k).compose(sensor_T_body) for k in range(len(trajectory))]
    return Trajectory(
        trajectory.stamps_ns,
        np.array([pose.translation() for pose in poses]),
        np.array([_xyzw(pose.rotation()) for pose in poses]),
    )


def _xyzw(rotation: gtsam.Rot3) -> list[float]:
    quaternion: Any = rotation.toQuaternion()  # an Eigen type that the stubs do not know
    return [quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()]
