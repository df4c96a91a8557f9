# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A folder that has files of an earlier result: they make room before another is written there.

So the files of two results are never taken for one, and none is lost that may be the only copy:

- What says what the earlier result found is *derived*, and removed: trajectories, states, points,
  tables, settings, calibrations, pictures, graphs and the log. A new result of the same kind has
  its own, and without its metrics a part of them tells nothing.
- A map and a recording for the viewer are of use by themselves, and took a run to make. They are
  kept under other names (`map-earlier.slam`) where no new one is written in their place.
- A result of another kind is refused: nothing that is written would take its place.
- What others wrote into the folder stays.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any, Literal

from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.results import result_files as names

Kind = Literal["run", "pose graph", "bundle adjustment", "comparison"]
"""What a result is of."""

_MARKS = frozenset({"schema_version", "versions"})
"""What `metrics.json` of every result has."""

_KINDS: dict[str, Kind] = {
    "algorithm": "run",
    "graph": "pose graph",
    "problem": "bundle adjustment",
}
"""Of which kind a result is, by what its `metrics.json` has."""

_MARKS_OF_COMPARISON = frozenset({"rows", "failures"})
"""What `summary.json` of a comparison has."""

_REPLACED = "another result is written in the place of this one, and is not complete"

_LOG, _RECORDING = "run.log", "recording.rrd"

_FILES = frozenset(
    {
        *(names.TRAJECTORY, names.SMOOTHED, names.LOOP_CLOSED, names.IN_MAP, names.GROUNDTRUTH),
        *(names.STATES, names.SMOOTHED_STATES, names.SEGMENTS, names.POINTS, names.LOOP_POINTS),
        *(names.LOOPS, names.TIMING, names.FRAMES, names.CONFIG, names.MAP_NAME),
        *(names.RIG, names.ESTIMATED_RIG, names.ADJUSTED_RIG, "calibration.csv"),
        *("localization.csv", "trajectory.png"),
        *("objects.csv", "objects_smoothed.csv", "object_directions.csv", _LOG),
        *("optimized.g2o", "edges.csv", "covariances.csv", "certified.g2o", "pose_graph.png"),
        *("problem.txt", "optimized.txt", "scene.ply", "bundle_adjustment.png"),
    }
)
"""All files of runs and optimisations that are alone of their kind, but for `metrics.json`."""

_NUMBERED = re.compile(
    r"trajectory_segment_\d+\.tum|graph_-?\d+_(graph\.txt|values\.txt|graph\.dot)"
)
_OBJECTS = "objects"
_OF_OBJECT = re.compile(r"\d+(\.tum|\.ply|_smoothed\.tum)")


def is_file_of_result(name: str) -> bool:
    """Whether a result has a file of this name, relative to its folder, beside `metrics.json`."""
    folder, _, last = name.rpartition("/")
    if folder:
        return folder == _OBJECTS and _OF_OBJECT.fullmatch(last) is not None
    return name in _FILES or _NUMBERED.fullmatch(name) is not None


def refuse_other_kind(folder: Path, kind: Kind) -> None:
    """Make sure that a folder has no result of another kind.

    Args:
        folder: that is written to; it may be missing.
        kind: of the result that is to be written.

    Raises:
        DataError: if it has one.
    """
    for found in (_kind_of_metrics(folder / names.METRICS), _kind_of_summary(folder)):
        if found not in (None, kind):
            raise DataError(
                f"{folder}: has the result of a {found}, which the result of a {kind} does not "
                "replace; choose another folder, or move that result away"
            )


def make_room(folder: Path) -> list[tuple[Path, Path]]:
    """Remove what an earlier result derived, if there is one, and set aside what is its only copy.

    First its `metrics.json` says that it is no longer complete. The trajectory goes next, as no
    result is read without it; `metrics.json` stays to be replaced, so that what is left after an
    interruption is known as files of a result.

    Args:
        folder: that is written to; it may be missing.

    Returns:
        What was set aside: the old and the new path of each file.

    Raises:
        DataError: if a file cannot be removed.
    """
    metrics = folder / names.METRICS
    if _kind_of_metrics(metrics) is None:
        return []
    table = _read(metrics)
    written_ns = metrics.stat().st_mtime_ns
    table |= {"status": "unfinished", "message": _REPLACED}
    Files.write_text(metrics, [json.dumps(table, indent=2), "\n"])
    with Files.writing(metrics):
        os.utime(metrics, ns=(written_ns, written_ns))  # a later recording stays later
    objects = folder / _OBJECTS
    with Files.writing(folder):
        paths = [path for path in sorted(folder.iterdir()) if is_file_of_result(path.name)]
    of_objects = sorted(objects.glob("*"))
    paths += [path for path in of_objects if is_file_of_result(f"{_OBJECTS}/{path.name}")]
    for path in [folder / names.TRAJECTORY, *paths]:
        with Files.writing(path):
            if path.name != names.MAP_NAME and (path.is_file() or path.is_symlink()):
                path.unlink()
    with Files.writing(objects):
        if objects.is_dir() and not objects.is_symlink() and not any(objects.iterdir()):
            objects.rmdir()
    recording, kept = folder / _RECORDING, [folder / names.MAP_NAME]
    if recording.is_file() and recording.stat().st_mtime_ns <= written_ns:
        kept.append(recording)  # a later one is of the run that is to be saved
    return [(path, _set_aside(path)) for path in kept if path.is_file()]


def _set_aside(path: Path) -> Path:
    """Give a file the name `…-earlier`, with a number where that is taken; returns the new path."""
    number, other = 1, path.with_stem(f"{path.stem}-earlier")
    while other.exists() or other.is_symlink():
        number += 1
        other = path.with_stem(f"{path.stem}-earlier-{number}")
    with Files.writing(other):
        os.replace(path, other)
    return other


def _kind_of_metrics(metrics: Path) -> Kind | None:
    """Of which kind the result is that has this `metrics.json`; None if it is of none."""
    table = _read(metrics)
    if not table.keys() >= _MARKS:
        return None
    return next((kind for key, kind in _KINDS.items() if key in table), None)


def _kind_of_summary(folder: Path) -> Kind | None:
    """Whether a folder is that of a comparison."""
    is_one = _read(folder / "summary.json").keys() >= _MARKS_OF_COMPARISON
    return "comparison" if is_one else None


def _read(path: Path) -> dict[str, Any]:
    """The table of a JSON file; an empty one if there is none."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return table if isinstance(table, dict) else {}
