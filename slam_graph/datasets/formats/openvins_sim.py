# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements written by OpenVINS: tracks, IMU, exact calibration and start state.

The folder holds ``calib.yaml``, ``imu.csv`` and ``tracks.csv`` (raw, distorted pixels), and may
hold ``groundtruth.csv`` and ``init_state.csv``. Times are seconds with nine decimals, read as text
so that no nanosecond is lost. Quaternions are x y z w of `world_R_body`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.calibration.calibration_yaml import read_yaml
from slam_graph.datasets.calibration.euroc_calibration import read_camera
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.groundtruth import usable_states
from slam_graph.datasets.sequence import (
    FrameStream,
    ReaderOptions,
    RecordedSequence,
    SequenceInfo,
)
from slam_graph.datasets.streams.csv_rows import (
    STAMP_TEXT,
    Rows,
    count_rows,
    read_rows,
    require_rows,
    stamp_from_seconds,
    stamps_from_seconds,
)
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.datasets.streams.track_frames import (
    TRACK_ROW,
    StampCounter,
    TrackTable,
    frames_from_tables,
)
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import ImuData, ImuNoise, Rig, RigCamera

_STATE_ROW = [("stamp", STAMP_TEXT), ("values", "f8", (16,))]
_STATE_COLUMNS = "time [s], position, quaternion xyzw, velocity, gyro bias, accel bias"

_DEFAULT_SIGMAS = {"q": 0.017, "p": 0.05, "v": 0.01, "bg": 0.02, "ba": 0.02}
"""Standard deviations of the start state where the file gives none: rad, m, m/s, rad/s, m/s²."""

_COVARIANCE_ORDER = ("q", "p", "v", "ba", "bg")
"""Blocks of `NavState.covariance`."""


_STATED_SIGMA = re.compile(r"\b(q|p|v|bg|ba) ([-+.0-9][^\s,;()]*)")
"""A standard deviation in a comment: a name, and what begins like a number."""


def _read_rig(path: Path) -> Rig:
    """The exact calibration of the simulation (``calib.yaml``).

    Its time offset is OpenVINS': t_imu = t_camera + offset, which is ours.
    """
    content = read_yaml(path)
    offset = content.get("cam_imu_time_offset_s")
    offset_s = 0.0 if offset is None else offset.seconds()
    cameras = []
    for entry in content.require("cameras").elements():
        name = f"cam{entry.require('id').text()}"
        pose = entry.require("T_imu_cam").pose()
        cameras.append(RigCamera(read_camera(entry), pose, offset_s, name))
    if not cameras:
        raise DataError(f"{path}: no cameras in this file")
    imu = content.require("imu")
    noise = ImuNoise(
        gyro_noise_density=imu.require("gyro_noise_density").positive(),
        gyro_random_walk=imu.require("gyro_random_walk").positive(),
        accel_noise_density=imu.require("accel_noise_density").positive(),
        accel_random_walk=imu.require("accel_random_walk").positive(),
        rate_hz=imu.require("rate_hz").positive(),
    )
    return Rig(tuple(cameras), noise)


def _read_states(path: Path, diagnostics: Diagnostics) -> Trajectory:
    """States over time: rows of time, position, quaternion x y z w, velocity and biases.

    Raises:
        DataError: if the file is missing, a row cannot be read, or none can be used.
    """
    stamps, values = usable_states(path, _parse_states, diagnostics)
    return Trajectory(
        stamps,
        values[:, :3].copy(),
        values[:, 3:7] / np.linalg.norm(values[:, 3:7], axis=1, keepdims=True),
        values[:, 7:10].copy(),
        accel_biases=values[:, 13:].copy(),
        gyro_biases=values[:, 10:13].copy(),
    )


def _read_start(path: Path, diagnostics: Diagnostics) -> NavState:
    """The start state, and how well it is known, from ``init_state.csv``.

    Raises:
        DataError: if the file cannot be read, or a standard deviation is no positive number.
    """
    states = _read_states(path, diagnostics)
    assert states.velocities is not None
    assert states.gyro_biases is not None
    assert states.accel_biases is not None
    return NavState(
        stamp_ns=int(states.stamps_ns[0]),
        world_T_body=states.pose(0),
        velocity=states.velocities[0],
        gyro_bias=states.gyro_biases[0],
        accel_bias=states.accel_biases[0],
        covariance=_prior_covariance(path),
    )


