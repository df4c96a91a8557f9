# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""KITTI raw data: grey stereo images and the navigation unit (oxts) as IMU and ground truth.

Geiger et al., "Vision meets robotics: The KITTI dataset", IJRR 2013. A drive comes in two forms: in
``…_sync`` the images are rectified and the unit is sampled with them at 10 Hz, in ``…_extract`` the
images are as they were taken and the unit has its 100 Hz. The calibration is in the folder of the
day, beside the drives.

Each sample of the navigation unit is a file of 30 numbers, of which these are read (counted from
0): latitude, longitude [deg] and altitude [m] (0 to 2); roll, pitch, yaw [rad] (3 to 5; yaw is 0
towards east, counterclockwise); velocity to north and east, and upwards [m/s] (6, 7, 10); specific
force x y z [m/s²] (11 to 13) and angular rate x y z [rad/s] (17 to 19) along the axes of the unit:
x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.datasets.calibration.euroc_calibration import check_size
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.formats.kitti_files import (
    CalibrationFile,
    increasing,
    read_calibration,
    read_dates,
    rectified_camera,
)
from slam_graph.datasets.formats.tum_rgbd import rectifier
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.aiding_files import (
    LARGEST_GEODETIC,
    covariances_of,
    fixes_from,
)
from slam_graph.datasets.streams.image_sequence import ImageSequence
from slam_graph.datasets.streams.images import Fault, FileImages, Image
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import Trajectory
from slam_graph.sensors import AidingData, ImuData, ImuNoise, Rig, RigCamera

_EARTH_RADIUS_M = 6_378_137.0

_VALUES = 30
POSITION, ANGLES, ACCEL, GYRO = slice(0, 3), slice(3, 6), slice(11, 14), slice(17, 20)
_EAST_NORTH_UP, _ACCURACY = [7, 6, 10], 23

_FILES_PER_BLOCK = 256


class _Oxts:
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

    def blocks(self, diagnostics: Diagnostics, after_ns: int | None) -> Iterator[ImuData]:
        """The cleaned IMU stream; a sample without a file is not finite."""
        return clean_blocks(self._samples_in_blocks(after_ns), diagnostics, after_ns)

    def count(self) -> int:
        """Number of samples, before faulty ones are dropped."""
        return len(self.stamps_ns)

    def ends_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last sample."""
        return int(self.stamps_ns[0]), int(self.stamps_ns[-1])

    def _samples_in_blocks(
        self, after_ns: int | None
    ) -> Iterator[tuple[Callable[[int], str], ImuData]]:
        for begin in range(0, len(self.stamps_ns), _FILES_PER_BLOCK):
            stamps = self.stamps_ns[begin : begin + _FILES_PER_BLOCK]
            if after_ns is not None and np.all(stamps < after_ns):
                continue
            files = [self._file(begin + k) for k in range(len(stamps))]
            values = np.array([self._read(begin + k) for k in range(len(stamps))])
            data = ImuData(stamps, values[:, GYRO].copy(), values[:, ACCEL].copy())
            yield partial(_file_name, files), data

    def fixes(self, diagnostics: Diagnostics) -> AidingData:
        """The positions of the unit as fixes, with the accuracy that it says (value 23), m."""
        values = np.array([self._read(k) for k in range(len(self.stamps_ns))])
        sigmas = np.repeat(values[:, _ACCURACY, None], 3, axis=1)
        found = self.stamps_ns, values[:, POSITION], covariances_of(sigmas)
        return fixes_from(*found, self.folder, diagnostics)

    def trajectory(self, diagnostics: Diagnostics) -> Trajectory:
        """Poses of the unit in a frame east, north, up with its origin at the first pose.

        Positions are Mercator coordinates scaled for the first latitude, as in KITTI's own tools.
        """
        stamps_ns = self.stamps_ns
        values = np.array([self._read(k) for k in range(len(stamps_ns))])
        on_earth = (np.abs(values[:, POSITION]) <= LARGEST_GEODETIC).all(axis=1)
        whole = np.flatnonzero(Files.are_measurable(values).all(axis=1) & on_earth)
        for k in np.setdiff1d(np.arange(len(values)), whole):
            diagnostics.warn("groundtruth_not_finite", f"{self.where(int(k))}: no pose")
        timestamps = self.folder / "timestamps.txt"
        kept = whole[
            increasing(stamps_ns[whole], "groundtruth_out_of_order", timestamps, diagnostics)
        ]
        if len(kept) == 0:
            raise DataError(f"{self.folder}: no pose in these files")
        values = values[kept]
        positions = _mercator(values[:, POSITION])
        rotations = Rotation.from_euler("ZYX", values[:, ANGLES][:, ::-1])
        return Trajectory(
            stamps_ns[kept],
            positions - positions[0],
            rotations.as_quat(),
            values[:, _EAST_NORTH_UP].copy(),
        )

    def _file(self, index: int) -> Path:
        return self.folder / "data" / f"{index:010d}.txt"

    def _read(self, index: int) -> FloatArray:
        """The 30 numbers of a sample, or NaN where its file is missing."""
        path = self._file(index)
        try:
            values = [float(text) for text in path.read_text(encoding="ascii").split()]
        except FileNotFoundError:
            return np.full(_VALUES, np.nan)
        except (OSError, ValueError):
            values = []
        if len(values) != _VALUES:
            raise DataError(f"{path}: expected {_VALUES} numbers, as KITTI's oxts files have")
        return np.array(values)


def _file_name(files: Sequence[Path], index: int) -> str:
    return str(files[index])


def _mercator(places: FloatArray) -> FloatArray:
    """Positions (N, 3) east, north, up [m] of latitude, longitude [deg] and altitude [m] (N, 3)."""
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    scale = _EARTH_RADIUS_M * np.cos(latitude[0])
    north = scale * np.log(np.tan(np.pi / 4 + latitude / 2))
    return np.column_stack([scale * longitude, north, places[:, 2]])


_OXTS = "oxts"
"""The source of ``gnss`` that takes the positions of the navigation unit; its poses are the ground
truth, so they are not taken unasked."""

GREY = ("00", "01")
"""The grey cameras; 02 and 03 are in colour."""

STEREO_TOLERANCE_S = 0.02
"""The cameras are triggered together, 10 times a second; their stamps are the computer's."""

