# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The text files of KITTI: calibrations of lines ``key: numbers``, and time stamps."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.datasets.calibration.calibration_yaml import pose_from_matrix
from slam_graph.datasets.calibration.euroc_calibration import check_size, lens
from slam_graph.datasets.streams.csv_rows import STAMP_TEXT, read_rows, stamps_from_seconds
from slam_graph.datasets.streams.pairing import in_order
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.sensors import CAMERA_MODELS, Camera

_LARGEST = 1e6
"""Pixels, metres and focal lengths are smaller."""


@dataclass(frozen=True, slots=True)
class CalibrationFile:
    """Lines ``key: numbers`` of a calibration file; those that hold no numbers are left out."""

    path: Path
    values: dict[str, list[float]]

    def numbers(self, key: str, count: int) -> FloatArray:
        """(count,) numbers of a line.

        Raises:
            DataError: if the line is missing, has another number of numbers, or one that is not
                finite or too large.
        """
        if key not in self.values:
            raise DataError(f"{self.path}: missing line '{key}:'")
        if len(self.values[key]) != count:
            got = len(self.values[key])
            raise DataError(f"{self.path}: line '{key}:' has {got} numbers instead of {count}")
        numbers = np.array(self.values[key])
        if not (np.abs(numbers) < _LARGEST).all():  # nor NaN
            raise DataError(f"{self.path}: line '{key}:' has numbers that cannot be true")
        return numbers

    def pose(self) -> gtsam.Pose3:
        """The transformation in the lines ``R`` and ``T``: p_to = R p_from + T."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.numbers("R", 9).reshape(3, 3)
        matrix[:3, 3] = self.numbers("T", 3)
        return pose_from_matrix(matrix, str(self.path))


def read_calibration(path: Path) -> CalibrationFile:
    """Read a calibration file.

    Raises:
        DataError: if it cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise DataError(f"{path}: calibration cannot be read ({error.strerror})") from None
    values = {}
    for line in text.splitlines():
        key, _, numbers = line.partition(":")
        try:
            values[key.strip()] = [float(number) for number in numbers.split()]
        except ValueError:  # the date of the calibration, the distance of its corners
            continue
    return CalibrationFile(path, values)


def rectified_camera(
    projection: FloatArray, width: int, height: int, where: str
) -> tuple[Camera, gtsam.Pose3]:
    """A rectified camera from its projection matrix.

    Args:
        projection: (3, 4) K [I | t], which projects from the frame of the rectified camera 0.
        width: of the rectified images in pixels.
        height: of the rectified images in pixels.
        where: the matrix stands, for the error.

    Returns:
        The camera, and camera_T_camera0.

    Raises:
        DataError: if there is no such camera.
    """
    check_size((width, height), where)
    K = projection[:, :3]
    if min(K[0, 0], K[1, 1], K[2, 2]) <= 0 or np.any(np.tril(K, -1)):
        raise DataError(f"{where}: not the projection of a rectified camera")
    intrinsics = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    camera = lens(CAMERA_MODELS["none"](), intrinsics, (), (width, height), where)
    matrix = np.eye(4)
    with np.errstate(all="ignore"):  # nearly singular: refused for what comes of it
        matrix[:3, 3] = np.linalg.solve(K, projection[:, 3])
    return camera, pose_from_matrix(matrix, where)


def read_dates(path: Path) -> NDArray[np.int64]:
    """Time stamps (N,) in ns from lines like ``2011-09-26 13:02:25.964389445``.

    The files have no time zone; the times are taken as UTC.

    Raises:
        DataError: if one is not a date and time; names file and line.
    """
    stamps: list[int] = []
    for rows in read_rows(path):
        for k, line in enumerate(rows.lines):
            stamp_ns = _nanoseconds(line.strip())
            if stamp_ns is None:
                text = line.strip()[:60]
                raise DataError(f"{rows.where(k)}: '{text}' is not a date and time")
            stamps.append(stamp_ns)
    if not stamps:
        raise DataError(f"{path}: no time stamps in this file")
    return np.array(stamps, np.int64)


def _nanoseconds(text: str) -> int | None:
    """Nanoseconds since 1970 of a date and time, in the years that stamps reach to; else None."""
    date, _, fraction = text.partition(".")
    try:
        time = datetime.strptime(date, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    if not re.fullmatch("[0-9]*", fraction):
        return None
    whole = (time - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(seconds=1)
    stamp_ns = whole * 10**9 + int(fraction[:9].ljust(9, "0"))
    return stamp_ns if abs(stamp_ns) < Files.LARGEST_STAMP_NS else None


def read_seconds(path: Path) -> NDArray[np.int64]:
    """Time stamps (N,) in ns from lines of seconds.

    Raises:
        DataError: if one is not a number; names file and line.
    """
    blocks = []
    for rows in read_rows(path):
        table = rows.parse([("stamp", STAMP_TEXT)], "time [s]", (0,), None)
        blocks.append(stamps_from_seconds(rows, table["stamp"]))
    if not blocks:
        raise DataError(f"{path}: no time stamps in this file")
    return np.concatenate(blocks)


def increasing(
    stamps_ns: NDArray[np.int64], kind: str, path: Path, diagnostics: Diagnostics
) -> NDArray[np.intp]:
    """Indices of the stamps (N,), one per line, that increase; the others are counted."""
    return in_order(
        stamps_ns,
        lambda k, _: diagnostics.warn(
            kind, f"{path}:{k + 1}: dropped, not between the ones before and after it"
        ),
    )
