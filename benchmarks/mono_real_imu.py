# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One camera and a real IMU: flights of EuRoC and rooms of TUM-VI, over seeds of the camera.

The camera is simulated along a path that agrees with the IMU: 20 Hz, 150 features, 1 px. No start
is given. Flights that are held out get seeds that are, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.flights import (
    FLIGHTS,
    flight_is_held_out,
    flown_by_camera,
    in_parallel,
    without_start,
)
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.running import Run
from benchmarks.suite import CORE, Benchmark, Outcome
from slam_graph.errors import DataError
from slam_graph.evaluation import ape, nees_of_run
from slam_graph.geometry import Trajectory

SEEDS, FEWER_SEEDS, SHORT_S = 10, 3, 30.0
WITH_FINAL_BA = "msckf"
"""The bundle adjustment at the end is measured after this algorithm."""
SETTLED_S = 10.0
"""Scale is judged from so long after the start on."""
ATE_BAR_M, SMOOTHED_BAR_M, SCALE_BAR, NEES_BAR = 0.10, 0.02, 0.01, 4.5
"""Means over the seeds of one flight, of `msckf`; NEES of position and of orientation is one and a
half times its ideal."""


@dataclass(frozen=True, slots=True)
class Flown:
    """What came of one run.

    Attributes:
        ate_m, smoothed_m: of the causal and the smoothed trajectory; NaN where there is none.
        scale: error of the scale once the start has settled.
        nees: of position and orientation.
        note: why it did not end well; empty if it did.
    """

    ate_m: float
    smoothed_m: float
    scale: float
    nees: tuple[float, float]
    note: str = ""


def measure(data: Path, seeds: int = SEEDS, duration_s: float | None = None) -> Outcome:
    """Errors over the seeds, for each flight and algorithm.

    Args:
        data: folder of recordings.
        seeds: how many for each flight.
        duration_s: how much of each flight to take; all of it if not said.
    """
    outcome = Outcome()
    rows = [(data / flight, name) for flight in FLIGHTS for name in CORE]
    first = [FIRST_HELD_OUT_SEED if flight_is_held_out(path) else 0 for path, _ in rows]
    tasks = [
        (*row, begin + k, duration_s)
        for row, begin in zip(rows, first, strict=True)
        for k in range(seeds)
    ]
    found = in_parallel(fly, tasks)
    for k, (path, name) in enumerate(rows):
        runs, label = found[k * seeds : (k + 1) * seeds], f"{path.name}.{name}"
        outcome.add(label, figures_of(runs), name == WITH_FINAL_BA, flight_is_held_out(path))
        outcome.notes += [f"{label}: {run.note}" for run in runs if run.note]
    return outcome


def fly(path: Path, algorithm: str, seed: int, duration_s: float | None) -> Flown:
    """One run without a given start."""
    sequence = flown_by_camera(path, 1, seed, duration_s=duration_s)
    run = Run(without_start(sequence), algorithm, 1, final_ba=algorithm == WITH_FINAL_BA)
    if not run.ok:
        return Flown(np.nan, np.nan, np.nan, (np.nan, np.nan), f"seed {seed}: {run.result.message}")
    smoothed = run.result.smoothed
    nees, _ = nees_of_run(run.truth, run.result.history, False, None)
    return Flown(
        run.errors("se3").position_m,
        np.nan if smoothed is None else _ate(run.truth, smoothed),
        _scale_error(run.truth, run.result.trajectory),
        (float(np.mean(nees.position)), float(np.mean(nees.orientation))),
    )


def _ate(truth: Trajectory, estimate: Trajectory) -> float:
    return ape(truth, estimate, alignment="se3").statistics.rmse


def _scale_error(truth: Trajectory, estimate: Trajectory) -> float:
    """Relative error of the scale of what follows the first seconds."""
    settled = estimate.stamps_ns[0] + round(SETTLED_S * 1e9)
    late = estimate.select(estimate.stamps_ns >= settled)
    try:
        return abs(ape(truth, late, alignment="sim3").similarity.scale - 1.0)
    except DataError:  # too little is left
        return float("nan")


def figures_of(runs: list[Flown]) -> Iterator[Metric]:
    """Means over the seeds of one algorithm on one flight, and the worst."""
    ended = [run for run in runs if not run.note]
    yield Metric("finished", len(ended), "runs", "higher", float(len(runs)), EXACT)
    ate = np.array([run.ate_m for run in ended] or [np.nan])
    yield Metric("ate", float(np.mean(ate)), "m", "lower", ATE_BAR_M)
    yield info("ate_worst", float(np.max(ate)), "m")
    smoothed = [run.smoothed_m for run in ended if np.isfinite(run.smoothed_m)]
    if smoothed:
        yield Metric("smoothed", float(np.mean(smoothed)), "m", "lower", SMOOTHED_BAR_M)
    scale = [run.scale for run in ended if np.isfinite(run.scale)] or [np.nan]
    yield Metric("scale_error", float(np.mean(scale)), "share", "lower", SCALE_BAR)
    for k, part in enumerate(("position", "orientation")):
        nees = float(np.mean([run.nees[k] for run in ended] or [np.nan]))
        yield Metric(f"nees_{part}", nees, "", "lower", NEES_BAR)


BENCHMARKS = {
    "mono_real_imu": Benchmark(
        "one camera, the real IMU of EuRoC and TUM-VI, ten seeds: errors and NEES", FLIGHTS, measure
    ),
    "mono_real_imu_30s": Benchmark(
        "the same over 30 seconds and three seeds",
        FLIGHTS,
        partial(measure, seeds=FEWER_SEEDS, duration_s=SHORT_S),
    ),
}
