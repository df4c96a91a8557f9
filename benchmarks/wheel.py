# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The real EuRoC V1_01 tracks and IMU in GTSAM's wheel: 30 s, of which it stands still for 5."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from benchmarks.metric import QUANTISED_TOLERANCE, Metric
from benchmarks.running import Run
from benchmarks.suite import CORE, PEERS, UNBOUNDED, Benchmark, Outcome
from slam_graph.datasets.formats.eqvio import DEMO

TRUTH = "euroc_inertial/V1_01_easy"

ATE_BARS_M = {"msckf": 0.10, "swf": 0.15, "okvis": 0.10}
"""An algorithm without a bar is only shown."""


def measure(algorithms: Sequence[str], data: Path) -> Outcome:
    """Errors of the causal estimates after alignment in SE(3)."""
    outcome = Outcome()
    for name in algorithms:
        run = Run(DEMO, name, groundtruth=data / TRUTH)
        errors = run.errors("se3")
        figures = [
            Metric("ate", errors.position_m, "m", "lower", ATE_BARS_M.get(name)),
            Metric("orientation", errors.orientation_deg, "deg", "lower"),
            Metric("coverage", errors.span_s, "s", "higher", tolerance=QUANTISED_TOLERANCE),
        ]
        outcome.add(name, figures, judged=name in ATE_BARS_M)
        outcome.notes += run.notes()
    return outcome


BENCHMARKS = {
    "wheel_v101": Benchmark(
        "EuRoC V1_01, mono tracks from GTSAM's wheel: causal ATE",
        (TRUTH,),
        partial(measure, CORE),
        quick=True,
    ),
    "wheel_v101_others": Benchmark(
        "the same under the algorithms that are only shown",
        (TRUTH,),
        partial(measure, (*UNBOUNDED, *PEERS)),
    ),
}
