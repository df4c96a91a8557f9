# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The summary of a batch: a row for each recording, as CSV; its page is in `batch_page.py`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from slam_graph.errors import DataError
from slam_graph.experiment.batch_task import BatchTask
from slam_graph.results import ResultFolder, load_result

Row = dict[str, Any]
"""A recording of a batch, by the columns of `summary.csv`; None where a value is unknown."""

_COLUMNS = (
    *("name", "status", "message", "algorithm", "cameras", "format", "content"),
    *("recorded_s", "frames", "initialization_s", "coverage"),
    *("alignment", "ate_m", "rotation_deg", "smoothed_ate_m", "smoothed_rotation_deg"),
    *("frames_per_s", "real_time_factor", "final_ba_s", "peak_memory_mb"),
    *("warnings", "warning_kinds", "data", "folder"),
)

NOT_DONE = "not_done"
"""Status of a recording of which there is no result."""

_ALIGNMENT = "yaw"
"""Errors are those after alignment of what nothing measured: with an IMU, yaw and position."""


_ORDINARY = frozenset({"feature_not_triangulated", "feature_rejected_by_gate"})
"""Counts of single features that every run has, and no warnings: `metrics.json` has them."""


def rows_of(tasks: Sequence[BatchTask], failures: Mapping[str, str]) -> list[Row]:
    """A row for each recording.

    Args:
        tasks: the recordings.
        failures: why a recording could not be run, by its name.
    """
    return [_row(task, failures.get(task.name)) for task in tasks]


def write_csv(folder: ResultFolder, rows: Sequence[Row]) -> None:
    """Write `summary.csv`."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    folder.text("summary.csv", [text.getvalue()])


def _row(task: BatchTask, failure: str | None) -> Row:
    row: Row = dict.fromkeys(_COLUMNS)
    row |= {
        "name": task.name,
        "status": NOT_DONE,
        "message": failure or "not run yet",
        "algorithm": task.config.algorithm.name,
        "data": task.data,
    }
    if task.outcome() is None:
        return row
    try:
        metrics = load_result(task.folder).metrics
    except DataError as error:
        return row | {"message": str(error)}
    return row | _measured(metrics) | {"folder": str(task.folder)}


def _measured(metrics: Mapping[str, Any]) -> Row:
    """What the metrics of a run say."""
    dataset, extent, timing = metrics["dataset"], metrics["extent"], metrics["timing"]
    adjusted = metrics["final_ba"]
    warnings = {kind: n for kind, n in metrics["warnings"].items() if kind not in _ORDINARY}
    mode = extent.get("unmeasured", _ALIGNMENT)  # not in results of before there were others
    causal = _errors(metrics["accuracy"], mode)
    smoothed = _errors(adjusted["accuracy"] if adjusted else None, mode)
    return {
        "status": metrics["status"],
        "message": metrics["message"],
        "cameras": metrics["cameras"],
        "format": dataset["format"],
        "content": dataset["content"],
        "recorded_s": extent["recorded_s"],
        "frames": extent["frames"],
        "initialization_s": extent["initialization_s"],
        "coverage": extent["coverage"],
        "alignment": mode if causal[0] is not None or smoothed[0] is not None else None,
        "ate_m": causal[0],
        "rotation_deg": causal[1],
        "smoothed_ate_m": smoothed[0],
        "smoothed_rotation_deg": smoothed[1],
        "frames_per_s": timing["frames_per_s"],
        "real_time_factor": timing["real_time_factor"],
        "final_ba_s": adjusted["seconds"] if adjusted else None,
        "peak_memory_mb": metrics["peak_memory_mb"],
        "warnings": sum(warnings.values()),
        "warning_kinds": ", ".join(f"{kind} {count}" for kind, count in warnings.items()),
    }


def _errors(accuracy: Mapping[str, Any] | None, mode: str) -> tuple[float | None, float | None]:
    """Root mean square errors of position, m, and orientation, degrees; None without a truth."""
    errors = (accuracy or {}).get(mode, {}).get("ate")
    if errors is None:  # no truth, or the alignment is unavailable
        return None, None
    return errors["translation_m"]["rmse"], errors["rotation_deg"]["rmse"]
