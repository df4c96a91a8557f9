# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The small files of a simulation dumped from OpenVINS: calibration, true states, start state."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.rows import STAMP_TEXT, Rows, parse, read_rows, stamps_from_seconds
from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.sensors.calibration import read_camera
from slam_graph.sensors.rig import ImuNoise, Rig, RigCamera
from slam_graph.sensors.yaml_source import read_yaml

STATE_ROW = [("stamp", STAMP_TEXT), ("values", "f8", (16,))]
STATE_COLUMNS = "time [s], position, quaternion xyzw, velocity, gyro bias, accel bias"

DEFAULT_SIGMAS = {"q": 0.017, "p": 0.05, "v": 0.01, "bg": 0.02, "ba": 0.02}
"""Prior of the start state where the file does not state one: rad, m, m/s, rad/s, m/s²."""

COVARIANCE_ORDER = ("q", "p", "v", "ba", "bg")
"""Blocks of `NavState.covariance`."""


def read_rig(path: Path) -> Rig:
    """The exact calibration of the simulation (``calib.yaml``).

    Its time offset is OpenVINS': t_imu = t_camera + offset, which is ours.
    """
    content = read_yaml(path)
    offset = content.get("cam_imu_time_offset_s")
    offset_s = 0.0 if offset is None else offset.number()
    cameras = []
    for entry in content.require("cameras").elements():
        name = f"cam{entry.require('id').text()}"
        pose = entry.require("T_imu_cam").pose()
        cameras.append(RigCamera(read_camera(entry), pose, offset_s, name))
    if not cameras:
        raise DataError(f"{path}: no cameras in this file")
    imu = content.require("imu")
    noise = ImuNoise(
        gyro_noise_density=imu.require("gyro_noise_density").number(),
        gyro_random_walk=imu.require("gyro_random_walk").number(),
        accel_noise_density=imu.require("accel_noise_density").number(),
        accel_random_walk=imu.require("accel_random_walk").number(),
        rate_hz=imu.require("rate_hz").number(),
    )
    return Rig(tuple(cameras), noise)


def read_states(path: Path) -> Trajectory:
    """States over time: rows of time, position, quaternion x y z w, velocity and biases.

    Raises:
        DataError: if the file is missing or empty, or a row cannot be read.
    """
    blocks = [_parse_states(rows) for rows in read_rows(path)]
    if not blocks:
        raise DataError(f"{path}: no data rows in this file")
    stamps = np.concatenate([block[0] for block in blocks])
    values = np.concatenate([block[1] for block in blocks])
    return Trajectory(
        stamps,
        values[:, :3].copy(),
        values[:, 3:7] / np.linalg.norm(values[:, 3:7], axis=1, keepdims=True),
        values[:, 7:10].copy(),
        values[:, 10:13].copy(),
        values[:, 13:].copy(),
    )


def read_start(path: Path) -> NavState:
    """The start state, and how well it is known, from ``init_state.csv``."""
    states = read_states(path)
    assert states.velocities is not None
    assert states.gyro_biases is not None
    assert states.accel_biases is not None
    return NavState(
        stamp_ns=int(states.stamps_ns[0]),
        world_T_body=states.pose(0),
        velocity=states.velocities[0],
        gyro_bias=states.gyro_biases[0],
        accel_bias=states.accel_biases[0],
        covariance=_prior_covariance(path.read_text(encoding="utf-8")),
    )


def _parse_states(rows: Rows) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps (N,) in ns and values (N, 16): p, q, v, gyro bias, accel bias."""
    table = parse(rows, STATE_ROW, STATE_COLUMNS)
    return stamps_from_seconds(rows, table["stamp"]), table["values"]


def _prior_covariance(text: str) -> NDArray[np.float64]:
    """(15, 15) from a comment like ``prior sigma: q 0.017 rad, p 0.05 m, …``."""
    _, _, stated = text.partition("prior sigma")
    sigmas = DEFAULT_SIGMAS | {
        name: float(value)
        for name, value in re.findall(r"\b(q|p|v|bg|ba) ([0-9.]+(?:e[-+]?\d+)?)", stated)
    }
    return np.diag(np.repeat([sigmas[name] ** 2 for name in COVARIANCE_ORDER], 3))