_MOST_PIXELS = 16
"""Rectified images have at most so many times the pixels of those that were taken."""

_LEAST_HZ = 0.1
"""Rate of the IMU where its samples do not show one."""
_SLOW_IMU_HZ = 50.0

NOISE = {
    "gyro_noise_density": 5e-4,
    "gyro_random_walk": 1e-5,
    "accel_noise_density": 1e-2,
    "accel_random_walk": 1e-4,
}
"""Assumed, because KITTI gives none: well above the data sheet of the unit (OXTS RT3003), for the
vibration of a car."""


def is_kitti_raw(path: Path) -> bool:
    """Whether this is the folder of a drive."""
    return (path / "oxts").is_dir() and (path / "image_00").is_dir()


class KittiRawSequence(ImageSequence):
    """A drive of KITTI's raw data, with the body frame of its navigation unit.

    The images of ``…_extract`` are rectified as they are read. A drive ``…_sync`` takes the IMU at
    100 Hz from ``…_extract`` beside it, if that is there; otherwise its own 10 Hz are counted as
    `imu_slow`.

    Args:
        path: folder of the drive, with ``image_00``, ``image_01`` and ``oxts``.
        options: what else is asked for; a calibration is that of the rectified images.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "kitti_raw"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path.resolve()
        self._oxts = _find_oxts(self.path)
        streams = [
            _images(self.path, camera, options.diagnostics)
            for camera in GREY
            if (self.path / f"image_{camera}").is_dir()
        ]
        day = self.path.parent
        noise = ImuNoise(**NOISE, rate_hz=max(self._oxts.rate_hz, _LEAST_HZ))
        chain = options.calibration
        if chain is not None:
            rig = read_kalibr(chain, fallback=noise)
        else:
            rig = _read_rig(day, len(streams), noise)
        rig = options.select(rig)
        if len(rig.cameras) > len(streams):
            raise DataError(f"{chain}: {len(rig.cameras)} cameras, {path} has {len(streams)}")
        for camera, stream in zip(GREY, streams, strict=False):
            stream.process = _rectification(day, camera, stream)
        used = streams[: len(rig.cameras)]
        super().__init__(
            self.path.name,
            rig,
            used,
            self._oxts,
            options,
            lambda: self._oxts.trajectory(self.diagnostics),
            STEREO_TOLERANCE_S,
        )
        self._has_fixes = self.named_aiding.get("gnss") == _OXTS
        if self._has_fixes:
            del self.named_aiding["gnss"]
        if self._oxts.rate_hz < _SLOW_IMU_HZ:
            what = f"{self._oxts.folder}: the IMU has {self._oxts.rate_hz:.0f} Hz only"
            better = self.path.name.replace("_sync", "_extract")
            options.diagnostics.warn(
                "imu_slow", f"{what}; {better} has 100 Hz, put it beside this drive"
            )

    def read_aiding(self) -> AidingData:
        """Fixes of the navigation unit if ``gnss=oxts`` was asked for, or those of files."""
        data = super().read_aiding()
        if not self._has_fixes:
            return data
        odometry = data.without_fixes()
        return AidingData.concatenate([odometry, self._oxts.fixes(self.diagnostics)])


def _find_oxts(drive: Path) -> _Oxts:
    """The navigation unit at its full rate, if the ``…_extract`` form of a drive is beside it."""
    extract = drive.with_name(drive.name.replace("_sync", "_extract")) / "oxts"
    return _Oxts(extract if (extract / "timestamps.txt").is_file() else drive / "oxts")


def _images(drive: Path, camera: str, diagnostics: Diagnostics) -> FileImages:
    folder = drive / f"image_{camera}"
    stamps = read_dates(folder / "timestamps.txt")
    kept = increasing(stamps, "camera_out_of_order", folder / "timestamps.txt", diagnostics)
    paths = [folder / "data" / f"{k:010d}.png" for k in kept]
    return FileImages(folder.name, stamps[kept], paths)


def _read_rig(day: Path, count: int, noise: ImuNoise) -> Rig:
    """The rectified cameras in the frame of the navigation unit."""
    between = read_calibration(day / "calib_cam_to_cam.txt")
    velo_T_imu = read_calibration(day / "calib_imu_to_velo.txt").pose()
    cam0_T_velo = read_calibration(day / "calib_velo_to_cam.txt").pose()
    rectified_T_cam0 = CalibrationFile(
        between.path, {"R": between.numbers("R_rect_00", 9).tolist(), "T": [0.0, 0.0, 0.0]}
    ).pose()
    rectified_T_imu = rectified_T_cam0.compose(cam0_T_velo).compose(velo_T_imu)
    mounted = []
    for name in GREY[:count]:
        projection = between.numbers(f"P_rect_{name}", 12).reshape(3, 4)
        size, where = _size(between, f"S_rect_{name}"), f"{between.path}: line 'P_rect_{name}:'"
        camera, camera_T_rectified = rectified_camera(projection, *size, where)
        body_T_camera = camera_T_rectified.compose(rectified_T_imu).inverse()
        mounted.append(RigCamera(camera, body_T_camera, 0.0, f"image_{name}"))
    return Rig(tuple(mounted), noise)


def _rectification(day: Path, camera: str, stream: FileImages) -> Callable[[Image], Image] | None:
    """How the images of a camera are rectified; None if they are already."""
    path = day / "calib_cam_to_cam.txt"
    first = stream.read(0)
    if isinstance(first, Fault) or not path.is_file():
        return None
    calibration = read_calibration(path)
    taken, rectified = (_size(calibration, f"{key}_{camera}") for key in ("S", "S_rect"))
    if first.shape[::-1] == rectified or first.shape[::-1] != taken:
        return None
    if rectified[0] * rectified[1] > _MOST_PIXELS * taken[0] * taken[1]:
        raise DataError(
            f"{path}: line 'S_rect_{camera}:' makes images of {rectified[0]}x{rectified[1]} from "
            f"ones of {taken[0]}x{taken[1]}; correct the calibration, or give --calibration"
        )
    return rectifier(
        calibration.numbers(f"K_{camera}", 9).reshape(3, 3),
        calibration.numbers(f"D_{camera}", 5),
        calibration.numbers(f"R_rect_{camera}", 9).reshape(3, 3),
        calibration.numbers(f"P_rect_{camera}", 12).reshape(3, 4)[:, :3],
        taken,
        rectified,
    )


def _size(calibration: CalibrationFile, key: str) -> tuple[int, int]:
    width, height = calibration.numbers(key, 2).tolist()
    check_size((width, height), f"{calibration.path}: line '{key}:'")
    return int(width), int(height)
