# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What nobody chose anything on: three flights with their real IMU, and seeds from 100 on.

Short enough for every change: half a minute of each flight, and eight simulated flights of 12 s.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.metric import Metric
from benchmarks.openvins_sim import mean_nees
from benchmarks.real_imu import CAMERA, CAMERAS
from benchmarks.recordings import FIRST_HELD_OUT_SEED, HELD_OUT
from benchmarks.running import Run, read_once
from benchmarks.suite import CORE, Benchmark, Outcome
from slam_graph.datasets.sequence import Sequence
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.experiment.tasks import find_sources

CLIP_S = 30.0

SEEDS = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + 8)
SIMULATED_S = 12.0
SIMULATED = ("rate_hz=10", "tracks.features=40", "flight.hover_s=0")

DRAWN_START = ("backend.initialization.fix_gauge=false",)
"""The error of the start is drawn from its covariance, so all of that covariance is kept: position
and yaw of the start do not define the world."""


def measure(data: Path) -> Outcome:
    """Errors on the flights after alignment in SE(3); errors and NEES over the seeds without."""
    outcome = Outcome()
    sources = find_sources([f"sim:{data / path}" for path in HELD_OUT], CLIP_S, CAMERA)
    flights = [(source, read_once(source.open(FIRST_HELD_OUT_SEED, CAMERAS))) for source in sources]
    (simulated,) = find_sources(["sim:figure8"], SIMULATED_S, SIMULATED)
    drawn = [read_once(simulated.open(seed, CAMERAS)) for seed in SEEDS]
    for name in CORE:
        for source, flight in flights:
            run = Run(flight, name, CAMERAS)
            errors = run.errors("se3")
            figures = [
                Metric("ate", errors.position_m, "m", "lower"),
                Metric("orientation", errors.orientation_deg, "deg", "lower"),
            ]
            outcome.add(f"{source.name.removeprefix('sim_')}.{name}", figures, held_out=True)
            outcome.notes += run.notes()
        outcome.add(f"seeds.{name}", over_seeds(drawn, name), held_out=True)
    outcome.notes.append(
        f"the first {CLIP_S:g} s of each flight; seeds {SEEDS[0]} to {SEEDS[-1]} of "
        f"{SIMULATED_S:g} s"
    )
    return outcome


def over_seeds(flights: list[Sequence], algorithm: str) -> list[Metric]:
    """Mean errors without alignment, and mean NEES with its upper χ² bound."""
    runs = [Run(flight, algorithm, CAMERAS, overrides=DRAWN_START) for flight in flights]
    errors = [run.errors("none") for run in runs]
    nees = np.array([mean_nees(run) for run in runs])
    bound = mean_bounds(3, len(SEEDS))[1]

    position, orientation = np.mean([(e.position_m, e.orientation_deg) for e in errors], axis=0)
    nees_position, nees_orientation = nees.mean(axis=0)
    return [
        Metric("position", float(position), "m", "lower"),
        Metric("orientation", float(orientation), "deg", "lower"),
        # no baseline: within the bounds a NEES is neither better nor worse than another
        Metric("nees_position", float(nees_position), "", "lower", bound, tolerance=None),
        Metric("nees_orientation", float(nees_orientation), "", "lower", bound, tolerance=None),
    ]


BENCHMARKS = {
    "held_out": Benchmark(
        "What no parameter was chosen on: V2_02, MH_04 and seeds from 100 on, stereo tracks",
        HELD_OUT,
        measure,
        quick=True,
    )
}
