# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects in simulated stereo: errors of their motion, NEES, identities, and the platform.

EuRoC's cameras at 10 Hz and boxes of 1 m about 3.5 m ahead, with tracks of 0.5 px and in rendered
images. Settings were chosen with seeds 0 to 3 and 100 to 104; the seeds here are others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metric import Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph import run
from slam_graph.simulation import simulate

ALGORITHM = "msckf"
SEEDS = range(200, 205)
DURATION_S, RATE_HZ, SIGMA_PX = 8.0, 10.0, 0.5
FLIGHTS: dict[str, dict[str, Any]] = {
    "turning": {"objects": {"count": 1}},
    "stop_and_go": {"objects": {"count": 1, "motion": "stop_and_go"}},
    "three": {"objects": {"count": 3, "motion": "mixed"}},
    "rendered": {"objects": {"count": 1}, "kind": "images"},
    "masks_three": {"objects": {"count": 3, "motion": "mixed", "masks": True}},
    "masks_rendered": {"objects": {"count": 1, "masks": True}, "kind": "images"},
}
_BAR, _MASKS_BAR = (0.75, 0.015, 0.45, 0.0075), (0.5, 0.010, 0.3, 0.005)
"""Largest errors of the motion from frame to frame: deg and m on the way, deg and m smoothed."""


def measure(_: Path) -> Outcome:
    """Means over the seeds; an object that is not found has no errors, but fewer steps."""
    outcome = Outcome()
    for name, settings in FLIGHTS.items():
        tables, errors = [], []
        for seed in SEEDS:
            table, error = _flown(seed, settings)
            tables.append(table)
            errors.append(error)
        known = [table for table in tables if table["steps"]]

        def mean(column: str, rows: list[dict[str, float]] = known) -> float:
            return float(np.mean([row[column] for row in rows]))

        rotation, translation, *smoothed = _MASKS_BAR if "masks" in name else _BAR
        outcome.add(
            name,
            [
                Metric("rotation", mean("motion_rotation_deg"), "deg", "lower", rotation),
                Metric("translation", mean("motion_translation_m"), "m", "lower", translation),
                Metric("smoothed_rotation", mean("smoothed_rotation"), "deg", "lower", smoothed[0]),
                Metric(
                    "smoothed_translation", mean("smoothed_translation"), "m", "lower", smoothed[1]
                ),
                info("median_rotation", mean("median_motion_rotation_deg"), "deg"),
                info("median_translation", mean("median_motion_translation_m"), "m"),
                info("nees", mean("nees"), ""),
                info("switches", mean("identity_switches"), ""),
                info("steps", mean("steps", tables), ""),
                info("platform", float(np.mean(errors)), "m"),
                info("milliseconds", mean("ms", tables), "ms"),
            ],
        )
    return outcome


def _flown(seed: int, settings: dict[str, Any]) -> tuple[dict[str, float], float]:
    """Errors of the objects of a flight, and of the platform, m."""
    sigma_px = 1.0 if settings.get("kind") == "images" else SIGMA_PX
    sequence = simulate(
        duration_s=DURATION_S,
        rate_hz=RATE_HZ,
        seed=seed,
        tracks={"pixel_sigma": SIGMA_PX},
        **settings,
    )
    result = run(
        sequence,
        algorithm=ALGORITHM,
        overrides={"objects.enabled": True, "backend.noise.pixel_sigma": sigma_px},
    )
    found = result.metrics["moving_objects"]
    error = result.metrics["accuracy"]["yaw"]["ate"]["translation_m"]["rmse"]
    smoothed = {
        "smoothed_rotation": found["smoothed"]["motion_rotation_deg"],
        "smoothed_translation": found["smoothed"]["motion_translation_m"],
    }
    return {**found["accuracy"], **smoothed, "ms": found["ms_per_frame"]}, float(error)


BENCHMARKS = {
    "objects": Benchmark("Moving objects in simulated stereo, 5 seeds", (), measure),
}
