# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories and states in a recording of tracks: arrays in a zip file, without pickles."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal
from zipfile import ZipFile

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.datasets.calibration.calibration_yaml import pose_from_matrix
from slam_graph.datasets.formats.recorded_files import AGAIN
from slam_graph.datasets.streams.vector_lengths import lengths_of
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import NavState, Trajectory

_Shape = tuple[int | Literal["N"], ...]

_TRAJECTORY_SHAPES: dict[str, _Shape] = {
    "stamps_ns": ("N",),
    "quaternions": ("N", 4),
    **dict.fromkeys(("positions", "velocities", "gyro_biases", "accel_biases"), ("N", 3)),
}
_STATE_SHAPES: dict[str, _Shape] = {
    "stamp_ns": (),
    "world_T_body": (4, 4),
    "covariance": (15, 15),
    **dict.fromkeys(("velocity", "gyro_bias", "accel_bias"), (3,)),
}
_UNIT_TOLERANCE = 1e-3
"""Largest error of the length of a quaternion: those of ground truth are rounded."""


def save_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory; arrays that it does not have are left out."""
    _save(path, {name: getattr(trajectory, name) for name in _names(Trajectory)})


def load_trajectory(path: Path) -> Trajectory:
    """Read what `save_trajectory` wrote."""
    arrays = _load(path, ("stamps_ns", "positions", "quaternions"), _TRAJECTORY_SHAPES)
    stamps, lengths = arrays["stamps_ns"], lengths_of(arrays["quaternions"])
    if np.any(stamps[1:] <= stamps[:-1]) or np.any(np.abs(lengths - 1.0) > _UNIT_TOLERANCE):
        raise DataError(
            f"{path}: the times do not increase, or a quaternion is not of unit length; {AGAIN}"
        )
    return Trajectory(
        stamps_ns=arrays["stamps_ns"],
        positions=arrays["positions"],
        quaternions=arrays["quaternions"],
        velocities=arrays.get("velocities"),
        gyro_biases=arrays.get("gyro_biases"),
        accel_biases=arrays.get("accel_biases"),
    )


def save_state(path: Path, state: NavState) -> None:
    """Write a state."""
    fields = {name: getattr(state, name) for name in _names(NavState)}
    _save(path, fields | {"world_T_body": state.world_T_body.matrix()})


def load_state(path: Path) -> NavState:
    """Read what `save_state` wrote."""
    required = ("stamp_ns", "world_T_body", "velocity", "gyro_bias", "accel_bias")
    arrays = _load(path, required, _STATE_SHAPES)
    pose_from_matrix(arrays["world_T_body"], f"{path}: world_T_body")
    covariance = arrays.get("covariance")
    if covariance is not None and not _is_covariance(covariance):
        raise DataError(f"{path}: 'covariance' is not a covariance; {AGAIN}")
    return NavState(
        stamp_ns=int(arrays["stamp_ns"]),
        world_T_body=gtsam.Pose3(arrays["world_T_body"]),  # as it was, to the last bit
        velocity=arrays["velocity"],
        gyro_bias=arrays["gyro_bias"],
        accel_bias=arrays["accel_bias"],
        covariance=covariance,
    )


def _is_covariance(matrix: FloatArray) -> bool:
    eigenvalues = np.linalg.eigvalsh(matrix)
    symmetric = np.allclose(matrix, matrix.T, rtol=1e-6)
    return symmetric and bool(eigenvalues[0] >= -1e-9 * eigenvalues[-1])


def _save(path: Path, fields: dict[str, Any]) -> None:
    arrays: dict[str, Any] = {k: np.asarray(v) for k, v in fields.items() if v is not None}
    np.savez(path, **arrays)


def _load(path: Path, required: tuple[str, ...], shapes: dict[str, _Shape]) -> dict[str, Any]:
    """The arrays of a file, of the shapes and types that they must have, and finite."""
    try:
        with ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > path.stat().st_size:  # the recorder does not compress
            raise DataError(f"{path}: its arrays are larger than the file; {AGAIN}")
        with path.open("rb") as data, np.load(data, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name in shapes}
    except DataError:
        raise
    except Exception as error:  # a damaged zip fails in many ways
        what = " ".join(str(error).split())[:150] or type(error).__name__
        raise DataError(f"{path}: cannot be read ({what}); {AGAIN}") from None
    missing = [name for name in required if name not in arrays]
    if missing:
        raise DataError(f"{path}: no array '{missing[0]}' in this file; {AGAIN}")
    count = arrays["stamps_ns"].size if "stamps_ns" in arrays else 0
    for name, array in arrays.items():
        dtype = np.dtype("i8" if name.startswith("stamp") else "f8")
        shape = tuple(count if size == "N" else size for size in shapes[name])
        if array.shape != shape or array.dtype != dtype:
            raise DataError(
                f"{path}: '{name}' has shape {array.shape} and type {array.dtype}, expected "
                f"{shape} and {dtype}; {AGAIN}"
            )
        usable = Files.are_times(array) if dtype.kind == "i" else Files.are_measurable(array)
        if not np.all(usable):
            raise DataError(f"{path}: '{name}' is not finite, or beyond any measurement; {AGAIN}")
    return arrays


def _names(kind: type[NavState] | type[Trajectory]) -> list[str]:
    """The fields of a dataclass, without its class variables."""
    return [field.name for field in dataclasses.fields(kind)]
