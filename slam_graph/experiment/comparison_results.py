# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Results of one run of a comparison: a JSON file with metrics and an NPZ file with series.

Series of the NPZ file, over the N frames that have a true pose, the K of them that also have a
covariance, or all F frames:

- `path`, `true_path` (N, 3): positions, aligned with the truth in what nothing measured (yaw and
  position with an IMU), and the true ones; without a truth only `path` (S, 3) of all states, in
  the world of the run;
- `translation_m`, `rotation_deg` (N,): errors after that alignment;
- `time_s`, `distance_m` (N,): since the first frame; along the true path;
- `translation_m_MODE`, `rotation_deg_MODE` (N,): errors, for each alignment; of a run in several
  worlds each is aligned by itself, and errors are NaN in those that the alignment lacks;
- `nees_time_s`, `nees_orientation`, `nees_position`, `nees_pose` (K,);
- `step_time_s`, `steps`, `columns`, `cost_before`, `cost_after` (G,): for the G frames with
  Gauss-Newton steps, their number, the dimension of the state and the cost;
- `nis_time_s`, `nis_ratio`, and `nis_COLUMN` (I,): for the I frames with innovations, these
  (`slam_graph.backend.cost.gating.Innovations`), and NIS over its expected value;
- `frame_time_s`, `ms_STAGE` (F,): milliseconds of each stage; NaN where it did not run.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import DataError
from slam_graph.evaluation import ape, nees_of_run, synchronize
from slam_graph.files import Files
from slam_graph.geometry import AlignmentMode, Trajectory
from slam_graph.results import ResultFolder, RunResult, SavedRun

SCHEMA_VERSION = 5

ALIGNMENTS: tuple[AlignmentMode, ...] = ("none", "yaw", "se3", "sim3")

STAGE = "backend"
"""The stage of the pipeline in which algorithms differ."""

_DAMAGED = (
    *(OSError, ValueError, RecursionError, EOFError),
    *(BadZipFile, zlib.error, NotImplementedError),
)
"""What is raised for files that are not JSON, or no archive of arrays."""

_PATHS = ("path", "true_path")
_TIMES = {
    "ms_": "frame_time_s",
    "nis_": "nis_time_s",
    "nees_": "nees_time_s",
    **dict.fromkeys(("step", "cost_", "columns"), "step_time_s"),
    **dict.fromkeys(("distance_m", "translation_m", "rotation_deg", "true_path"), "time_s"),
}
"""The times of series, by what their names begin with."""

Series = dict[str, NDArray[Any]]
"""Arrays by the names above."""

Table = dict[str, Any]
"""A JSON object."""


def write_result(path: Path, result: RunResult, about: Table) -> None:
    """Write the results of a run, the JSON file last: if it exists, so do the series.

    Args:
        path: of the JSON file.
        result: the run.
        about: data, algorithm, seed and hash of the settings.
    """
    folder = ResultFolder(path.parent)
    path.unlink(missing_ok=True)
    with folder.appearing(path.with_suffix(".npz").name) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **_series_of(result))  # type: ignore[arg-type]  # its last keyword
    table = {
        "schema_version": SCHEMA_VERSION,
        **about,
        "metrics": result.metrics,
        "mean_steps": float(result.logs.steps.steps.mean()) if len(result.logs.steps) else None,
        "config": result.config.model_dump(mode="json"),
    }
    folder.json(path.name, table)


def read_result(path: Path) -> Table | None:
    """The JSON file of a run; None if it or its series are missing, damaged or of another version.

    The series are checked by their sums, which is much faster than to read the arrays.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        with ZipFile(path.with_suffix(".npz")) as series:
            damaged = series.testzip() is not None
    except _DAMAGED:
        return None
    valid = isinstance(table, dict) and table.get("schema_version") == SCHEMA_VERSION
    return table if valid and not damaged and _is_whole(table) else None


def _is_whole(table: Table) -> bool:
    """Whether the content of a JSON file is what `write_result` wrote."""
    steps, metrics = table.get("mean_steps", ""), table.get("metrics")
    return (
        isinstance(table.get("settings_hash"), str)
        and (steps is None or _is_number(steps))
        and SavedRun.fault_of_metrics(metrics) is None
        and "unmeasured" in table["metrics"]["extent"]
    )


def _is_number(value: object) -> bool:
    """Whether a value is a number of which a mean can be taken."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= Files.LARGEST


def read_series(path: Path) -> Series:
    """The series beside the JSON file of a run.

    Raises:
        DataError: if it is no archive of series of numbers that belong together.
    """
    file = path.with_suffix(".npz")
    try:
        with np.load(file, allow_pickle=False) as archive:
            series = {name: archive[name] for name in archive.files}
        for name, values in series.items():
            _check_series(name, values, series)
    except (*_DAMAGED, MemoryError) as error:
        raise DataError(f"{file}: not the series of a run ({error}); run it again") from error
    return series


