# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: TUM (`t x y z qx qy qz qw`, seconds) and EuRoC CSV (nanoseconds, qw first).

Times are read digit by digit, not through a float: seconds since 1970 as a float are only good to
240 ns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import Trajectory

FloatArray = NDArray[np.float64]

TUM_COLUMNS = (8,)
EUROC_COLUMNS = (8, 11, 17)
"""Time and pose; with velocity; with gyroscope and accelerometer bias."""

UNIT_TOLERANCE = 0.01
"""How far from 1 the norm of a quaternion in a file may be."""


def nanoseconds(seconds: str) -> int:
    """The exact integer nanoseconds of a decimal number of seconds.

    Raises:
        ValueError: if the text is not a finite number.
    """
    whole, _, fraction = seconds.strip().partition(".")
    if whole.isascii() and whole.isdigit() and fraction.isascii() and len(fraction) <= 9:
        if fraction.isdigit():
            return int(whole) * 10**9 + int(fraction.ljust(9, "0"))
        if not fraction:
            return int(whole) * 10**9
    try:
        return int((Decimal(seconds) * 10**9).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError) as error:
        raise ValueError(f"'{seconds}' is not a time in seconds") from error


def seconds_text(stamp_ns: int) -> str:
    """A time in seconds with all nine decimals; the inverse of `nanoseconds`."""
    sign, magnitude = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{magnitude // 10**9}.{magnitude % 10**9:09d}"


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a TUM or a EuRoC file; a comma in its first row of numbers tells which.

    Raises:
        DataError: if the file is missing, empty or malformed; the message names the line.
    """
    path = Path(path)
    for _, line in _data_lines(path):
        return read_euroc(path) if "," in line else read_tum(path)
    raise DataError(f"{path}: no poses in this file; expected TUM or EuRoC rows")


def read_tum(path: Path | str) -> Trajectory:
    """Read `t[s] x y z qx qy qz qw` rows, separated by spaces."""
    stamps, rows = _read_rows(Path(path), None, TUM_COLUMNS, nanoseconds)
    return _trajectory(Path(path), stamps, rows, rows[:, 3:7])


def read_euroc(path: Path | str) -> Trajectory:
    """Read `t[ns], x, y, z, qw, qx, qy, qz[, velocity[, gyro bias, accel bias]]` rows."""
    stamps, rows = _read_rows(Path(path), ",", EUROC_COLUMNS, int)
    return _trajectory(Path(path), stamps, rows, rows[:, [4, 5, 6, 3]])


def tum_lines(trajectory: Trajectory) -> Iterator[str]:
    """The lines of a TUM file, nine decimals each."""
    rows = np.hstack([trajectory.positions, trajectory.quaternions])
    for stamp, row in zip(trajectory.stamps_ns.tolist(), rows.tolist(), strict=True):
        yield f"{seconds_text(stamp)} {' '.join(f'{value:.9f}' for value in row)}\n"


def _data_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines that are neither empty nor comments."""
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                if line.strip() and not line.lstrip().startswith("#"):
                    yield number, line.strip()
    except OSError as error:
        raise DataError(f"{path}: cannot read trajectory: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file; expected TUM or EuRoC rows") from error


def _read_rows(
    path: Path, separator: str | None, widths: tuple[int, ...], parse_time: Callable[[str], int]
) -> tuple[list[tuple[int, int]], FloatArray]:
    """Times with their line numbers, and the other columns (N, width - 1)."""
    stamps: list[tuple[int, int]] = []
    rows: list[list[float]] = []
    for number, line in _data_lines(path):
        cells = [cell for cell in line.split(separator) if cell.strip()]
        if len(cells) not in widths or (rows and len(cells) != len(rows[0]) + 1):
            wanted = " or ".join(str(width) for width in widths)
            raise DataError(f"{path}:{number}: {len(cells)} columns, expected {wanted}")
        try:
            stamps.append((parse_time(cells[0]), number))
            rows.append([float(cell) for cell in cells[1:]])
        except ValueError as error:
            raise DataError(f"{path}:{number}: not a row of numbers ({error})") from error
    if not rows:
        raise DataError(f"{path}: no poses in this file")
    return stamps, np.array(rows)


def _trajectory(
    path: Path, stamps: list[tuple[int, int]], rows: FloatArray, quaternions: FloatArray
) -> Trajectory:
    """Check the rows of a file and make a trajectory of them."""
    times = np.array([stamp for stamp, _ in stamps], dtype=np.int64)
    norms = np.linalg.norm(quaternions, axis=1)
    for bad, what in (
        (~np.all(np.isfinite(rows), axis=1), "a value is not finite"),
        (~(np.abs(norms - 1.0) <= UNIT_TOLERANCE), "the quaternion is not of unit length"),
        (np.diff(times, prepend=times[0] - 1) <= 0, "the time does not increase"),
    ):
        if np.any(bad):
            raise DataError(f"{path}:{stamps[int(np.argmax(bad))][1]}: {what}")
    return Trajectory(
        times,
        rows[:, :3],
        quaternions / norms[:, None],
        velocities=rows[:, 7:10] if rows.shape[1] >= 10 else None,
        gyro_biases=rows[:, 10:13] if rows.shape[1] >= 16 else None,
        accel_biases=rows[:, 13:16] if rows.shape[1] >= 16 else None,
    )
