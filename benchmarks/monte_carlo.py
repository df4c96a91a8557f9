# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Consistency over Monte Carlo runs, with and without first-estimates Jacobians.

Each seed draws another flight, landmarks, biases, noise of IMU and pixels, and an error of the
start state from its covariance; the noise is exactly what the estimators assume. The mean over R
runs of a NEES with k degrees of freedom then lies between the bounds of χ² with R k degrees of
freedom, divided by R. The flight starts in motion and never rests: a zero-velocity update would
claim an uncertainty that a platform which hovers perfectly does not have.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks.experiments import compared, configs_of, folder_of, note_failures, results_of
from benchmarks.metric import EXACT, Metric, info
from benchmarks.suite import RECURSIVE, Benchmark, Outcome
from slam_graph.evaluation.consistency import average_nees, mean_bounds
from slam_graph.experiment.comparison_figures import NEES_DOF
from slam_graph.experiment.comparison_plan import WITHOUT_FEJ, Comparison, with_variants
from slam_graph.experiment.comparison_results import Series, read_series
from slam_graph.experiment.tasks import find_sources

SEEDS = 20
DURATION_S = 15.0
CAMERAS = 2
FLIGHT = ("rate_hz=10", "tracks.features=40", "flight.hover_s=0")


def measure(data: Path) -> Outcome:
    """Mean NEES over all runs and frames, with the upper χ² bound of a mean over the runs."""
    outcome = Outcome()
    (source,) = find_sources(["sim:figure8"], DURATION_S, FLIGHT)
    configs = with_variants(configs_of(RECURSIVE, CAMERAS, DURATION_S))
    folder = folder_of("monte_carlo")
    comparison = compared(folder, [source], configs, SEEDS)
    for name in configs:
        figures = figures_of(comparison, source.name, name)
        outcome.add(name, figures, judged=not name.endswith(WITHOUT_FEJ))
    note_failures(outcome, comparison)
    outcome.notes.append(
        f"{SEEDS} flights of {DURATION_S:g} s; `inside` is the share of the frames at which the "
        "mean over the runs is within its χ² bounds; a mean below them is on the safe side"
    )
    return outcome


def figures_of(comparison: Comparison, data: str, algorithm: str) -> list[Metric]:
    """What the runs of one algorithm say."""
    results = results_of(comparison, data, algorithm)
    metrics = [Metric("finished", len(results), "runs", "higher", SEEDS, EXACT)]
    metrics += consistency([read_series(task.result) for task, _ in results])
    ran = [result["metrics"] for _, result in results]
    return [
        *metrics,
        info("nis_before_gate", _mean(m["nis"]["mean_before_gate"] for m in ran), ""),
        info("nis", _mean(m["nis"]["mean"] / m["nis"]["expected_mean"] for m in ran), ""),
        info("nis_inside", _mean(m["nis"]["inside_bounds"] for m in ran), ""),
        info("gated", _mean(m["nis"]["rejected"] for m in ran), ""),
        info(
            "position",
            _mean(m["accuracy"]["none"]["ate"]["translation_m"]["rmse"] for m in ran),
            "m",
        ),
        info("backend", _mean(m["timing"]["stages"]["backend"]["mean_ms"] for m in ran), "ms"),
    ]


def consistency(runs: list[Series]) -> list[Metric]:
    """Mean NEES, and the share of the frames at which the mean over the runs is in its bounds."""
    metrics = []
    for part, dof in NEES_DOF.items():
        mean = inside = math.nan
        if runs:
            found = average_nees(np.array([series[f"nees_{part}"] for series in runs]), dof)
            mean, inside = found.mean, found.inside
        bar = mean_bounds(dof, SEEDS)[1]
        # no baseline: within the bounds a NEES is neither better nor worse than another
        metrics.append(Metric(f"nees_{part}", mean, "", "lower", bar, tolerance=None))
        metrics.append(info(f"nees_{part}_inside", inside, ""))
    return metrics


def _mean(values: Iterable[float]) -> float:
    known = list(values)
    return float(np.mean(known)) if known else math.nan


BENCHMARKS = {
    "monte_carlo": Benchmark(
        f"{SEEDS} simulated stereo flights: NEES over runs within its χ² bounds, with and without "
        "first-estimates Jacobians",
        (),
        measure,
    )
}
