# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The table of an experiment: a row for each algorithm on each data, means over the seeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from slam_graph.experiment.comparison import Comparison
from slam_graph.experiment.comparison_results import ALIGNMENTS, Table, read_result, read_series
from slam_graph.experiment.tasks import RunTask

STAGE = "backend"
"""The stage of the pipeline that algorithms differ in."""


def summarize(comparison: Comparison) -> list[Table]:
    """A row for each algorithm on each data, in the order of the plan.

    Errors, NEES and times are means over the runs that ended well; peak memory is the largest.
    """
    groups: dict[tuple[str, str], list[RunTask]] = {}
    for task in comparison.runs:
        groups.setdefault((task.data, task.algorithm), []).append(task)
    return [_row(data, algorithm, tasks) for (data, algorithm), tasks in groups.items()]


def _row(data: str, algorithm: str, tasks: list[RunTask]) -> Table:
    found = [(task, read_result(task.result)) for task in tasks if task.is_done()]
    results = [result for _, result in found if result is not None]
    statuses = Counter(result["metrics"]["status"] for result in results)
    statuses["not_done"] = len(tasks) - len(results)
    good = [result["metrics"] for result in results if result["metrics"]["status"] == "ok"]
    ends = [cost_at_ends(task) for task, result in found if result is not None]
    return {
        "data": data,
        "algorithm": algorithm,
        "seeds": len(tasks),
        "status": dict(+statuses),
        "ate_m": {mode: _mean(good, _ate(mode, "translation_m")) for mode in ALIGNMENTS},
        "orientation_deg": {mode: _mean(good, _ate(mode, "rotation_deg")) for mode in ALIGNMENTS},
        "nees": {
            part: _mean(good, lambda m, part=part: m["nees"][part]["mean"])  # type: ignore[misc]
            for part in ("orientation", "position", "pose")
        },
        "nis": {
            part: _mean(good, lambda m, part=part: m["nis"][part])  # type: ignore[misc]
            for part in ("mean", "expected_mean", "mean_before_gate", "inside_bounds", "rejected")
        },
        "steps": _average(r["mean_steps"] for r in results if r["mean_steps"] is not None),
        "ms_per_frame": _mean(good, lambda m: m["timing"]["stages"][STAGE]["mean_ms"]),
        "ms_first_third": _average(first for first, _ in ends),
        "ms_last_third": _average(last for _, last in ends),
        "peak_memory_mb": max(
            (r["metrics"]["peak_memory_mb"] or 0.0 for r in results), default=None
        ),
    }


def cost_at_ends(task: RunTask) -> tuple[float, float]:
    """Median milliseconds a frame of the first and of the last third of the estimated frames."""
    series = read_series(task.result)
    values = series.get(f"ms_{STAGE}", np.zeros(0))
    values = values[np.isfinite(series.get("ms_backend.gauss_newton", values))]
    third = len(values) // 3
    if third == 0:
        return np.nan, np.nan
    return float(np.median(values[:third])), float(np.median(values[-third:]))


def _ate(mode: str, part: str) -> Callable[[Table], Any]:
    return lambda metrics: metrics["accuracy"][mode]["ate"][part]["rmse"]


def _mean(metrics: list[Table], get: Callable[[Table], Any]) -> float | None:
    """Mean over the runs that have the number."""
    return _average(_numbers(metrics, get))


def _numbers(metrics: list[Table], get: Callable[[Table], Any]) -> Iterator[float]:
    for table in metrics:
        try:
            value = get(table)
        except (KeyError, TypeError):
            continue  # no ground truth, no covariance, or nothing to align
        if value is not None:
            yield value


def _average(values: Iterable[float]) -> float | None:
    """Mean of the finite ones, or None."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None
