# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The figures of a comparison: errors, NEES and work of all algorithms, over time and distance."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.evaluation import mean_bounds
from slam_graph.experiment.comparison_plan import Comparison
from slam_graph.experiment.comparison_results import (
    ALIGNMENTS,
    STAGE,
    Series,
    read_result,
    read_series,
)
from slam_graph.experiment.tasks import RunTask
from slam_graph.results import ResultFolder
from slam_graph.visualization import Panel, panel_figure

_BINS = 200
"""Number of equal bins of time or distance in which series are averaged, also over the seeds."""

_TIME = ("time_s", "time [s]")
_DISTANCE = ("distance_m", "distance [m]")
PARTS = (("translation_m", "translation error [m]"), ("rotation_deg", "rotation error [deg]"))

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
    folder = ResultFolder(comparison.folder / "figures")
    for mode in ALIGNMENTS:
        panels = [
            Panel(xlabel, ylabel, _curves(runs, x, f"{part}_{mode}"))
            for part, ylabel in PARTS
            for x, xlabel in (_TIME, _DISTANCE)
        ]
        title = f"{data}: errors, alignment {mode}{mean}"
        yield from _draw_panels(folder, f"{data}_errors_{mode}.png", title, panels)
    panels = _consistency_panels(runs, max(seeds, 1))
    yield from _draw_panels(folder, f"{data}_nees.png", f"{data}: consistency{mean}", panels)
    panels = [
        Panel(_TIME[1], "ms per frame", _curves(runs, "frame_time_s", f"ms_{STAGE}")),
        Panel(_TIME[1], "columns of the state", _curves(runs, "step_time_s", "columns")),
        Panel(_TIME[1], "steps per frame", _curves(runs, "step_time_s", "steps")),
        Panel(_TIME[1], "cost before the steps", _curves(runs, "step_time_s", "cost_before")),
        Panel(_TIME[1], "cost after the steps", _curves(runs, "step_time_s", "cost_after")),
    ]
    title = f"{data}: work of the back end{mean}"
    yield from _draw_panels(folder, f"{data}_steps.png", title, panels)


def _consistency_panels(runs: dict[str, list[Series]], seeds: int) -> list[Panel]:
    """NEES with the χ² bounds of a mean over the seeds, and NIS."""
    panels = [
        Panel(
            _TIME[1],
            f"NEES of the {part}",
            _curves(runs, "nees_time_s", f"nees_{part}"),
            band=mean_bounds(dof, seeds),
            band_label="95 % of χ²",
        )
        for part, dof in NEES_DOF.items()
    ]
    label = "NIS / expected"
    return [*panels, Panel(_TIME[1], label, _curves(runs, "nis_time_s", "nis_ratio"))]


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
    return [read_series(task.result) for task in mine if _is_whole(task)]


def _is_whole(task: RunTask) -> bool:
    result = read_result(task.result)
    return result is not None and result["metrics"]["status"] in ("ok", "low_coverage")


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
    """Draw the panels that have curves, if any."""
    shown = [panel for panel in panels if panel.curves]
    if shown:
        with folder.appearing(name) as partial:
            panel_figure(title, shown).savefig(partial, format="png")
        yield Figure(folder.files[-1], title)
