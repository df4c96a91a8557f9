# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Reading and writing bundle-adjustment problems in BAL's format, plain or compressed by bzip2.

A header `cameras points observations`; `camera point x y` of each observation; then nine numbers of
each camera (rotation vector, translation, f, k1, k2) and three of each point, separated by any
white space.
"""

from __future__ import annotations

import bz2
from codecs import BOM_UTF8
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.bundle_adjustment.bal_problem import CAMERA_DIM, BalEstimates, BalProblem
from slam_graph.errors import DataError
from slam_graph.files import Files

_BZIP2_MAGIC = b"BZh"
_MAX_UNPACKED, _MIN_UNPACKED = 50, 2**20
"""A file may unpack to so many times its size and bytes more; texts of numbers do to 5 times."""
_HEADER = 3
_OBSERVATION = 4
"""Numbers of the header and of an observation."""
_MAX_HEADER_BYTES = 200
"""The first line of a file of this format is shorter."""


def is_bal(path: Path) -> bool:
    """Whether a file begins with a line of three whole numbers, as a BAL problem does.

    Raises:
        DataError: if it cannot be read.
    """
    try:
        with path.open("rb") as file:
            compressed = file.read(len(_BZIP2_MAGIC)) == _BZIP2_MAGIC
        if compressed:
            return True  # no other supported format is compressed
        with path.open("rb") as file:
            start = file.read(_MAX_HEADER_BYTES).removeprefix(BOM_UTF8).split(b"\n")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    words = next((line.split() for line in start if line.strip()), [])
    return len(words) == _HEADER and all(word.lstrip(b"-").isdigit() for word in words)


def _problem_name(path: Path) -> str:
    """The name of a file without `.txt` or `.txt.bz2`; the folder of results has it too."""
    return path.name.removesuffix(".bz2").removesuffix(".txt").strip(".") or "problem"


def read_bal(path: Path | str) -> BalProblem:
    """Read a problem.

    Args:
        path: of a text file, plain or compressed by bzip2.

    Raises:
        DataError: naming file and line, if the file cannot be read or unpacked, is cut short or too
            long, has no observations, numbers that are not finite, or an index out of range.
    """
    path = Path(path)
    text = _text(path)
    numbers = _numbers(path, text)
    cameras, points, observations = _header(path, text, numbers)
    expected = _HEADER + _OBSERVATION * observations + CAMERA_DIM * cameras + 3 * points
    if len(numbers) < expected:
        raise DataError(
            f"{_where(path, text, len(numbers) - 1)}: ends after {len(numbers)} of the {expected} "
            "numbers that the header promises; is the file cut short?"
        )
    if len(numbers) > expected:
        raise DataError(
            f"{_where(path, text, expected)}: {len(numbers) - expected} numbers more than the "
            "header promises"
        )
    bad = np.flatnonzero(~Files.are_measurable(numbers))
    if len(bad):
        raise DataError(f"{_where(path, text, int(bad[0]))}: a number is not finite, or too large")
    seen, by_camera, by_point = np.split(
        numbers[_HEADER:], np.cumsum([_OBSERVATION * observations, CAMERA_DIM * cameras])
    )
    table = seen.reshape(-1, _OBSERVATION)
    for column, (what, count) in enumerate((("camera", cameras), ("point", points))):
        _check_indices(path, text, table[:, column], column, what, count)
    camera, point = table[:, :2].T.astype(np.int64)
    estimates = _estimates(by_camera.reshape(-1, CAMERA_DIM), by_point.reshape(-1, 3))
    return BalProblem(estimates, camera, point, table[:, 2:].copy(), _problem_name(path))


def _text(path: Path) -> str:
    """The content of a file, unpacked."""
    try:
        content = path.read_bytes()
        if content.startswith(_BZIP2_MAGIC):
            content = _unpacked(content)
    except OSError as error:
        reason = error.strerror or "damaged bzip2 data"
        raise DataError(f"{path}: cannot be read ({reason})") from None
    except ValueError as error:
        raise DataError(f"{path}: cannot be read ({error})") from None
    return content.removeprefix(BOM_UTF8).decode("ascii", errors="replace")


def _unpacked(content: bytes) -> bytes:
    """Unpack bzip2 data of one or more streams.

    Raises:
        OSError, ValueError: if it is damaged, cut short, or unpacks to far more than numbers do.
    """
    most, found, size = _MAX_UNPACKED * len(content) + _MIN_UNPACKED, [], 0
    while content.startswith(_BZIP2_MAGIC):
        unpacker = bz2.BZ2Decompressor()
        found.append(unpacker.decompress(content, max(most - size, 0) + 1))
        size += len(found[-1])
        if size > most:
            raise ValueError(f"it unpacks to more than {_MAX_UNPACKED} times its size")
        if not unpacker.eof:
            raise ValueError("bzip2 data cut short")
        content = unpacker.unused_data
    return b"".join(found)


def _numbers(path: Path, text: str) -> FloatArray:
    """All numbers of a text."""
    if not text.strip():
        raise DataError(f"{path}: empty; expected `cameras points observations`")
    try:
        return np.fromstring(text, dtype=np.float64, sep=" ")
    except ValueError:
        pass  # the line is found below
    for number, line in enumerate(text.split("\n"), 1):
        try:
            if line.strip():
                np.fromstring(line, dtype=np.float64, sep=" ")
        except ValueError:
            raise DataError(f"{path}:{number}: not a number in '{line.strip()[:60]}'") from None
    raise DataError(f"{path}: not numbers throughout")


def _header(path: Path, text: str, numbers: FloatArray) -> tuple[int, int, int]:
    """Numbers of cameras, points and observations."""
    counts, line = numbers[:_HEADER], text.lstrip().split("\n", 1)[0]
    whole = np.isfinite(counts) & (counts >= 0) & (counts == np.floor(counts)) & (counts < 2**53)
    if len(line.split()) != _HEADER or not whole.all():
        raise DataError(
            f"{_where(path, text, 0)}: expected three whole numbers: cameras points observations"
        )
    cameras, points, observations = (int(count) for count in counts)
    if 0 in (cameras, points, observations):
        raise DataError(
            f"{_where(path, text, 0)}: nothing to estimate: {cameras} cameras, {points} points, "
            f"{observations} observations"
        )
    return cameras, points, observations


def _check_indices(
    path: Path, text: str, indices: FloatArray, column: int, what: str, count: int
) -> None:
    """Check that indices are whole numbers below a count."""
    bad = np.flatnonzero((indices < 0) | (indices >= count) | (indices != np.floor(indices)))
    if len(bad):
        where = _where(path, text, _HEADER + _OBSERVATION * int(bad[0]) + column)
        raise DataError(
            f"{where}: {what} {indices[bad[0]]:.15g}, but they go from 0 to {count - 1}"
        )


def _where(path: Path, text: str, index: int) -> str:
    """File and line of a number, for messages."""
    for number, line in enumerate(text.split("\n"), 1):
        index -= len(line.split())
        if index < 0:
            return f"{path}:{number}"
    return str(path)


def _estimates(by_camera: FloatArray, points: FloatArray) -> BalEstimates:
    rotations = Rotation.from_rotvec(by_camera[:, :3]).as_matrix()
    return BalEstimates(rotations, by_camera[:, 3:6].copy(), by_camera[:, 6:].copy(), points.copy())


def bal_lines(problem: BalProblem, estimates: BalEstimates) -> Iterator[str]:
    """The lines of a file with given estimates; reading it gives the same numbers back."""
    yield f"{problem.cameras} {problem.points} {len(problem.camera)}\n"
    ends = zip(problem.camera.tolist(), problem.point.tolist(), strict=True)
    for (camera, point), (x, y) in zip(ends, problem.pixels.tolist(), strict=True):
        yield f"{camera} {point} {x!r} {y!r}\n"
    turns = Rotation.from_matrix(estimates.rotations).as_rotvec()
    by_camera = np.hstack([turns, estimates.translations, estimates.intrinsics])
    for value in (*by_camera.ravel().tolist(), *estimates.points.ravel().tolist()):
        yield f"{value!r}\n"
