# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated EuRoC V1_01 from its true start: errors without alignment, and how sure we are.

The estimates of OpenVINS from exactly these measurements lie beside them.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.metric import Metric, info
from benchmarks.running import Errors, Run, within
from benchmarks.suite import ALGORITHMS, Benchmark, Outcome
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.evaluation.consistency import nees

RECORDING = "openvins_sim/euroc_V1_01"

POSITION_BARS_M = {1: 0.06, 2: 0.05}
ORIENTATION_BARS_DEG = {1: 0.5, 2: 0.3}
NEES_BAND = (0.3, 4.0)
SLACK_S = 1e-3
"""Stamps in seconds are compared this coarsely: a double does not hold the nanoseconds of today."""

WORDS = {1: "mono", 2: "stereo"}


def measure(data: Path, cameras: int) -> Outcome:
    """Errors and mean NEES (3 is ideal) of our estimates and of OpenVINS' over the same time."""
    outcome = Outcome()
    folder = data / RECORDING
    for name in ALGORITHMS:
        run = Run(folder, name, cameras, overrides=["backend.initialization.mode=given"])
        errors = run.errors("none")
        orientation, position = mean_nees(run)
        p_bar, q_bar = POSITION_BARS_M[cameras], ORIENTATION_BARS_DEG[cameras]
        outcome.metrics += [
            Metric(f"{name}.position", errors.position_m, "m", "lower", p_bar),
            Metric(f"{name}.orientation", errors.orientation_deg, "deg", "lower", q_bar),
            Metric(f"{name}.nees_position", position, "", "band", NEES_BAND),
            Metric(f"{name}.nees_orientation", orientation, "", "band", NEES_BAND),
            Metric(f"{name}.coverage", errors.span_s, "s", "higher"),
        ]
        outcome.notes += run.notes()
        if run.ok and name == ALGORITHMS[0]:
            outcome.metrics += openvins(folder, WORDS[cameras], run)
    return outcome


def mean_nees(run: Run) -> tuple[float, float]:
    """Mean NEES of orientation and position of a run that was given its start."""
    if not run.ok:
        return math.nan, math.nan
    history = run.result.history
    values = nees(history.trajectory(), history.pose_covariances(), run.truth)
    return float(values.orientation.mean()), float(values.position.mean())


def openvins(folder: Path, word: str, run: Run) -> list[Metric]:
    """OpenVINS' errors by our own evaluation, and the NEES that it wrote down."""
    estimate = within(
        read_groundtruth(folder / f"openvins_{word}_nocalib_tum.txt"), run.result.trajectory
    )
    errors = Errors.of(run.truth, estimate, "none")
    table = np.genfromtxt(folder / f"openvins_{word}_nocalib_stats.csv", delimiter=",", names=True)
    first_s, last_s = estimate.stamps_ns[[0, -1]] * 1e-9
    table = table[(table["t"] > first_s - SLACK_S) & (table["t"] < last_s + SLACK_S)]
    return [
        info("openvins.position", errors.position_m, "m"),
        info("openvins.orientation", errors.orientation_deg, "deg"),
        info("openvins.nees_position", float(table["nees_pos"].mean()), ""),
        info("openvins.nees_orientation", float(table["nees_ori"].mean()), ""),
        info("openvins.coverage", errors.span_s, "s"),
    ]


BENCHMARKS = {
    f"openvins_sim_{word}": Benchmark(
        f"simulated V1_01 tracks, {word}, start given: unaligned errors, NEES, beside OpenVINS",
        (RECORDING,),
        partial(measure, cameras=cameras),
    )
    for cameras, word in WORDS.items()
}
