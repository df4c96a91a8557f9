# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The figures of a comparison: paths, errors and times at a glance, and over time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.evaluation import mean_bounds
from slam_graph.experiment.comparison_plan import Comparison
from slam_graph.experiment.comparison_results import (
    STAGE,
    Series,
    Table,
    alignment_of,
    numbers,
    read_result,
    read_series,
)
from slam_graph.experiment.tasks import RunTask
from slam_graph.results import ResultFolder
from slam_graph.visualization import Panel, panel_figure

_BINS = 200
"""Number of equal bins of time in which series are averaged, also over the seeds."""

_TIME = "time [s]"

_ERRORS = (("translation_m", "position error [m]"), ("rotation_deg", "orientation error [deg]"))

_NEES_LABEL = "NEES of the pose"

NEES_DOF = {"orientation": 3, "position": 3, "pose": 6}


@dataclass(frozen=True)
class Figure:
    """A picture in the report."""

    file: Path
    title: str


def draw(comparison: Comparison, data: str) -> Iterator[Figure]:
    """Draw all figures of one data set.

    Args:
        comparison: with its tasks done.
        data: name of the source.
    """
    tasks = [task for task in comparison.runs if task.data == data and task.is_done()]
    runs = {task.algorithm: _series(tasks, task.algorithm) for task in tasks}
    seeds = max((len(series) for series in runs.values()), default=0)
    mean = f", mean over {seeds} seeds" if seeds > 1 else ""
    over = f"; a dot for each of {seeds} seeds, the number is their median" if seeds > 1 else ""
    folder = ResultFolder(comparison.folder / "figures")
    yield from _draw_panels(folder, f"{data}_paths.png", f"{data}: causal paths", _paths(runs))
    panels = _summary_panels(tasks)
    shown = "errors (root mean square of a run) and cost" if len(panels) > 1 else "cost"
    yield from _draw_panels(folder, f"{data}_summary.png", f"{data}: {shown}{over}", panels)
    panels = [Panel(_TIME, label, _curves(runs, "time_s", part)) for part, label in _ERRORS]
    title = f"{data}: errors over time, aligned in what nothing measured{mean}"
    yield from _draw_panels(folder, f"{data}_errors.png", title, panels)
    panels = _consistency_panels(runs, max(seeds, 1))
    yield from _draw_panels(folder, f"{data}_nees.png", f"{data}: consistency{mean}", panels)
    panels = [
        Panel(_TIME, "ms per frame", _curves(runs, "frame_time_s", f"ms_{STAGE}")),
        Panel(_TIME, "columns of the state", _curves(runs, "step_time_s", "columns")),
        Panel(_TIME, "steps per frame", _curves(runs, "step_time_s", "steps")),
        Panel(_TIME, "decrease of the cost", _curves(runs, "step_time_s", "cost_decrease")),
    ]
    title = f"{data}: work of the back end{mean}"
    yield from _draw_panels(folder, f"{data}_steps.png", title, panels)


def _paths(runs: dict[str, list[Series]]) -> list[Panel]:
    """The paths of the first seed over one another, from above and from the side."""
    first = {name: series[0] for name, series in runs.items() if series and "path" in series[0]}
    paths = {name: series["path"] for name, series in first.items()}
    truths = [series["true_path"] for series in first.values() if "true_path" in series]
    if truths:
        paths = {"ground truth": max(truths, key=len)} | paths
    return [
        Panel(
            "x [m]",
            f"{'xyz'[axis]} [m]",
            {name: (path[:, 0], path[:, axis]) for name, path in paths.items() if len(path)},
            "path",
            title=title,
        )
        for axis, title in ((1, "from above"), (2, "from the side"))
    ]


