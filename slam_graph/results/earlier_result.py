# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A folder that has files of an earlier result: they are removed before another is written there.

So the files of two results are never taken for one. What others wrote into the folder stays.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from slam_graph.files import Files
from slam_graph.results import result_files as names

_MARKS = frozenset({"schema_version", "versions"})
"""What `metrics.json` of every result has."""

_LOG, _RECORDING = "run.log", "recording.rrd"

_FILES = frozenset(
    {
        *(names.TRAJECTORY, names.SMOOTHED, names.LOOP_CLOSED, names.IN_MAP, names.GROUNDTRUTH),
        *(names.STATES, names.SMOOTHED_STATES, names.SEGMENTS, names.POINTS, names.LOOP_POINTS),
        *(names.LOOPS, names.TIMING, names.FRAMES, names.CONFIG, names.MAP_NAME),
        *(names.RIG, names.ESTIMATED_RIG, "calibration.csv", "localization.csv", "trajectory.png"),
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


def remove_earlier(folder: Path) -> None:
    """Remove the files of an earlier result, if there is one; all others stay.

    The trajectory goes first, as there is no result without; `metrics.json` stays to be replaced,
    so that what is left after an interruption is known as files of a result.

    Args:
        folder: that is written to; it may be missing.

    Raises:
        DataError: if a file cannot be removed.
    """
    metrics = folder / names.METRICS
    if not _is_of_result(metrics):
        return
    paths = [path for path in sorted(folder.iterdir()) if is_file_of_result(path.name)]
    of_objects = sorted((folder / _OBJECTS).glob("*"))
    paths += [path for path in of_objects if is_file_of_result(f"{_OBJECTS}/{path.name}")]
    recording = folder / _RECORDING
    if recording.is_file() and recording.stat().st_mtime_ns <= metrics.stat().st_mtime_ns:
        paths.append(recording)  # a later one is of the run that is to be saved
    for path in [folder / names.TRAJECTORY, *paths]:
        with Files.writing(path):
            if path.is_file() or path.is_symlink():
                path.unlink()
    if (folder / _OBJECTS).is_dir() and not any((folder / _OBJECTS).iterdir()):
        (folder / _OBJECTS).rmdir()


def _is_of_result(metrics: Path) -> bool:
    """Whether a file is the `metrics.json` of a result."""
    try:
        table = json.loads(metrics.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(table, dict) and table.keys() >= _MARKS
