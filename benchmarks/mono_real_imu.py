# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One camera and a real IMU: whole flights of EuRoC and rooms of TUM-VI, over seeds of the camera.

The camera is simulated along a path that agrees with the IMU: 20 Hz, 150 features, 1 px. Flights
that are held out get seeds that are, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.experiments import compared, configs_of, folder_of, note_failures, results_of
from benchmarks.flights import FLIGHTS
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import FIRST_HELD_OUT_SEED, is_held_out
from benchmarks.suite import Benchmark, Outcome
from slam_graph.arrays import FloatArray
from slam_graph.experiment.comparison_plan import Comparison
from slam_graph.experiment.comparison_results import Table
from slam_graph.experiment.tasks import find_sources

ALGORITHMS = ("msckf", "swf", "okvis")
CAMERA = ("rate_hz=20", "tracks.features=150", "tracks.pixel_sigma=1")
SEEDS = 10

ATE_BAR_M, SMOOTHED_BAR_M = 0.10, 0.02
"""Of `msckf`: the mean over the seeds of one flight."""
NEES_BAR = 4.5
"""One and a half times the ideal, of position and of orientation."""


def measure(data: Path, seeds: int = SEEDS, duration_s: float | None = None) -> Outcome:
    """Errors over the seeds, for each flight and algorithm.

    Args:
        data: folder of recordings.
        seeds: how many for each flight.
        duration_s: how much of each flight to take; all of it if not said.
    """
    outcome = Outcome()
    length = "whole" if duration_s is None else f"{duration_s:g}s"
    for flight in FLIGHTS:
        held_out = is_held_out(flight)
        sources = find_sources([f"sim:{data / flight}"], duration_s, CAMERA)
        first = FIRST_HELD_OUT_SEED if held_out else 0
        comparison = compared(
            folder_of("mono_real_imu") / length,
            sources,
            configs_of(ALGORITHMS, 1, duration_s),
            range(first, first + seeds),
        )
        for name in ALGORITHMS:
            label = f"{Path(flight).name}.{name}"
            figures = figures_of(comparison, sources[0].name, name, seeds)
            outcome.add(label, figures, name == "msckf" and duration_s is None, held_out)
        note_failures(outcome, comparison)
    return outcome


def figures_of(comparison: Comparison, data: str, algorithm: str, seeds: int) -> Iterator[Metric]:
    """Means over the seeds of one algorithm on one flight, and the worst."""
    tables = [table["metrics"] for _, table in results_of(comparison, data, algorithm)]
    yield Metric("finished", len(tables), "runs", "higher", float(seeds), EXACT)
    ate = _column(tables, lambda m: m["accuracy"]["se3"]["ate"]["translation_m"]["rmse"])
    yield Metric("ate", float(np.mean(ate)), "m", "lower", ATE_BAR_M)
    yield info("ate_worst", float(np.max(ate)), "m")
    smoothed = _column(
        tables, lambda m: m["final_ba"]["accuracy"]["se3"]["ate"]["translation_m"]["rmse"]
    )
    yield Metric("smoothed", float(np.mean(smoothed)), "m", "lower", SMOOTHED_BAR_M)
    scale = _column(tables, lambda m: abs(m["accuracy"]["sim3"]["scale"] - 1.0))
    yield info("scale_error", float(np.mean(scale)), "share")
    for of in ("position", "orientation"):
        nees = [table["nees"][of]["mean"] for table in tables] or [np.nan]
        yield Metric(f"nees_{of}", float(np.mean(nees)), "", "lower", NEES_BAR)


def _column(tables: list[Table], figure: Callable[[Table], float]) -> FloatArray:
    """A figure (N,) of every run that has it; one NaN if none has."""
    found = [figure(table) for table in tables if table.get("final_ba") is not None]
    return np.array(found or [np.nan])


BENCHMARKS = {
    "mono_real_imu": Benchmark(
        "one camera, the real IMU of EuRoC and TUM-VI, ten seeds: errors and NEES", FLIGHTS, measure
    )
}
