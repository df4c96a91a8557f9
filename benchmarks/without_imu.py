# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Without an IMU: consistency of each set of sensors, and errors of rendered stereo flights.

Consistency is NEES over Monte Carlo runs, as `monte_carlo` has it with an IMU. The program finds
its own start; the world is then that of the first pose, and with one camera the unit of length is
unknown as well, so errors are taken from the first pose on, and with one camera after an alignment
in scale.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.running import Errors
from benchmarks.suite import Benchmark, Outcome
from slam_graph import run
from slam_graph.evaluation.consistency import average_nees, mean_bounds
from slam_graph.results import RunResult
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
RENDERED_SEEDS = 5
RENDERED_S = 12.0
RENDERED_BAR_M = 0.010


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
        accuracy = result.metrics["accuracy"][result.history.free]
        errors.append(accuracy["ate"]["translation_m"]["rmse"])
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


def measure_rendered(_: Path) -> Outcome:
    """Errors of rendered stereo flights, with the seeds parameters were chosen on and others."""
    outcome = Outcome()
    for name, first in (("chosen", 0), ("held_out", FIRST_HELD_OUT_SEED)):
        errors, nees = [], []
        for seed in range(first, first + RENDERED_SEEDS):
            result = _rendered(seed)
            if result.status == "ok" and result.groundtruth is not None:
                errors.append(Errors.of(result.groundtruth, result.trajectory, "se3").position_m)
                nees.append([result.metrics["nees"][part]["mean"] for part in PARTS])
        figures = [Metric("finished", len(errors), "runs", "higher", RENDERED_SEEDS, EXACT)]
        if errors:
            mean = float(np.mean(errors))
            figures.append(Metric("position", mean, "m", "lower", RENDERED_BAR_M))
            figures.append(info("largest", max(errors), "m"))
            for part, value in zip(PARTS, np.mean(nees, axis=0), strict=True):
                figures.append(info(f"nees_{part}", float(value), ""))
        outcome.add(name, figures, held_out=first >= FIRST_HELD_OUT_SEED)
    outcome.notes.append(f"{ALGORITHM}, flights of {RENDERED_S:g} s through rooms, 20 Hz")
    return outcome


def _rendered(seed: int) -> RunResult:
    """A run on the images of two cameras, which are rendered first."""
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "images"
        simulate(
            kind="images",
            trajectory="rooms",
            duration_s=RENDERED_S,
            cameras=2,
            with_imu=False,
            seed=seed,
        ).save(images)
        overrides, adjustment = [OWN_START], {"enabled": False}
        return run(images, algorithm=ALGORITHM, overrides=overrides, final_ba=adjustment, seed=0)


BENCHMARKS = {
    "without_imu_rendered": Benchmark(
        f"{RENDERED_SEEDS} rendered stereo flights without an IMU, and as many held out: mean "
        f"error of position below {RENDERED_BAR_M:g} m",
        (),
        measure_rendered,
    ),
    "without_imu": Benchmark(
        f"{SEEDS} simulated flights without an IMU, with stereo, depth and one camera: NEES over "
        "runs below its upper χ² bound",
        (),
        measure,
    ),
}
