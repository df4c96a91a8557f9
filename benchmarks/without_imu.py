# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Consistency without an IMU: NEES over Monte Carlo runs of each set of sensors.

As `monte_carlo` does it with an IMU. The program finds its own start; the world is then that of the
first pose, and with one camera the unit of length is unknown as well, so errors are taken from the
first pose on, and with one camera after an alignment in scale.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metric import EXACT, Metric, info
from benchmarks.running import Errors
from benchmarks.suite import Benchmark, Outcome
from slam_graph import run
from slam_graph.evaluation.consistency import average_nees, mean_bounds
from slam_graph.geometry.trajectory_alignment import AlignmentMode
from slam_graph.simulation import simulate

ALGORITHM = "msckf"
SEEDS = 20
DURATION_S = 15.0
RATE_HZ = 20.0
DOF = 3
PARTS = ("position", "orientation")
OWN_START = "backend.initialization.mode=motion"
"""Not the state that comes with a simulation."""
SENSORS: dict[str, dict[str, Any]] = {
    "stereo": {"cameras": 2},
    "rgbd": {"cameras": 1, "depth": {"sensor": "stereo"}},
    "mono": {"cameras": 1},
}
"""Settings of the simulation; the depth sensor is one of two infrared cameras."""


def measure(_: Path) -> Outcome:
    """Mean NEES over all runs and frames, with the upper χ² bound of a mean over the runs."""
    outcome = Outcome()
    for name, settings in SENSORS.items():
        outcome.add(name, _figures(settings, range(SEEDS)))
    low, high = mean_bounds(DOF, SEEDS)
    outcome.notes.append(
        f"{ALGORITHM}, {SEEDS} flights of {DURATION_S:g} s on tracks; bounds of the mean over the "
        f"runs: {low:.2f} to {high:.2f}"
    )
    return outcome


def _figures(settings: dict[str, Any], seeds: range) -> list[Metric]:
    series, errors = [], []
    for seed in seeds:
        flight = simulate(
            trajectory="figure8",
            duration_s=DURATION_S,
            rate_hz=RATE_HZ,
            seed=seed,
            with_imu=False,
            tracks={"features": 100},
            **settings,
        )
        result = run(
            flight,
            algorithm=ALGORITHM,
            overrides=[OWN_START],
            final_ba={"enabled": False},
            seed=seed,
        )
        nees = result.nees_series
        if nees is None or result.status != "ok":
            continue
        series.append(nees[1])
        alignment: AlignmentMode = "se3" if result.history.has_scale else "sim3"
        errors.append(Errors.of(flight.groundtruth(), result.trajectory, alignment).position_m)
    figures = [
        Metric("finished", len(series), "runs", "higher", len(seeds), EXACT),
        info("position", float(np.mean(errors)), "m"),
    ]
    if not series:
        return figures[:1]
    shared = min(map(len, series))  # starts differ by a few frames: the ends are compared
    for k, part in enumerate(PARTS):
        found = average_nees(np.array([one[-shared:, k] for one in series]), DOF)
        bar = mean_bounds(DOF, len(seeds))[1]
        figures.append(Metric(f"nees_{part}", found.mean, "", "lower", bar, tolerance=None))
        figures.append(info(f"nees_{part}_inside", found.inside, ""))
    return figures


BENCHMARKS = {
    "without_imu": Benchmark(
        f"{SEEDS} simulated flights without an IMU, with stereo, depth and one camera: NEES over "
        "runs below its upper χ² bound",
        (),
        measure,
    )
}