def _check_series(name: str, values: NDArray[Any], series: Series) -> None:
    """Refuse a series that is not of numbers, or not as long as its times.

    Raises:
        ValueError: naming it.
    """
    shape = (len(values), 3) if name in _PATHS and values.ndim else (values.size,)
    if values.dtype.kind not in "fiu" or values.shape != shape:
        raise ValueError(f"'{name}' is not of numbers, or has another shape")
    times = next((times for start, times in _TIMES.items() if name.startswith(start)), "")
    if times in series and len(values) != len(series[times]):
        raise ValueError(f"'{name}' is not as long as '{times}'")


def _series_of(result: RunResult) -> Series:
    """All series of a run; errors and NEES only if there is ground truth."""
    series: Series = {
        f"ms_{stage}": result.logs.timing.column(stage) for stage in result.logs.timing.stages()
    }
    series["frame_time_s"] = (result.logs.timing.stamps_ns - result.input.start_ns) * 1e-9
    series["step_time_s"] = (result.logs.steps.stamps_ns - result.input.start_ns) * 1e-9
    series["steps"] = result.logs.steps.steps
    series["cost_before"], series["cost_after"] = result.logs.steps.costs.T
    series["columns"] = result.logs.steps.columns
    series |= _innovation_series(result)
    truth = result.groundtruth
    if truth is not None and len(result.history) > 0:
        series |= _error_series(truth, result)
        series |= _nees_series(truth, result)
    else:
        series["path"] = result.trajectory.positions
    return series


def _error_series(truth: Trajectory, result: RunResult) -> Series:
    try:
        true, estimate = synchronize(truth, result.trajectory)
    except DataError:
        return {}
    camera = result.history.scaled_camera
    if camera is not None:
        true, estimate = (path.mounted(camera) for path in (true, estimate))
    free, breaks = result.history.free, result.segments.breaks_ns()
    with suppress(DataError):  # without motion the alignment is undetermined
        known = ape(true, estimate, alignment=free, breaks_ns=breaks).alignment.known
        rows = np.flatnonzero(known(estimate.stamps_ns))
        true, estimate = true.select(rows), estimate.select(rows)
    steps = np.linalg.norm(np.diff(true.positions, axis=0), axis=1)
    series: Series = {
        "time_s": (estimate.stamps_ns - result.input.states_ns[0]) * 1e-9,
        "distance_m": np.concatenate([[0.0], np.cumsum(steps)]),
        "true_path": true.positions,
    }
    for mode in ALIGNMENTS if result.history.has_scale else ("sim3",):
        try:
            translation = ape(true, estimate, "trans_part", mode, breaks_ns=breaks)
        except DataError:
            continue  # without motion the alignment is undetermined
        rotation = ape(true, estimate, "angle_deg", mode, breaks_ns=breaks)
        rows = np.flatnonzero(translation.alignment.known(estimate.stamps_ns))
        for name, found in (("translation_m", translation), ("rotation_deg", rotation)):
            series[f"{name}_{mode}"] = np.full(len(estimate), np.nan)
            series[f"{name}_{mode}"][rows] = found.values
        if mode == free:
            series["translation_m"] = series[f"translation_m_{mode}"]
            series["rotation_deg"] = series[f"rotation_deg_{mode}"]
            series["path"] = translation.alignment.apply(estimate).positions
    return series


def _nees_series(truth: Trajectory, result: RunResult) -> Series:
    try:
        aligned, breaks = result.in_world_of_truth, result.segments.breaks_ns()
        values, _ = nees_of_run(truth, result.history, aligned, result.final_ba, breaks)
    except DataError:
        return {}
    return {
        "nees_time_s": (values.stamps_ns - result.input.states_ns[0]) * 1e-9,
        "nees_orientation": values.orientation,
        "nees_position": values.position,
        "nees_pose": values.pose,
    }


def _innovation_series(result: RunResult) -> Series:
    columns = result.logs.innovations.columns()
    expected = columns["expected"]
    ratio = np.full(len(expected), np.nan)
    np.divide(columns["passed_distance"], expected, out=ratio, where=expected > 0)
    return {
        "nis_time_s": (result.logs.innovations.stamps_ns - result.input.start_ns) * 1e-9,
        "nis_ratio": ratio,
        **{f"nis_{name}": values for name, values in columns.items()},
    }


def alignment_of(metrics: Table) -> AlignmentMode:
    """The alignment that takes away what nothing measured in a run, and no more."""
    mode: AlignmentMode = metrics["extent"]["unmeasured"]
    return mode


def numbers(metrics: list[Table], get: Callable[[Table], Any]) -> Iterator[float]:
    """A number of each run that has it."""
    for table in metrics:
        try:
            value = get(table)
        except (KeyError, TypeError):
            continue  # no ground truth, no covariance, or nothing to align
        if _is_number(value):
            yield value