def _summary_panels(tasks: list[RunTask]) -> list[Panel]:
    """Errors, consistency and cost of each run that ended well, by algorithm."""
    runs: dict[str, list[Table]] = {task.algorithm: [] for task in tasks}
    for task in tasks:
        result = read_result(task.result)
        if result is not None and result["metrics"]["status"] == "ok":
            runs[task.algorithm].append(result["metrics"])
    quantities: dict[str, Callable[[Table], Any]] = {
        label: lambda m, part=part: m["accuracy"][alignment_of(m)]["ate"][part]["rmse"]  # type: ignore[misc]
        for part, label in _ERRORS
    }
    quantities[_NEES_LABEL] = lambda m: m["nees"]["pose"]["mean"]
    quantities["back end, ms per frame"] = lambda m: m["timing"]["stages"][STAGE]["mean_ms"]
    panels = []
    for label, get in quantities.items():
        samples = {name: np.array(list(numbers(metrics, get))) for name, metrics in runs.items()}
        if any(len(values) for values in samples.values()):
            ideal = float(NEES_DOF["pose"]) if label == _NEES_LABEL else None
            panels.append(Panel(label, "", samples=samples, ideal=ideal))
    return panels


def _consistency_panels(runs: dict[str, list[Series]], seeds: int) -> list[Panel]:
    """NEES with the χ² bounds of a mean over the seeds, and NIS."""
    panels = [
        Panel(
            _TIME,
            f"NEES of the {part}",
            _curves(runs, "nees_time_s", f"nees_{part}"),
            band=mean_bounds(dof, seeds),
            band_label="95 % of χ²",
            ideal=float(dof),
        )
        for part, dof in NEES_DOF.items()
    ]
    label = "NIS / expected"
    return [*panels, Panel(_TIME, label, _curves(runs, "nis_time_s", "nis_ratio"))]


def binned_mean(x: FloatArray, y: FloatArray, edges: FloatArray) -> FloatArray:
    """Mean of the finite values in each bin; NaN where there is none.

    Args:
        x: (N,) where the values are.
        y: (N,) values.
        edges: (B + 1,) of the bins, increasing.
    """
    known = np.isfinite(y)
    sums, _ = np.histogram(x[known], edges, weights=y[known])
    counts, _ = np.histogram(x[known], edges)
    means = np.full(len(counts), np.nan)
    np.divide(sums, counts, out=means, where=counts > 0)
    return means


def _series(tasks: list[RunTask], algorithm: str) -> list[Series]:
    """The series of all runs of an algorithm that reached the end."""
    mine = (task for task in tasks if task.algorithm == algorithm)
    found = [read_series(task.result) for task in mine if _is_whole(task)]
    return [
        {**series, "cost_decrease": series["cost_before"] - series["cost_after"]}
        for series in found
    ]


def _is_whole(task: RunTask) -> bool:
    result = read_result(task.result)
    return result is not None and result["metrics"]["status"] in ("ok", "suspect", "low_coverage")


def _curves(
    runs: dict[str, list[Series]], x: str, y: str
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """A curve for each algorithm that has the series."""
    known = {
        name: [(series[x], series[y]) for series in all_series if x in series and y in series]
        for name, all_series in runs.items()
    }
    end = max((xs[-1] for pairs in known.values() for xs, _ in pairs if len(xs)), default=0.0)
    if end <= 0.0:
        return {}
    edges = np.linspace(0.0, end, _BINS + 1)
    centres = (edges[:-1] + edges[1:]) / 2.0
    curves = {}
    for name, pairs in known.items():
        if pairs:
            means = binned_mean(
                np.tile(centres, len(pairs)),
                np.concatenate([binned_mean(xs, ys, edges) for xs, ys in pairs]),
                edges,
            )
            filled = np.isfinite(means)
            if filled.any():
                curves[name] = (centres[filled], means[filled])
    return curves


def _draw_panels(
    folder: ResultFolder, name: str, title: str, panels: Iterable[Panel]
) -> Iterator[Figure]:
    """Draw the panels that have something to show, if any."""
    shown = [panel for panel in panels if panel.curves or panel.samples]
    if shown:
        with folder.appearing(name) as partial:
            panel_figure(title, shown).write(partial)
        yield Figure(folder.files[-1], title)
