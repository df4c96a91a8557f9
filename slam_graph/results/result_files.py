# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole or not at all, the folder of a run, and the names of its files."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from slam_graph import datasets
from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import NavState, StateHistory, Trajectory

LATEST = "latest"
"""Name of the link to the newest results."""


def refuse_to_replace(path: Path, force: bool) -> None:
    """Make sure that no file is overwritten unless that is asked for.

    Raises:
        DataError: if the file exists without `force`, or is a folder. A device or a pipe is
            written to, and not replaced.
    """
    if path.is_dir():
        raise DataError(f"{path}: is a folder; name a file")
    if path.is_file() and not force:
        raise DataError(f"{path}: exists already; choose another name, or replace it by --force")


_MAX_NAME_BYTES = 100
"""Longest name of a folder that is made of a name in a file; systems of files allow 255."""


def folder_name(name: str) -> str:
    """A name of a recording or problem as that of one folder: names are never paths.

    Separators and control characters are replaced, and so is what cannot be written as UTF-8; a
    name that is too long is cut and gets a hash, so that two of them stay apart.
    """
    plain = re.sub(r"[\x00-\x1f\x7f/\\\ud800-\udfff]+", "_", name).strip()
    if not plain.strip("."):  # the folder itself, and the one around it
        plain = "_" * len(plain) or "unnamed"
    if len(plain.encode()) > _MAX_NAME_BYTES:
        digest = sha256(plain.encode()).hexdigest()[:8]
        start = plain.encode()[: _MAX_NAME_BYTES - 9].decode(errors="ignore")
        plain = f"{start}-{digest}"
    return plain


MAP_NAME = "map.slam"
"""Name of the map in the folder of a run."""


def find_map(path: Path | str) -> Path:
    """The map file that a path means (see `load_map`)."""
    path = Path(path)
    if not path.is_dir():
        if not path.exists():
            raise DataError(
                f"{path}: no such file; name a map, or the folder of a run that saved one"
            )
        return path
    for found in (path / MAP_NAME, path / LATEST / MAP_NAME):
        if found.is_file():
            return found
    raise DataError(
        f"{path}: no {MAP_NAME} in this folder; make one by `slam-graph run --save-map`"
    )


