# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements dumped from OpenVINS: tracks, IMU, exact calibration and start state.

The folder holds ``calib.yaml``, ``imu.csv`` and ``tracks.csv`` (raw, distorted pixels), and may
hold ``groundtruth.csv`` and ``init_state.csv``. Times are seconds with nine decimals, read as text
so that no nanosecond is lost. Quaternions are x y z w of `world_R_body`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from slam_graph.datasets.imu_stream import clean_blocks
from slam_graph.datasets.openvins_files import read_rig, read_start, read_states
from slam_graph.datasets.packets import FrameStream
from slam_graph.datasets.recorded import Extent, RecordedSequence, within
from slam_graph.datasets.rows import (
    STAMP_TEXT,
    Rows,
    count_rows,
    parse,
    read_rows,
    require_rows,
    stamp_from_seconds,
    stamps_from_seconds,
)
from slam_graph.datasets.track_frames import (
    TRACK_ROW,
    StampCounter,
    TrackTable,
    frames_from_tables,
)
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.sensors.kalibr import read_kalibr
from slam_graph.sensors.measurements import ImuData

ROWS_PER_TRACK_BLOCK = 8192
"""Some 16 frames of two cameras: large enough for fast parsing, half a megabyte of text."""

IMU_ROW = [("stamp", STAMP_TEXT), ("gyro", "f8", (3,)), ("accel", "f8", (3,))]
TRACK_COLUMNS = [("stamp", STAMP_TEXT), ("camera", "i8"), ("id", "i8"), ("pixel", "f8", (2,))]


class OpenvinsSimulation(RecordedSequence):
    """A folder of simulated measurements with exact calibration and start.

    Args:
        path: the folder.
        cameras: use only the first so many.
        calibration: a Kalibr camera chain to use instead of ``calib.yaml``.
        groundtruth: file or folder to use instead of ``groundtruth.csv``.
        diagnostics: where faults are counted.

    Raises:
        DataError: if a file is missing, or a row cannot be read.
    """

    format: ClassVar[str] = "openvins_sim"
    content: ClassVar[Literal["images", "tracks"]] = "tracks"

    def __init__(
        self,
        path: Path,
        cameras: int | None = None,
        calibration: Path | None = None,
        groundtruth: Path | None = None,
        diagnostics: Diagnostics | None = None,
    ) -> None:
        self.path = path
        rig = read_rig(path / "calib.yaml") if calibration is None else read_kalibr(calibration)
        self._known_cameras = len(rig.cameras)
        rig = rig if cameras is None else rig.select(cameras)
        super().__init__(path.resolve().name, rig, groundtruth, diagnostics)
        own = path / "groundtruth.csv"
        self._own_groundtruth = own if groundtruth is None and own.is_file() else None
        self._tracks, self._imu_file = path / "tracks.csv", path / "imu.csv"
        for file in (self._tracks, self._imu_file):
            require_rows(file)

    @property
    def has_groundtruth(self) -> bool:
        """Whether `groundtruth()` gives one."""
        return self._own_groundtruth is not None or super().has_groundtruth

    def measure(self) -> Extent:
        """Count frames and IMU samples in one pass over the files."""
        counter, latest = StampCounter(), ""
        for rows in read_rows(self._tracks, ROWS_PER_TRACK_BLOCK):
            for k, line in enumerate(rows.lines):
                text = line.partition(",")[0]
                if text != latest:
                    counter.add(stamp_from_seconds(text, rows, k))
                    latest = text
        samples = count_rows(self._imu_file)[0]
        return Extent(counter.frames, counter.first_ns, counter.latest_ns, samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on."""
        blocks = ((rows, _parse_imu(rows)) for rows in read_rows(self._imu_file))
        return clean_blocks(blocks, self.diagnostics, after_ns)

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """Feature frames, with the normalised coordinates of the raw pixels."""
        tables = self._tables(start_ns, end_ns)
        return frames_from_tables(
            tables, len(self.rig.cameras), self.diagnostics, str(self._tracks)
        )

    def groundtruth(self) -> Trajectory | None:
        """The simulated truth: poses, velocities and biases."""
        if self._own_groundtruth is None:
            return super().groundtruth()
        return read_states(self._own_groundtruth)

    def initial_state(self) -> NavState | None:
        """The start state of ``init_state.csv``, with the prior that its comment states."""
        file = self.path / "init_state.csv"
        return read_start(file) if file.is_file() else None

    def _tables(self, start_ns: int | None, end_ns: int | None) -> Iterator[TrackTable]:
        for rows in read_rows(self._tracks, ROWS_PER_TRACK_BLOCK):
            parsed = parse(rows, TRACK_COLUMNS, "time [s], camera, feature, u, v")
            unknown = (parsed["camera"] < 0) | (parsed["camera"] >= self._known_cameras)
            if unknown.any():
                raise DataError(
                    f"{rows.where(int(unknown.argmax()))}: camera {parsed['camera'][unknown][0]}, "
                    f"but the calibration has {self._known_cameras}, counted from 0"
                )
            stamps = stamps_from_seconds(rows, parsed["stamp"])
            inside = within(stamps, start_ns, end_ns)
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
    table = parse(rows, IMU_ROW, "time [s], gyro xyz, accel xyz")
    return ImuData(stamps_from_seconds(rows, table["stamp"]), table["gyro"], table["accel"])
