# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings in no format: which files hold time stamps, IMU and calibration of some images.

Times in these files are nanoseconds if they are whole numbers, seconds if any has a decimal point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.streams.csv_rows import (
    STAMP_TEXT,
    Rows,
    parse,
    read_rows,
    stamp_from_seconds,
)
from slam_graph.datasets.streams.imu_stream import INTEGER_STAMPS, ImuFile
from slam_graph.errors import DataError
from slam_graph.sensors.kalibr_calibration import read_kalibr
from slam_graph.sensors.measurements import ImuData
from slam_graph.sensors.rig import Rig

SHORTEST_PERIOD_NS = 100_000
"""Frames that follow one another faster than this have stamps of another unit."""

SLOWEST_HZ, FASTEST_HZ = 0.01, 1000.0

SOURCES = ("stamps", "rate", "imu")


@dataclass(frozen=True, slots=True)
class LooseFiles:
    """What goes with some images.

    Attributes:
        stamps: table with a time for each image, or None.
        rate_hz: of the images, if that was told instead.
        imu: CSV with time, rate x y z [rad/s], specific force x y z [m/s²], or None.
        rig: one camera; without an IMU its frame is the body frame.
    """

    stamps: Path | None
    rate_hz: float | None
    imu: ImuFile | None
    rig: Rig


def find_files(
    path: Path,
    named: Mapping[str, str],
    beside: Mapping[str, Sequence[Path]],
    calibration: Path | None,
) -> LooseFiles:
    """Find what goes with some images: as said, or where it usually is.

    Args:
        path: of the images.
        named: files by ``stamps`` and ``imu``, and ``rate`` in Hz.
        beside: where to look for ``stamps``, ``imu`` and ``calibration`` otherwise.
        calibration: a Kalibr camera chain, if one was given.

    Raises:
        DataError: if there is no calibration, or what was named makes no sense.
    """
    unknown = [key for key in named if key not in SOURCES]
    if unknown:
        raise DataError(f"unknown source '{unknown[0]}'; known: {', '.join(SOURCES)}")
    found = {key: next(filter(Path.is_file, files), None) for key, files in beside.items()}
    files = {key: Path(named[key]) if key in named else found[key] for key in ("stamps", "imu")}
    for file in files.values():
        if file is not None and not file.is_file():
            raise DataError(f"{file}: no such file")
    chain = calibration if calibration is not None else found["calibration"]
    if chain is None:
        looked = ", ".join(file.name for file in beside["calibration"])
        raise DataError(f"{path}: no calibration ({looked}) beside the images; give --calibration")
    imu = files["imu"]
    rate_hz = _rate(named["rate"]) if "rate" in named else None
    if rate_hz is not None and "stamps" in named:
        raise DataError(f"{path}: stamps and rate are both given; one of them is enough")
    return LooseFiles(
        stamps=None if rate_hz is not None else files["stamps"],
        rate_hz=rate_hz,
        imu=None if imu is None else ImuFile(imu, parse_timed_imu),
        rig=read_kalibr(chain, needs_imu=imu is not None).select(1),
    )


def is_usable_rate(rate_hz: float) -> bool:
    """Whether images can come so often."""
    return SLOWEST_HZ <= rate_hz <= FASTEST_HZ


def regular_stamps(count: int, rate_hz: float) -> NDArray[np.int64]:
    """Stamps (N,) in ns of images that come at a rate, the first one at 0."""
    stamps: NDArray[np.int64] = np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return stamps


def read_stamps(path: Path) -> tuple[NDArray[np.int64], list[str]]:
    """Times of a table, one a row, in its first column.

    Returns:
        stamps_ns: (N,) in the order of the file.
        names: what stands in the second column of each row; empty where there is none.

    Raises:
        DataError: if there are none, one cannot be read, or they are of another unit.
    """
    blocks = list(read_rows(path))
    cells = [[_cells(line) for line in rows.lines] for rows in blocks]
    if not blocks:
        raise DataError(f"{path}: no time stamps in this file")
    seconds = any(_in_seconds(row[0]) for block in cells for row in block)
    stamps = np.array(
        [
            _stamp(row[0], rows, k, seconds)
            for rows, block in zip(blocks, cells, strict=True)
            for k, row in enumerate(block)
        ],
        np.int64,
    )
    require_unit(stamps, path)
    return stamps, [row[1] if len(row) > 1 else "" for block in cells for row in block]


def require_unit(stamps_ns: NDArray[np.int64], path: Path) -> None:
    """Refuse stamps that follow one another too fast to be in nanoseconds."""
    if len(stamps_ns) < 2:
        return
    period = float(np.median(np.abs(np.diff(stamps_ns))))
    if period < SHORTEST_PERIOD_NS:
        raise DataError(
            f"{path}: stamps are {period:.0f} ns apart; whole numbers are nanoseconds, "
            "seconds need a decimal point"
        )


def stamps_from_names(paths: Sequence[Path]) -> NDArray[np.int64] | None:
    """Stamps (N,) that files have as their names; None if one of them has not."""
    stamps = []
    for path in paths:
        try:
            seconds = _in_seconds(path.stem)
            stamps.append(int(Decimal(path.stem).scaleb(9)) if seconds else int(path.stem))
        except (ValueError, OverflowError, InvalidOperation):
            return None
    together = np.array(stamps, np.int64)
    if len(together) > 1 and float(np.median(np.abs(np.diff(together)))) < SHORTEST_PERIOD_NS:
        return None
    return together


def parse_timed_imu(rows: Rows) -> ImuData:
    """Samples of rows: time, gyro xyz in rad/s, accel xyz in m/s²."""
    what = "time, gyro xyz, accel xyz"
    if not any(_in_seconds(_cells(line)[0]) for line in rows.lines):
        table = parse(rows, INTEGER_STAMPS, what)
        return ImuData(table["stamp"], table["gyro"], table["accel"])
    table = parse(rows, [("stamp", STAMP_TEXT), *INTEGER_STAMPS[1:]], what)
    stamps = [stamp_from_seconds(text, rows, k) for k, text in enumerate(table["stamp"])]
    return ImuData(np.array(stamps, np.int64), table["gyro"], table["accel"])


def _cells(line: str) -> list[str]:
    """The cells of a row, which is separated by commas or else by white space."""
    cells = line.split(",") if "," in line else line.split()
    return [cell.strip() for cell in cells]


def _in_seconds(text: str) -> bool:
    return any(mark in text for mark in ".eE")


def _stamp(text: str, rows: Rows, index: int, seconds: bool) -> int:
    if seconds:
        return stamp_from_seconds(text, rows, index)
    try:
        return int(text)
    except ValueError:
        raise DataError(f"{rows.where(index)}: '{text[:80]}' is not a time") from None


def _rate(text: str) -> float:
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = float("nan")
    if not is_usable_rate(rate_hz):
        raise DataError(f"rate={text} is not a number of images a second")
    return rate_hz
