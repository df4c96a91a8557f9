# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The bundle adjustment over the whole recording, beside the causal estimate that it begins with.

Real tracks and images, and the four flights of `real_imu`. Time is that of this process on its
processor, so that others on the machine do not count.
"""

from __future__ import annotations

import math
from pathlib import Path

from benchmarks.metric import EXACT, Metric, info
from benchmarks.real_imu import CAMERA, CAMERAS, FLIGHTS
from benchmarks.recordings import is_held_out
from benchmarks.running import Errors, Run
from benchmarks.suite import Benchmark, Outcome
from benchmarks.wheel import TRUTH
from slam_graph.datasets.formats.eqvio import DEMO
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.experiment.tasks import find_sources

ALGORITHM = "msckf"

MH_01 = "euroc/MH_01_easy_17s"
OKVIS2 = "okvis2_slam_final"

ATE_BARS_M = {"v1_01_tracks": 0.012, "mh_01": 0.0045}
GAIN_BAR = 2.0
"""How many times better than the causal estimate it is to be where only the IMU is real."""


def measure(data: Path) -> Outcome:
    """Errors of both estimates after alignment in SE(3), and what the adjustment took."""
    outcome = Outcome()
    recordings: dict[str, Run] = {
        "v1_01_tracks": Run(DEMO, ALGORITHM, groundtruth=data / TRUTH, final_ba=True),
        "mh_01": Run(data / MH_01, ALGORITHM, 2, final_ba=True),
    }
    for name, run in recordings.items():
        outcome.add(name, figures_of(run, ATE_BARS_M[name]))
        outcome.notes += run.notes()
    sources = find_sources([f"sim:{data / flight}" for flight in FLIGHTS], None, CAMERA)
    for path, source in zip(FLIGHTS, sources, strict=True):
        run = Run(source.open(0, CAMERAS), ALGORITHM, CAMERAS, final_ba=True)
        figures = figures_of(run, gain_bar=GAIN_BAR)
        held_out = is_held_out(path)
        outcome.add(source.name.removeprefix("sim_"), figures, held_out=held_out)
        outcome.notes += run.notes()
    peer = read_groundtruth(data / MH_01 / "peers" / f"{OKVIS2}.tum")
    errors = Errors.of(read_groundtruth(data / MH_01), peer, "se3")
    outcome.metrics.append(info("mh_01.okvis2_final.ate", errors.position_m, "m"))
    return outcome


def figures_of(
    run: Run,
    ate_bar_m: float | None = None,
    gain_bar: float | None = None,
) -> list[Metric]:
    """What is to be known of one run; NaN if there is no adjustment."""
    final, causal = run.result.final_ba, run.errors("se3")
    if final is None or not run.ok:
        return [Metric("ate", math.nan, "m", "lower", ate_bar_m)]
    summary, stamps_ns = final.summary, final.trajectory.stamps_ns
    length_s = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
    errors = Errors.of(run.truth, final.trajectory, "se3")
    return [
        Metric("ate", errors.position_m, "m", "lower", ate_bar_m),
        Metric("gain", causal.position_m / errors.position_m, "×", "higher", gain_bar),
        Metric("orientation", errors.orientation_deg, "deg", "lower"),
        Metric(
            "frames_without",
            run.result.logs.frames - summary.frames,
            "frames",
            "lower",
            0.0,
            EXACT,
        ),
        info("share", summary.cpu_seconds / max(length_s, 1e-9), "s CPU a second"),
        info("cpu", summary.cpu_seconds, "s CPU"),
        info("causal_ate", causal.position_m, "m"),
        info("keyframes", summary.keyframes, ""),
        info("features", summary.features, ""),
        info("steps", summary.iterations, ""),
        info("imu_residual", summary.imu_residual, "σ"),
        info("pixel_residual", summary.pixel_residual, "σ"),
    ]


BENCHMARKS = {
    "final_ba": Benchmark(
        "the bundle adjustment that ends a run: ATE beside the causal one, real and simulated",
        (TRUTH, MH_01, *FLIGHTS),
        measure,
    )
}
