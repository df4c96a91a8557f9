# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The inertial and satellite navigation unit of KITTI's raw data: its IMU, and its poses.

Each sample is a file of 30 numbers. Of them are read (from 0): latitude, longitude [deg] and
altitude [m] (0 to 2); roll, pitch, yaw [rad] (3 to 5; yaw is 0 towards east, counterclockwise);
velocity to north and east, and upwards [m/s] (6, 7, 10); specific force x y z [m/s²] (11 to 13) and
angular rate x y z [rad/s] (17 to 19) along the axes of the unit: x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.datasets.imu_stream import ImuCleaner
from slam_graph.datasets.kitti_files import increasing, read_dates
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.sensors.measurements import ImuData

FloatArray = NDArray[np.float64]

EARTH_RADIUS_M = 6_378_137.0

VALUES = 30
POSITION, ANGLES, ACCEL, GYRO = slice(0, 3), slice(3, 6), slice(11, 14), slice(17, 20)
EAST_NORTH_UP = [7, 6, 10]

FILES_PER_BLOCK = 256


class Oxts:
    """A folder ``oxts`` with ``timestamps.txt`` and a file for each sample in ``data``.

    Attributes:
        folder: the folder.
        stamps_ns: (N,) of the samples, in the order of the file.

    Raises:
        DataError: if the time stamps cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stamps_ns = read_dates(folder / "timestamps.txt")

    @property
    def rate_hz(self) -> float:
        """Median rate of the samples."""
        periods = np.diff(self.stamps_ns)
        return 1e9 / max(float(np.median(periods)), 1.0) if len(periods) else 0.0

    def where(self, index: int) -> str:
        """The file of a sample."""
        return str(self._file(index))

    def imu_blocks(self, diagnostics: Diagnostics, after_ns: int | None) -> Iterator[ImuData]:
        """The cleaned IMU stream; a sample without a file is not finite."""
        cleaner = ImuCleaner(diagnostics, after_ns)
        for begin in range(0, len(self.stamps_ns), FILES_PER_BLOCK):
            stamps = self.stamps_ns[begin : begin + FILES_PER_BLOCK]
            if after_ns is not None and np.all(stamps < after_ns):
                continue
            values = np.array([self._read(begin + k) for k in range(len(stamps))])
            data = ImuData(stamps, values[:, GYRO].copy(), values[:, ACCEL].copy())
            cleaned = cleaner.clean(data, lambda k, begin=begin: self.where(begin + k))  # type: ignore[misc]
            if len(cleaned):
                yield cleaned

    def trajectory(self, diagnostics: Diagnostics) -> Trajectory:
        """Poses of the unit in a world east, north, up with its origin at the first pose.

        Positions are Mercator's, scaled to be true at the first latitude, as KITTI's own tools do.
        """
        stamps_ns = self.stamps_ns
        values = np.array([self._read(k) for k in range(len(stamps_ns))])
        whole = np.flatnonzero(np.isfinite(values).all(axis=1))
        for k in np.setdiff1d(np.arange(len(values)), whole):
            diagnostics.warn("groundtruth_not_finite", f"{self.where(int(k))}: no pose")
        timestamps = self.folder / "timestamps.txt"
        kept = whole[
            increasing(stamps_ns[whole], "groundtruth_out_of_order", timestamps, diagnostics)
        ]
        if len(kept) == 0:
            raise DataError(f"{self.folder}: no pose in these files")
        values = values[kept]
        positions = mercator(values[:, POSITION])
        rotations = Rotation.from_euler("ZYX", values[:, ANGLES][:, ::-1])
        return Trajectory(
            stamps_ns[kept],
            positions - positions[0],
            rotations.as_quat(),
            values[:, EAST_NORTH_UP].copy(),
        )

    def _file(self, index: int) -> Path:
        return self.folder / "data" / f"{index:010d}.txt"

    def _read(self, index: int) -> FloatArray:
        """The 30 numbers of a sample, or NaN where its file is missing."""
        path = self._file(index)
        try:
            values = [float(text) for text in path.read_text(encoding="ascii").split()]
        except FileNotFoundError:
            return np.full(VALUES, np.nan)
        except (OSError, ValueError):
            values = []
        if len(values) != VALUES:
            raise DataError(f"{path}: expected {VALUES} numbers, as KITTI's oxts files have")
        return np.array(values)


def mercator(places: FloatArray) -> FloatArray:
    """Positions (N, 3) east, north, up [m] of latitude, longitude [deg] and altitude [m] (N, 3)."""
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    scale = EARTH_RADIUS_M * np.cos(latitude[0])
    north = scale * np.log(np.tan(np.pi / 4 + latitude / 2))
    return np.column_stack([scale * longitude, north, places[:, 2]])