class ResultFolder:
    """Writes the files of a result into one folder, each whole or not at all.

    Args:
        folder: made if it is missing.

    Raises:
        DataError: if the folder or a file cannot be written.

    Attributes:
        folder: of all files.
        files: written so far, in order.
    """

    find_map = staticmethod(find_map)
    refuse_to_replace = staticmethod(refuse_to_replace)

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        Files.make_folder(self.folder)
        self.files: list[Path] = []

    @staticmethod
    def name_of(name: str) -> str:
        """A name of a recording or problem as that of one folder (`folder_name`)."""
        return folder_name(name)

    @staticmethod
    @contextmanager
    def of_run(root: Path, dataset: str, now: datetime | None = None) -> Iterator[ResultFolder]:
        """A new folder `root/dataset/<UTC time>`, to which `latest` beside it links at the end.

        If the block raises an error before it has written anything, the folder is removed.

        Args:
            root: of all results.
            dataset: name of what was worked on; of any characters, see `folder_name`.
            now: the time; that of the clock if not given.

        Raises:
            DataError: if the folder cannot be made, or `latest` is not a link.
        """
        made = ResultFolder(_new_folder(root, folder_name(dataset), now))
        try:
            yield made
            _link_latest(made.folder)
        except BaseException:
            for empty in (made.folder, made.folder.parent):
                if empty.is_dir() and not any(empty.iterdir()):
                    empty.rmdir()
            raise

    def discard(self) -> None:
        """Remove the folder with all that was written into it."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def path(self, name: str) -> Path:
        """The path of the next file, for a writer that makes it appear whole."""
        self.files.append(self.folder / name)
        return self.files[-1]

    @contextmanager
    def appearing(self, name: str) -> Iterator[Path]:
        """A path to write the next file to, which appears when the block ends well."""
        with Files.appearing(self.path(name)) as partial:
            yield partial

    def text(self, name: str, lines: Iterable[str]) -> None:
        """Write lines (with their line ends)."""
        Files.write_text(self.path(name), lines)

    def json(self, name: str, table: Mapping[str, Any]) -> None:
        """Write a table as JSON."""
        self.text(name, [json.dumps(table, indent=2, allow_nan=False), "\n"])


def _new_folder(root: Path, dataset: str, now: datetime | None = None) -> Path:
    """Make a new folder `root/dataset/<UTC time>`; a number is added where that exists already.

    Raises:
        DataError: if it cannot be made.
    """
    now = now or datetime.now(UTC)
    name = now.astimezone(UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    try:
        (root / dataset).mkdir(parents=True, exist_ok=True)
        for attempt in range(1, 1000):
            folder = root / dataset / (name if attempt == 1 else f"{name}-{attempt}")
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as error:
        reason = Files.refused(error)
        raise DataError(f"{root / dataset}: cannot make a folder ({reason})") from error
    raise DataError(f"{root / dataset}: too many runs at {name}")


def _link_latest(folder: Path) -> Path:
    """Make `latest` beside a folder point at it, replacing an older link in one step.

    The link is relative, so that the results can be moved.

    Raises:
        DataError: if something that is not a link stands in its place.
    """
    link = folder.parent / LATEST
    if link.exists() and not link.is_symlink():
        raise DataError(f"{link}: not a link; move it away, the newest results are in {folder}")
    partial = folder.parent / f".{LATEST}.{os.getpid()}.partial"
    with Files.writing(link):
        try:
            partial.unlink(missing_ok=True)
            partial.symlink_to(folder.name)
            os.replace(partial, link)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    return link


TRAJECTORY = "trajectory.tum"
SMOOTHED = "trajectory_smoothed.tum"
LOOP_CLOSED = "trajectory_loop.tum"
LOOPS = "loops.csv"
LOOP_COLUMNS = ("first_stamp_ns", "second_stamp_ns", "accepted")
IN_MAP = "trajectory_map.tum"
GROUNDTRUTH = "groundtruth.tum"
STATES = "states.csv"
SEGMENTS = "segments.csv"
SMOOTHED_STATES = "states_smoothed.csv"
POINTS = "map.ply"
LOOP_POINTS = "map_loop.ply"
CONFIG = "config.yaml"
RIG = "calibration.yaml"
ESTIMATED_RIG = "calibration_estimated.yaml"
ADJUSTED_RIG = "calibration_adjusted.yaml"
METRICS = "metrics.json"
TIMING = "timing.csv"
FRAMES = "frames.csv"

VELOCITY = NavState.COMPONENTS[6:9]
ACCEL_BIAS = NavState.COMPONENTS[9:12]
GYRO_BIAS = NavState.COMPONENTS[12:15]
SIGMAS = tuple(f"sigma_{component}" for component in NavState.COMPONENTS)
_COLUMNS = (*VELOCITY, *ACCEL_BIAS, *GYRO_BIAS, *SIGMAS)


def state_lines(history: StateHistory) -> Iterator[str]:
    """Velocities, biases and standard deviations as CSV; sigmas are empty where unknown."""
    yield ",".join(["stamp_ns", *_COLUMNS]) + "\n"
    trajectory = history.trajectory()
    parts = (trajectory.velocities, trajectory.accel_biases, trajectory.gyro_biases)
    rows = np.hstack([*(part for part in parts if part is not None), history.sigmas()])
    # row by row: lists of all of them would take several times the memory of the arrays
    for stamp_ns, row in zip(trajectory.stamps_ns, rows, strict=True):
        cells = ("" if math.isnan(value) else f"{value:.9g}" for value in row.tolist())
        yield ",".join([str(stamp_ns), *cells]) + "\n"


def read_states(path: Path) -> tuple[IntArray, dict[str, FloatArray]]:
    """Read what `state_lines` wrote; the columns may be in any order.

    Returns:
        Times (N,) in ns, and the other columns (N,) by name, as in `read_table`.

    Raises:
        DataError: if the file is missing or another table.
    """
    table = read_table(path, ("stamp_ns", *_COLUMNS), "the states of a run")
    return table.pop("stamp_ns"), table


def read_table(path: Path, columns: Iterable[str], what: str) -> dict[str, Any]:
    """Read a CSV file of numbers with titles.

    Args:
        path: of the file.
        columns: titles that it must have; it may have others, in any order.
        what: it is, for the error.

    Returns:
        Columns (N,) by their titles: those that end with `_ns` are int64, the others float64, NaN
        where empty, infinite or beyond any result. `stamp_ns` increases.

    Raises:
        DataError: if the file is missing, or another table.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            titles, *rows = csv.reader(file)
        missing = [name for name in columns if name not in titles]
        if missing:
            raise ValueError(f"no column '{missing[0]}'")
        if any(len(row) != len(titles) for row in rows):
            raise ValueError("a row has not as many cells as there are titles")
        cells = list(zip(*rows, strict=True)) or [()] * len(titles)
        table = {
            title: _times_ns(column) if title.endswith("_ns") else _numbers(column)
            for title, column in zip(titles, cells, strict=True)
        }
        stamps = table.get("stamp_ns", np.zeros(0, np.int64))
        if np.any(stamps[1:] <= stamps[:-1]):
            raise ValueError("its times do not increase")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, OverflowError, csv.Error) as error:
        reason = "it is empty" if path.stat().st_size == 0 else error
        raise DataError(f"{path}: not {what} ({reason})") from error
    return table


def _times_ns(cells: Iterable[str]) -> IntArray:
    """A column of times.

    Raises:
        ValueError: if a cell is none.
    """
    times = [int(cell) for cell in cells]
    if any(abs(time) >= Files.LARGEST_STAMP_NS for time in times):
        raise ValueError("a time does not fit into 62 bits")
    return np.array(times, np.int64)


def _numbers(cells: Iterable[str]) -> FloatArray:
    """A column of numbers.

    Raises:
        ValueError: if a cell is none.
    """
    values = np.array([float(cell or "nan") for cell in cells], np.float64)
    values[~Files.are_measurable(values)] = np.nan
    return values


def read_tum(path: Path) -> Trajectory:
    """Read a trajectory, which may be empty.

    Raises:
        DataError: if the file is missing or not a trajectory.
    """
    if path.is_file() and path.stat().st_size == 0:
        return Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
    return datasets.read_groundtruth(path)
