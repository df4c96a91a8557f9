# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The real EuRoC V1_01 tracks and IMU in GTSAM's wheel: 30 s, of which it stands still for 5."""

from __future__ import annotations

from pathlib import Path

from benchmarks.metric import Metric
from benchmarks.running import Run
from benchmarks.suite import ALGORITHMS, Benchmark, Outcome
from slam_graph.datasets.registry import DEMO

TRUTH = "euroc_inertial/V1_01_easy"

ATE_BAR_M = 0.15


def measure(data: Path) -> Outcome:
    """Errors of the causal estimates after alignment in SE(3)."""
    outcome = Outcome()
    for name in ALGORITHMS:
        run = Run(DEMO, name, groundtruth=data / TRUTH)
        errors = run.errors("se3")
        outcome.metrics += [
            Metric(f"{name}.ate", errors.position_m, "m", "lower", ATE_BAR_M),
            Metric(f"{name}.orientation", errors.orientation_deg, "deg", "lower"),
            Metric(f"{name}.coverage", errors.span_s, "s", "higher"),
        ]
        outcome.notes += run.notes()
    return outcome


BENCHMARKS = {
    "wheel_v101": Benchmark(
        "EuRoC V1_01, mono tracks from GTSAM's wheel: causal ATE", (TRUTH,), measure
    )
}
