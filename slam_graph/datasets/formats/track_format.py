# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The folder format of recorded feature tracks: its files and their records.

All numbers are little-endian, and no file is a pickle:

- ``meta.yaml``: `format` (``slam_graph-tracks``), `version`, `name`, and the number of `cameras`,
  `frames`, `imu_samples` and `features`, by which a truncated file is recognised;
- ``calibration.yaml``: the rig, as `slam_graph.sensors.kalibr_calibration` writes it;
- ``frames.bin``: for each frame `stamp` (int64, ns) and `counts` (int64 for each camera), the
  number of features of each camera;
- ``features.bin``: for each feature `id` (int64), `pixel` and `normalized` (two float64 each),
  ordered by frame, then camera, then as in the `FeatureFrame`;
- ``descriptors.bin``, where features have any: for each feature of the first camera, in the same
  order, `descriptor_bytes` of ``meta.yaml`` bytes (0 or missing if there are none);
- ``imu.bin``: for each sample `stamp` (int64, ns), `gyro` and `accel` (three float64 each);
- ``groundtruth.npz`` and ``initial_state.npz``, where there are any: the arrays of `Trajectory` and
  `NavState` under their names (`world_T_body` as a 4x4 matrix).

A recording is replayed bit for bit.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam_graph.errors import DataError
from slam_graph.geometry import NavState, Trajectory

FORMAT_NAME = "slam_graph-tracks"
FORMAT_VERSION = 1

META, CALIBRATION = "meta.yaml", "calibration.yaml"
FRAMES, FEATURES, IMU = "frames.bin", "features.bin", "imu.bin"
DESCRIPTORS = "descriptors.bin"
GROUNDTRUTH, INITIAL_STATE = "groundtruth.npz", "initial_state.npz"

IMU_RECORD = np.dtype([("stamp", "<i8"), ("gyro", "<f8", (3,)), ("accel", "<f8", (3,))])
FEATURE_RECORD = np.dtype([("id", "<i8"), ("pixel", "<f8", (2,)), ("normalized", "<f8", (2,))])


def frame_record(cameras: int) -> np.dtype[np.void]:
    """Type of a row of ``frames.bin`` for a number of cameras."""
    return np.dtype([("stamp", "<i8"), ("counts", "<i8", (cameras,))])


def save_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory; arrays that it does not have are left out."""
    _save(path, {name: getattr(trajectory, name) for name in _names(Trajectory)})


def load_trajectory(path: Path) -> Trajectory:
    """Read what `save_trajectory` wrote."""
    arrays = _load(path, ("stamps_ns", "positions", "quaternions"))
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
    arrays = _load(path, ("stamp_ns", "world_T_body", "velocity", "gyro_bias", "accel_bias"))
    return NavState(
        stamp_ns=int(arrays["stamp_ns"]),
        world_T_body=gtsam.Pose3(arrays["world_T_body"]),
        velocity=arrays["velocity"],
        gyro_bias=arrays["gyro_bias"],
        accel_bias=arrays["accel_bias"],
        covariance=arrays.get("covariance"),
    )


def _save(path: Path, fields: dict[str, Any]) -> None:
    arrays: dict[str, Any] = {k: np.asarray(v) for k, v in fields.items() if v is not None}
    np.savez(path, **arrays)


def _load(path: Path, required: tuple[str, ...]) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # a damaged zip fails in many ways
        raise DataError(f"{path}: cannot be read ({error}); record it again") from None
    missing = [name for name in required if name not in arrays]
    if missing:
        raise DataError(f"{path}: no array '{missing[0]}' in this file; record it again")
    return arrays


def _names(kind: type[NavState] | type[Trajectory]) -> list[str]:
    """The fields of a dataclass, without its class variables."""
    return [field.name for field in dataclasses.fields(kind)]
