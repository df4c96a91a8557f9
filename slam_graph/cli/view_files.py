# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What `slam-graph view` finds in files: runs, comparisons, optimisations, maps, graphs."""

from __future__ import annotations

import csv
import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile, is_zipfile

if TYPE_CHECKING:
    from slam_graph.arrays import FloatArray
    from slam_graph.datasets import Sequence
    from slam_graph.visualization import RerunRecording

_Show = Callable[["RerunRecording"], None]
_ERRORS = ("time_s", "translation_m", "rotation_deg")
_ERROR_TITLES = ("time_s", "position error [m]", "orientation error [deg]")
_DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, MemoryError)
"""What NumPy raises for a file that is no archive of arrays, or lacks one."""
_SAME_PART = 1e-4
"""Poses of a file that are nearer than this part of their extent to those of odometry alone are
these: files round them.
"""
_GRAPH_SUFFIXES = {".g2o", ".graph", ".toro"}


@dataclass(frozen=True)
class RunOptions:
    """What is shown of a run beside its files.

    Attributes:
        known_map: file of the map that it was located in.
        recording: that was run, with its images or tracks and IMU samples.
        images: whether images of the recording are shown.
    """

    known_map: Path | None = None
    recording: Sequence | None = None
    images: bool = True


def of_folder(folder: Path, options: RunOptions | None = None) -> _Show | None:
    """What logs a folder of results; None if it is none.

    Args:
        folder: with the files.
        options: for a run.

    Raises:
        DataError: if a file is damaged.
    """
    if (folder / "optimized.g2o").is_file():
        return _optimized_graph(folder)
    if (folder / "optimized.txt").is_file():
        return _optimized_bundle(folder)
    if (folder / "runs").is_dir() and (folder / "summary.json").is_file():
        return _comparison(folder)
    if is_run(folder):
        return _run(folder, options or RunOptions())
    if (folder / "map.slam").is_file():
        return _map(folder / "map.slam")
    return None


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run."""
    return (folder / "metrics.json").is_file() and (folder / "trajectory.tum").is_file()


def of_file(path: Path) -> _Show | None:
    """What logs a map or a problem for `slam-graph optimize`; None if it is neither."""
    from slam_graph.bundle_adjustment import is_bal

    if path.suffix == ".slam" or (is_zipfile(path) and path.suffix != ".zip"):
        return _map(path)
    if path.suffix in _GRAPH_SUFFIXES:
        return _graph(path)
    if path.suffix in (".txt", ".bz2") and is_bal(path):
        return _bundle(path)
    if path.suffix == ".txt" and _begins_like_graph(path):
        return _graph(path)
    return None


def _begins_like_graph(path: Path) -> bool:
    """Whether the first line is one of a pose graph."""
    from slam_graph.errors import DataError

    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return file.readline().startswith(("VERTEX", "EDGE", "ODOMETRY", "LANDMARK"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def _graph(path: Path) -> _Show:
    """A pose graph as it is in its file beside odometry alone, or one of both if they agree."""
    from slam_graph.pose_graph import PoseGraphSolution, read_pose_graph

    graph = read_pose_graph(path)
    odometry = replace(graph, estimates=None)
    alone = PoseGraphSolution.of(odometry, graph.anchor_poses()).before
    poses = graph.estimates or alone
    solution = PoseGraphSolution.of(odometry, poses)
    titles = {"before": "Odometry alone", "after": "As in the file"}
    if graph.estimates is None:
        del titles["after"]
    elif _is_same(poses.translations, alone.translations):
        titles = {"after": "As in the file: odometry alone"}
    return lambda recording: recording.show_pose_graph(solution, titles)


def _is_same(first: FloatArray, second: FloatArray) -> bool:
    """Whether positions (N, 3) differ by no more than a file rounds them."""
    import numpy as np

    extent = float(np.linalg.norm(np.ptp(second, axis=0))) if len(second) else 0.0
    return bool(np.abs(first - second).max(initial=0.0) <= _SAME_PART * extent)


def _optimized_graph(folder: Path) -> _Show:
    """A pose graph that was optimised, after odometry alone, with the weights of its edges."""
    import numpy as np

    from slam_graph.errors import DataError
    from slam_graph.pose_graph import PoseGraphSolution, read_pose_graph

    path, edges = folder / "optimized.g2o", folder / "edges.csv"
    graph = read_pose_graph(path)
    if graph.estimates is None:
        raise DataError(f"{path}: has no poses; it is no graph that was optimised")
    try:
        with edges.open(encoding="utf-8", newline="") as file:
            weights = np.array([float(row["weight"]) for row in csv.DictReader(file)])
        if not ((weights >= 0.0) & (weights <= 1.0)).all():
            raise ValueError("a weight is not from 0 to 1")
    except OSError as error:
        raise DataError(f"{edges}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(f"{edges}: not the edges of a graph ({error})") from error
    if len(weights) != len(graph.edges):
        count = len(graph.edges)
        raise DataError(f"{edges}: has {len(weights)} edges, {path.name} beside it {count}")
    odometry = replace(graph, estimates=None, name=folder.resolve().parent.name)
    solution = PoseGraphSolution.of(odometry, graph.estimates, weights)
    titles = {"before": "Odometry alone", "after": "After"}
    return lambda recording: recording.show_pose_graph(solution, titles)


def _bundle(path: Path) -> _Show:
    """A bundle-adjustment problem as it is in its file."""
    from slam_graph.bundle_adjustment import BalSolution, read_bal

    solution = BalSolution.unsolved(read_bal(path))
    return lambda recording: recording.show_bundle(solution)


def _optimized_bundle(folder: Path) -> _Show:
    """A bundle adjustment: the problem as it was read, and the optimum."""
    from slam_graph.bundle_adjustment import BalSolution, read_bal
    from slam_graph.errors import DataError

    path = folder / "problem.txt"
    if not path.is_file():  # of an earlier version
        return _bundle(folder / "optimized.txt")
    problem, optimum = read_bal(path), read_bal(folder / "optimized.txt")
    if (problem.cameras, problem.points) != (optimum.cameras, optimum.points):
        raise DataError(f"{path}: not the problem of {folder / 'optimized.txt'}")
    named = replace(problem, name=folder.resolve().parent.name)
    solution = BalSolution.of(named, optimum.estimates)
    return lambda recording: recording.show_bundle(solution)


def _map(path: Path) -> _Show:
    from slam_graph.results import load_map

    content = load_map(path)
    return lambda recording: recording.show_map(content)


def _run(folder: Path, options: RunOptions) -> _Show:
    """A run from its files."""
    from slam_graph.results import load_map, load_result

    saved = load_result(folder)
    known = None if options.known_map is None else load_map(options.known_map)
    log = folder / "run.log"
    # the log is for reading: what is damaged in it is seen, and costs nothing else
    lines = log.read_text("utf-8", errors="replace").splitlines() if log.is_file() else []
    # paths and points can be shown without the cameras
    rig = saved.estimated_rig if (folder / "calibration.yaml").is_file() else None
    by_frame = saved.by_frame
    return lambda recording: recording.show_run(
        saved,
        saved.points,
        saved.timing,
        by_frame,
        rig,
        lines,
        known,
        options.recording,
        options.images,
    )


def _comparison(folder: Path) -> _Show:
    """A comparison by `slam-graph compare`: all algorithms on the first data, with one seed."""
    import numpy as np

    from slam_graph.errors import DataError

    files = _series_of_comparison(folder)
    runs: dict[str, dict[str, FloatArray]] = {}
    true_path: FloatArray | None = None
    for file in files:
        if file.parent != files[0].parent:
            continue
        try:
            with file.open("rb") as data, np.load(data, allow_pickle=False) as series:
                run = {"path": _numbers(series, "path", 3), "time_s": np.zeros(0)}
                if "time_s" in series and "translation_m" in series:
                    columns = np.stack([_numbers(series, name, 1)[:, 0] for name in _ERRORS])
                    run |= dict(zip(_ERROR_TITLES, columns, strict=True))
                elif len(run["path"]) == 0:
                    continue  # without motion
                if "true_path" in series:
                    true_path = _numbers(series, "true_path", 3)
        except (*_DAMAGED, BadZipFile, zlib.error) as error:
            raise DataError(f"{file}: not the series of a run ({error})") from error
        runs[file.stem] = run
    if not runs:
        raise DataError(f"{folder}: nothing to show: no run has a path")
    true_paths = {} if true_path is None else {"ground truth": true_path}
    return lambda recording: recording.show_comparison(runs, true_paths)


def _series_of_comparison(folder: Path) -> list[Path]:
    """The series of the runs of a comparison, and of no earlier one in the same folder.

    Raises:
        DataError: if its summary is damaged.
    """
    from slam_graph.errors import DataError

    path = folder / "summary.json"
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        names = table.get("runs")
        if names is None:  # of an earlier version
            return sorted((folder / "runs").glob("*/*.npz"))
        return [folder / f"{name}.npz" for name in names]
    except (*_DAMAGED, RecursionError) as error:
        raise DataError(f"{path}: not the summary of a comparison ({error})") from error


def _numbers(series: Mapping[str, Any], name: str, width: int) -> FloatArray:
    """(N, width) numbers of a series of a comparison; none if it is not there.

    Raises:
        ValueError: if it is of another kind.
    """
    import numpy as np

    if name not in series:
        return np.zeros((0, width))
    values = np.asarray(series[name])
    rows = values[:, None] if values.ndim == 1 and width == 1 else values
    if values.dtype.kind not in "fiu" or rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"'{name}' is not of numbers, or has another shape")
    return np.asarray(rows, np.float64)
