# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a frame costs as a flight goes on: flat where the state is bounded, growing where it is not.

Milliseconds of the back end and dimension of the state, over one simulated flight, and as a
picture. The runs are made one after the other, so that they do not take one another's time.

The state of an EKF grows with the features. What a frame costs grows with it where features are
recognised when they are seen again; features that stay lost are conditionals put aside, at no cost.
So the unbounded filters fly twice: with features that are new when they come back, as those of a
tracker are, and with features that keep their identity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.experiments import compared, configs_of, folder_of, note_failures, results_of
from benchmarks.metric import TIMING_TOLERANCE, Metric, info
from benchmarks.suite import GROWING, PEERS, RECURSIVE, UNBOUNDED, Benchmark, Outcome
from slam_graph.experiment.comparison_figures import draw
from slam_graph.experiment.comparison_plan import Comparison
from slam_graph.experiment.comparison_results import Series, read_series
from slam_graph.experiment.tasks import find_sources

DURATION_S = 60.0
CAMERAS = 2
FLIGHT = ("rate_hz=10", "tracks.features=25", "flight.hover_s=0")

FLAT_BAR = 1.2
RECOGNISED = "tracks.keep_ids=true"


def measure(data: Path) -> Outcome:
    """Time and size of the last quarter of the flight over those of the second quarter."""
    outcome = Outcome()
    _fly(outcome, "", FLIGHT, (*RECURSIVE, *PEERS))
    _fly(outcome, ".recognised", (*FLIGHT, RECOGNISED), UNBOUNDED)
    outcome.notes.append(
        "times are by the wall clock: other programs show in them, but not in the columns"
    )
    return outcome


def _fly(outcome: Outcome, suffix: str, flight: Sequence[str], names: Sequence[str]) -> None:
    """Let some algorithms fly one after the other."""
    (source,) = find_sources(["sim:figure8"], DURATION_S, flight)
    folder = folder_of(f"cost_over_time{suffix}")
    comparison = compared(folder, [source], configs_of(names, CAMERAS, DURATION_S), workers=1)
    for name in names:
        figures = figures_of(comparison, source.name, name)
        outcome.add(name + suffix, figures, judged=name not in GROWING)
    note_failures(outcome, comparison)
    outcome.notes += [f"drawn: {figure.file}" for figure in draw(comparison, source.name)]


def figures_of(comparison: Comparison, data: str, algorithm: str) -> list[Metric]:
    """The growth of one algorithm; NaN if it did not come to a good end."""
    results = results_of(comparison, data, algorithm)
    if not results:
        return [Metric("time_growth", math.nan, "×", "lower", FLAT_BAR)]
    series = read_series(results[0][0].result)
    times_ms = stepped_ms(series)
    growth = last_over_second_quarter(times_ms)
    figures = [
        Metric("time_growth", growth, "×", "lower", FLAT_BAR, TIMING_TOLERANCE),
        info("backend", float(np.median(times_ms)), "ms"),
    ]
    columns = series["columns"].astype(np.float64)
    if len(columns) > 0:  # GTSAM's smoothers do not tell
        size = last_over_second_quarter(columns)
        figures.append(Metric("columns_growth", size, "×", "lower", FLAT_BAR))
        figures.append(info("columns", float(columns[-1]), ""))
    return figures


def stepped_ms(series: Series) -> NDArray[np.float64]:
    """(N,) milliseconds of the frames in which there was an estimate to improve.

    A smoother of GTSAM only predicts some frames; those would hide what the others cost.
    """
    times_ms = series["ms_backend"]
    for stage in ("ms_backend.gauss_newton", "ms_backend.smoother"):
        if stage in series:
            return np.asarray(times_ms[np.isfinite(series[stage])])
    return np.asarray(times_ms)


def last_over_second_quarter(values: NDArray[np.float64]) -> float:
    """Median of the last quarter of (N,) values over that of the second, N at least 4."""
    quarter = len(values) // 4
    second, last = values[quarter : 2 * quarter], values[-quarter:]
    return float(np.median(last) / np.median(second))


BENCHMARKS = {
    "cost_over_time": Benchmark(
        f"simulated flight of {DURATION_S:g} s: time a frame and size of the state, flat or not",
        (),
        measure,
    )
}
