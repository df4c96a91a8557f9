# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The real IMU of four EuRoC flights, and a simulated stereo camera along their ground truth.

Images cannot be what an estimate fails on here: pixel noise is what is assumed, so that errors come
from the IMU, its vibration, and the estimator.
"""

from __future__ import annotations

import math
from pathlib import Path

from benchmarks.experiments import compared, configs_of, folder_of, note_failures, results_of
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import is_held_out
from benchmarks.suite import PEERS, RECURSIVE, Benchmark, Outcome
from slam_graph.experiment.comparison_plan import Comparison
from slam_graph.experiment.tasks import find_sources

FLIGHTS = tuple(
    f"euroc_inertial/{name}"
    for name in ("V1_02_medium", "V2_01_easy", "V2_02_medium", "MH_04_difficult")
)
CAMERAS = 2
CAMERA = ("rate_hz=20", "tracks.features=150", "tracks.pixel_sigma=1")

ATE_BARS_M = {"msckf": 0.10, "okvis": 0.10}
"""An algorithm without a bar is only shown."""


def measure(data: Path, duration_s: float | None = None) -> Outcome:
    """Errors of every algorithm on every flight.

    Args:
        data: folder of recordings.
        duration_s: how much of each flight to take; all of it if not said.
    """
    outcome = Outcome()
    names = (*RECURSIVE, *PEERS)
    sources = find_sources([f"sim:{data / flight}" for flight in FLIGHTS], duration_s, CAMERA)
    folder = folder_of("real_imu") / ("whole" if duration_s is None else f"{duration_s:g}s")
    comparison = compared(folder, sources, configs_of(names, CAMERAS, duration_s))
    for path, source in zip(FLIGHTS, sources, strict=True):
        held_out = is_held_out(path)
        for name in names:
            label = f"{source.name.removeprefix('sim_')}.{name}"
            judged = name in ATE_BARS_M and duration_s is None
            figures = figures_of(comparison, source.name, name)
            outcome.add(label, figures, judged, held_out)
    note_failures(outcome, comparison)
    return outcome


def figures_of(comparison: Comparison, data: str, algorithm: str) -> list[Metric]:
    """Errors, consistency and time of one run; NaN if it did not come to a good end."""
    results = results_of(comparison, data, algorithm)
    figures = [Metric("finished", len(results), "runs", "higher", 1.0, EXACT)]
    bar = ATE_BARS_M.get(algorithm)
    if not results:
        return [*figures, Metric("ate", math.nan, "m", "lower", bar)]
    metrics = results[0][1]["metrics"]
    errors = {mode: metrics["accuracy"][mode]["ate"] for mode in ("none", "se3")}
    return [
        *figures,
        Metric("ate", errors["se3"]["translation_m"]["rmse"], "m", "lower", bar),
        Metric("orientation", errors["se3"]["rotation_deg"]["rmse"], "deg", "lower"),
        info("position_unaligned", errors["none"]["translation_m"]["rmse"], "m"),
        info("nees_position", metrics["nees"]["position"]["mean"], ""),
        info("nees_orientation", metrics["nees"]["orientation"]["mean"], ""),
        info("nis_before_gate", metrics["nis"]["mean_before_gate"], ""),
        info("gated", metrics["nis"]["rejected"], ""),
        info("backend", metrics["timing"]["stages"]["backend"]["mean_ms"], "ms"),
    ]


BENCHMARKS = {
    "real_imu": Benchmark(
        "whole EuRoC flights, real IMU and simulated stereo tracks: ATE of all algorithms",
        FLIGHTS,
        measure,
    )
}