def _parse_states(rows: Rows) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps (N,) in ns and values (N, 16): p, q, v, gyro bias, accel bias."""
    table = rows.parse(_STATE_ROW, _STATE_COLUMNS)
    return stamps_from_seconds(rows, table["stamp"]), table["values"]


def _prior_covariance(path: Path) -> NDArray[np.float64]:
    """(15, 15) from a comment like ``prior sigma: q 0.017 rad, p 0.05 m, …``.

    Raises:
        DataError: if a standard deviation is no positive number.
    """
    _, _, text = path.read_text(encoding="utf-8", errors="replace").partition("prior sigma")
    variances = {name: sigma**2 for name, sigma in _DEFAULT_SIGMAS.items()}
    for name, number in _STATED_SIGMA.findall(text.partition("\n")[0]):
        try:
            sigma = float(number.rstrip("."))  # at the end of a sentence
        except ValueError:
            sigma = np.nan
        variances[name] = sigma * sigma
        if not (sigma > 0.0 and 0.0 < variances[name] < np.inf):
            raise DataError(f"{path}: prior sigma of {name}: {number!r} is no positive number")
    return np.diag(np.repeat([variances[name] for name in _COVARIANCE_ORDER], 3))


_ROWS_PER_TRACK_BLOCK = 8192
"""About 16 frames of two cameras: large enough to parse fast, half a megabyte of text."""

IMU_ROW = [("stamp", STAMP_TEXT), ("gyro", "f8", (3,)), ("accel", "f8", (3,))]
_TRACK_COLUMNS = [("stamp", STAMP_TEXT), ("camera", "i8"), ("id", "i8"), ("pixel", "f8", (2,))]


class OpenvinsSimulation(RecordedSequence):
    """A folder of simulated measurements with exact calibration and start.

    Args:
        path: the folder.
        options: what else is asked for.

    Raises:
        DataError: if a file is missing, or a row cannot be read.
    """

    format: ClassVar[str] = "openvins_sim"
    content: ClassVar[Literal["images", "tracks"]] = "tracks"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path
        chain = options.calibration
        own_file = path / "calib.yaml"
        if chain is None:
            rig = _read_rig(own_file)
        else:
            noise = _read_rig(own_file).imu if own_file.is_file() else None
            rig = read_kalibr(chain, fallback=noise, diagnostics=options.diagnostics)
        self._known_cameras = len(rig.cameras)
        truth = path / "groundtruth.csv"
        own = partial(_read_states, truth, options.diagnostics) if truth.is_file() else None
        super().__init__(path.resolve().name, options.select(rig), options, own)
        self._tracks, self._imu_file = path / "tracks.csv", path / "imu.csv"
        for file in (self._tracks, self._imu_file):
            require_rows(file)

    def measure(self) -> SequenceInfo:
        """Count frames and IMU samples in one pass over the files."""
        counter, latest = StampCounter(), ""
        for rows in read_rows(self._tracks, _ROWS_PER_TRACK_BLOCK):
            for k, line in enumerate(rows.lines):
                text = line.partition(",")[0]
                if text != latest:
                    counter.add(stamp_from_seconds(text, rows, k))
                    latest = text
        samples = count_rows(self._imu_file)[0]
        return self.holding(counter.frames, counter.first_ns, counter.latest_ns, samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on."""
        blocks = ((rows.where, _parse_imu(rows)) for rows in read_rows(self._imu_file))
        return clean_blocks(blocks, self.diagnostics, after_ns)

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """Feature frames, with the normalised coordinates of the raw pixels."""
        tables = self._tables(start_ns, end_ns)
        return frames_from_tables(
            tables, len(self.rig.cameras), self.diagnostics, str(self._tracks)
        )

    def initial_state(self) -> NavState | None:
        """The start state of ``init_state.csv``, with the covariance that its comment gives."""
        file = self.path / "init_state.csv"
        return _read_start(file, self.diagnostics) if file.is_file() else None

    def _tables(self, start_ns: int | None, end_ns: int | None) -> Iterator[TrackTable]:
        for rows in read_rows(self._tracks, _ROWS_PER_TRACK_BLOCK):
            parsed = rows.parse(_TRACK_COLUMNS, "time [s], camera, feature, u, v")
            unknown = (parsed["camera"] < 0) | (parsed["camera"] >= self._known_cameras)
            if unknown.any():
                raise DataError(
                    f"{rows.where(int(unknown.argmax()))}: camera {parsed['camera'][unknown][0]}, "
                    f"but the calibration has {self._known_cameras}, counted from 0"
                )
            stamps = stamps_from_seconds(rows, parsed["stamp"])
            inside = self.within(stamps, start_ns, end_ns)
            table = np.zeros(int(inside.sum()), TRACK_ROW)
            table["stamp"] = stamps[inside]
            for name in ("camera", "id", "pixel"):
                table[name] = parsed[name][inside]
            yield self._undistort(table)
            if end_ns is not None and stamps[-1] > end_ns:
                return

    def _undistort(self, table: TrackTable) -> TrackTable:
        for index, mounted in enumerate(self.rig.cameras):
            mine = table["camera"] == index
            table["normalized"][mine] = mounted.camera.undistort(table["pixel"][mine])
        return table


def _parse_imu(rows: Rows) -> ImuData:
    table = rows.parse(IMU_ROW, "time [s], gyro xyz, accel xyz")
    return ImuData(stamps_from_seconds(rows, table["stamp"]), table["gyro"], table["accel"])
