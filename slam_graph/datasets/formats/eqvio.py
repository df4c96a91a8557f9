# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The feature tracks in GTSAM's wheel: one CSV file with tracks, IMU and calibration.

``gtsam/Data/eqvio_processed_30s.csv`` holds the first 30 s of EuRoC V1_01_easy: the tracks of the
left camera at 20 Hz, already undistorted, and the IMU at 200 Hz. Rows begin with their type:

- ``meta`` rows give keys and values, among them `camera_fx` … `camera_cy` and the pose `T_ci_*`,
  which is `body_T_camera` (it equals the `T_BS` of EuRoC's ``cam0/sensor.yaml``);
- ``imu`` rows give rates and specific forces as measured. Their bias columns, all zero, are not
  read;
- ``vision_feature`` rows give a landmark's id and normalised coordinates.

Times are float64 seconds with a resolution of 0.24 µs. They are rounded to whole microseconds, in
which the recorder's clock counted, and agree with EuRoC's own stamps to 0.2 µs.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.calibration.calibration_yaml import pose_from_matrix
from slam_graph.datasets.calibration.euroc_calibration import lens
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.sequence import (
    FrameStream,
    ReaderOptions,
    RecordedSequence,
    SequenceInfo,
)
from slam_graph.datasets.streams.csv_rows import (
    STAMP_TEXT,
    Rows,
    read_rows,
    stamps_from_seconds,
)
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.datasets.streams.track_frames import (
    TRACK_ROW,
    StampCounter,
    TrackTable,
    frames_from_tables,
)
from slam_graph.datasets.streams.vector_lengths import lengths_of
from slam_graph.errors import DataError
from slam_graph.sensors import CAMERA_MODELS, ImuData, ImuNoise, Rig, RigCamera

HEADER = "row_type,"
META_PREFIX, IMU_PREFIX, FEATURE_PREFIX = "meta,", "imu,", "vision_feature,"

_QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of the length of the calibration's quaternion from one."""

DEMO = "demo"
"""The name of the recording that comes with GTSAM."""

_RESOLUTION = (752, 480)
"""Of EuRoC's cameras; it is not in the file."""

IMU_COLUMNS = (1, 6, 7, 8, 9, 10, 11)
IMU_ROW = [("stamp", STAMP_TEXT), ("gyro", "f8", (3,)), ("accel", "f8", (3,))]
_FEATURE_COLUMNS = (1, 5, 18, 19)
_FEATURE_ROW = [("stamp", STAMP_TEXT), ("id", "i8"), ("normalized", "f8", (2,))]


def wheel_tracks() -> Path:
    """The file of tracks that comes with GTSAM."""
    return Path(gtsam.__file__).parent / "Data" / "eqvio_processed_30s.csv"


def is_eqvio_file(path: Path) -> bool:
    """Whether a file is of this kind, by its first bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(HEADER)) == HEADER.encode()


class EqvioTracks(RecordedSequence):
    """The tracks in GTSAM's wheel, or another file of this kind.

    Args:
        path: the CSV file; it has one camera and no ground truth.
        options: what else is asked for.

    Raises:
        DataError: if the file is missing, or a row cannot be read.
    """

    format: ClassVar[str] = "eqvio"
    content: ClassVar[Literal["images", "tracks"]] = "tracks"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path
        chain = options.calibration
        rig = _read_rig(path) if chain is None else read_kalibr(chain).select(1)
        name = DEMO if path.resolve() == wheel_tracks().resolve() else path.stem
        super().__init__(name, options.select(rig), options)

    def measure(self) -> SequenceInfo:
        """Count frames and IMU samples in one pass over the file."""
        counter, samples = StampCounter(), 0
        for rows in read_rows(self.path):
            for stamp in _parse_features(rows)["stamp"].tolist():
                counter.add(stamp)
            samples += len(rows.select(IMU_PREFIX).lines)
        return self.holding(counter.frames, counter.first_ns, counter.latest_ns, samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on."""
        selected = (rows.select(IMU_PREFIX) for rows in read_rows(self.path))
        blocks = ((rows.where, _parse_imu(rows)) for rows in selected)
        return clean_blocks(blocks, self.diagnostics, after_ns)

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """Feature frames; pixels follow from the normalised coordinates and the calibration."""
        tables = self._tables(start_ns, end_ns)
        return frames_from_tables(tables, 1, self.diagnostics, str(self.path))

    def _tables(self, start_ns: int | None, end_ns: int | None) -> Iterator[TrackTable]:
        camera = self.rig.cameras[0].camera
        for rows in read_rows(self.path):
            table = _parse_features(rows)
            table = table[self.within(table["stamp"], start_ns, end_ns)]
            with np.errstate(all="ignore"):  # what is too far is left out later
                table["pixel"] = camera.distort(table["normalized"])[0]
            yield table


def _stamps(rows: Rows, texts: NDArray[np.bytes_]) -> NDArray[np.int64]:
    """Stamps (N,) in ns, rounded to whole microseconds."""
    return (stamps_from_seconds(rows, texts) + 500) // 1000 * 1000


def _parse_imu(rows: Rows) -> ImuData:
    table = rows.parse(IMU_ROW, "an imu row", IMU_COLUMNS)
    return ImuData(_stamps(rows, table["stamp"]), table["gyro"], table["accel"])


def _parse_features(rows: Rows) -> TrackTable:
    """The tracks among some rows, without their pixels."""
    rows = rows.select(FEATURE_PREFIX)
    parsed = rows.parse(_FEATURE_ROW, "a vision_feature row", _FEATURE_COLUMNS)
    table = np.zeros(len(parsed), TRACK_ROW)
    table["stamp"] = _stamps(rows, parsed["stamp"])
    table["id"] = parsed["id"]
    table["normalized"] = parsed["normalized"]
    return table


class _Meta:
    """Keys and values of the meta rows.

    Attributes:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values: dict[str, tuple[str, str]] = {}
        for rows in read_rows(path):
            meta = rows.select(META_PREFIX)
            for k, line in enumerate(meta.lines):
                *_, key, value = line.strip().split(",")
                self._values[key] = (value, meta.where(k))
            if len(meta.lines) < len(rows.lines):
                return

    def text(self, key: str) -> tuple[str, str]:
        """Value of a key, and file and line of it."""
        if key not in self._values:
            raise DataError(f"{self.path}: no meta row with the key '{key}' in this file")
        return self._values[key]

    def numbers(self, prefix: str, keys: str) -> list[float]:
        """Values of keys with a common prefix."""
        values = []
        for key in keys.split():
            text, where = self.text(prefix + key)
            try:
                values.append(float(text))
            except ValueError:
                raise DataError(f"{where}: '{text}' is not a number ({prefix}{key})") from None
        return values


def _read_rig(path: Path) -> Rig:
    meta = _Meta(path)
    space, where = meta.text("measurement_space")
    if space != "normalized":
        raise DataError(f"{where}: measurement_space is '{space}'; only 'normalized' can be read")
    fx, fy, cx, cy = meta.numbers("camera_", "fx fy cx cy")
    where = f"{path}: camera_fx to camera_cy"
    camera = lens(CAMERA_MODELS["none"](), (fx, fy, cx, cy), (), _RESOLUTION, where)
    quaternion = np.array(meta.numbers("T_ci_", "qw qx qy qz"))
    length = float(lengths_of(quaternion[None])[0])
    if not abs(length - 1.0) < _QUATERNION_TOLERANCE:
        raise DataError(f"{path}: T_ci is not a rotation, its quaternion has length {length:.4g}")
    matrix = np.eye(4)
    matrix[:3, :3] = gtsam.Rot3.Quaternion(*(quaternion / length)).matrix()
    matrix[:3, 3] = meta.numbers("T_ci_", "tx ty tz")
    body_T_camera = pose_from_matrix(matrix, f"{path}: T_ci")
    return Rig((RigCamera(camera, body_T_camera, 0.0, "cam0"),), ImuNoise())
