# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""CSV files in blocks of lines: streamed, parsed fast, with the line of a bad cell in errors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import DataError
from slam_graph.files import Files

_ROWS_PER_BLOCK = 1024
"""Rows in memory at a time: about five seconds of an IMU."""

STAMP_TEXT = "S40"
"""Type of a column of stamps in seconds, kept as text until it is turned into nanoseconds."""

_DIGITS = frozenset("0123456789")


@dataclass(frozen=True, slots=True)
class Rows:
    """Consecutive data rows of a text file.

    Attributes:
        path: of the file.
        lines: the rows, without comments, headers and blank lines.
        numbers: the line number of each row in the file, from 1.
    """

    path: Path
    lines: list[str]
    numbers: list[int]

    def where(self, index: int) -> str:
        """File and line of one row, for messages."""
        return f"{self.path}:{self.numbers[index]}"

    def select(self, prefix: str) -> Rows:
        """Only the rows that start with `prefix`."""
        kept = [k for k, line in enumerate(self.lines) if line.startswith(prefix)]
        return Rows(self.path, [self.lines[k] for k in kept], [self.numbers[k] for k in kept])

    def parse(
        self,
        dtype: list[tuple[Any, ...]],
        what: str,
        columns: tuple[int, ...] | None = None,
        delimiter: str | None = ",",
    ) -> NDArray[Any]:
        """The rows as a structured array.

        Args:
            dtype: of one row, as for `numpy.dtype`; without `columns` it must cover all columns.
            what: the columns, for the message (e.g. ``stamp, gyro xyz, accel xyz``).
            columns: which columns to read, default all.
            delimiter: between columns; None for white space.

        Raises:
            DataError: if a row does not parse; names file and line of the first.
        """
        try:
            return _loadtxt(self.lines, dtype, columns, delimiter)
        except ValueError:
            for k, line in enumerate(self.lines):
                try:
                    _loadtxt([line], dtype, columns, delimiter)
                except ValueError as error:
                    raise DataError(
                        f"{self.where(k)}: {_reason(str(error), line)}; expected {what}"
                    ) from None
            raise


def read_rows(path: Path, rows_per_block: int = _ROWS_PER_BLOCK) -> Iterator[Rows]:
    """Stream the data rows of a text file in blocks.

    Blank lines, lines that start with ``#`` or ``%``, and a header (a first line that does not
    start like a number) are left out.

    Raises:
        DataError: if the file cannot be opened.
    """
    try:
        file = path.open(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    with file:
        first = 1
        while lines := list(islice(file, rows_per_block)):
            kept = [k for k, line in enumerate(lines) if _is_data(line, first + k)]
            if len(kept) == len(lines):
                yield Rows(path, lines, list(range(first, first + len(lines))))
            elif kept:
                yield Rows(path, [lines[k] for k in kept], [first + k for k in kept])
            first += len(lines)


def _is_data(line: str, number: int) -> bool:
    start = line[:1]
    if start in _DIGITS:
        return True
    start = line.strip()[:1]
    return start != "" and start not in "#%" and (number > 1 or start in _DIGITS | {"+", "-", "."})


def _reason(message: str, line: str) -> str:
    """The reason why NumPy cannot parse a row."""
    cell = re.search(r"string '(.*)' to (\w+) at row \d+, column (\d+)", message)
    if cell is None:
        return f"cannot read the row '{line.strip()[:80]}'"
    kind = "an integer" if cell[2].startswith("int") else "a number"
    return f"'{cell[1][:60]}' in column {cell[3]} is not {kind}"


def _loadtxt(
    lines: list[str],
    dtype: list[tuple[Any, ...]],
    columns: tuple[int, ...] | None,
    delimiter: str | None,
) -> NDArray[Any]:
    if not lines:
        return np.zeros(0, np.dtype(dtype))
    if not all(map(str.isascii, lines)):  # NumPy reads out of bounds, and may crash, on others
        lines = [line.encode("ascii", errors="replace").decode() for line in lines]
    table: NDArray[Any] = np.loadtxt(
        lines, dtype=np.dtype(dtype), delimiter=delimiter, usecols=columns, comments=None, ndmin=1
    )
    return table


def stamp_from_seconds(text: bytes | str, rows: Rows, index: int) -> int:
    """Nanoseconds of a time in seconds written as text, exact to its last digit.

    Args:
        text: e.g. ``1403715283.164630651`` or ``1.4e9``.
        rows: of which it is one, for the message.
        index: of its row.

    Raises:
        DataError: if the text is not a number.
    """
    text = text.decode(errors="replace") if isinstance(text, bytes) else text
    try:
        return nanoseconds(text)
    except (ValueError, ArithmeticError):
        raise DataError(f"{rows.where(index)}: '{text[:80]}' is not a time in seconds") from None


def nanoseconds(text: str) -> int:
    """Nanoseconds of a time in seconds, rounded; `1e9999999` is not even multiplied out.

    Raises:
        ValueError, ArithmeticError: if the text is not a time.
    """
    seconds = Decimal(text)
    if not abs(seconds) < Files.LARGEST_STAMP_NS // 10**9:  # NaN is an ArithmeticError
        raise ValueError(text)
    return int((seconds * 10**9).to_integral_value())


def stamps_from_seconds(rows: Rows, texts: NDArray[np.bytes_]) -> NDArray[np.int64]:
    """Nanoseconds (N,) of the stamps (N,) of `rows`, exact to the last digit of their text."""
    first = np.flatnonzero(
        np.concatenate([np.ones(min(len(texts), 1), bool), texts[1:] != texts[:-1]])
    )
    stamps = [stamp_from_seconds(texts[k], rows, int(k)) for k in first]
    return np.repeat(np.array(stamps, np.int64), np.diff(first, append=len(texts)))


def check_times(rows: Rows, stamps_ns: NDArray[np.int64]) -> None:
    """Refuse stamps (N,) of `rows` that are no times in ns.

    Raises:
        DataError: naming the line of the first.
    """
    wrong = np.flatnonzero(~Files.are_times(stamps_ns))
    if len(wrong):
        stamp = stamps_ns[wrong[0]]
        raise DataError(f"{rows.where(int(wrong[0]))}: '{stamp}' is not a time in nanoseconds")


def require_rows(path: Path) -> None:
    """Refuse a file that cannot be read or has no data rows."""
    if next(read_rows(path, 2), None) is None:
        raise DataError(f"{path}: no data rows in this file")


def count_rows(path: Path) -> tuple[int, str, str]:
    """Number of data rows of a file, its first and its last one (empty if there are none)."""
    count, first, last = 0, "", ""
    for rows in read_rows(path, 16 * _ROWS_PER_BLOCK):
        first = first or rows.lines[0]
        last = rows.lines[-1]
        count += len(rows.lines)
    return count, first, last
