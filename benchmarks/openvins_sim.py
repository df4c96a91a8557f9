# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated EuRoC V1_01 from its true start: errors without alignment, and how sure we are.

The estimates of OpenVINS from exactly these measurements lie beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.metric import QUANTISED_TOLERANCE, Metric, info
from benchmarks.running import Errors, Run, clipped, read_once, within
from benchmarks.suite import CORE, GROWING, PEERS, UNBOUNDED, Benchmark, Outcome
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.evaluation.consistency import nees

RECORDING = "openvins_sim/euroc_V1_01"

POSITION_BARS_M = {1: 0.06, 2: 0.05}
ORIENTATION_BARS_DEG = {1: 0.5, 2: 0.3}
NEES_BAND = (0.3, 4.0)
SLACK_S = 1e-3
"""Stamps in seconds are compared this coarsely: a double does not hold the nanoseconds of today."""

WORDS = {1: "mono", 2: "stereo"}

JUDGED = ("msckf", "swf")
"""The algorithms with bars of their own; the others are shown, and may be the best."""

CLIP_S = 15.0
"""How much of it algorithms run on whose cost has no bound."""

IDEAL_NEES = 3.0


@dataclass(frozen=True, slots=True)
class Quality:
    """What an estimate is judged by: errors without alignment, and mean NEES (3 is ideal)."""

    position_m: float
    orientation_deg: float
    nees_position: float
    nees_orientation: float

    def no_worse_than(self, other: Quality) -> bool:
        """Whether errors are no larger, and the NEES are no farther from their ideal."""
        return (
            self.position_m <= other.position_m
            and self.orientation_deg <= other.orientation_deg
            and abs(self.nees_position - IDEAL_NEES) <= abs(other.nees_position - IDEAL_NEES)
            and abs(self.nees_orientation - IDEAL_NEES) <= abs(other.nees_orientation - IDEAL_NEES)
        )


def measure(data: Path, cameras: int, algorithms: Sequence[str]) -> Outcome:
    """Errors and mean NEES (3 is ideal) of our estimates and of OpenVINS' over the same time."""
    outcome = Outcome()
    folder = data / RECORDING
    recording = read_once(open_dataset(folder, cameras=cameras))
    p_bar, q_bar = POSITION_BARS_M[cameras], ORIENTATION_BARS_DEG[cameras]
    ours: dict[str, Quality] = {}
    theirs: Quality | None = None
    for name in algorithms:
        clip_s = CLIP_S if name in GROWING else None
        given = ["backend.initialization.mode=given"]
        run = Run(recording, name, cameras, overrides=given, duration_s=clip_s)
        errors = run.errors("none")
        quality = Quality(errors.position_m, errors.orientation_deg, *mean_nees(run))
        figures = [
            Metric("position", quality.position_m, "m", "lower", p_bar),
            Metric("orientation", quality.orientation_deg, "deg", "lower", q_bar),
            Metric("nees_position", quality.nees_position, "", "band", NEES_BAND),
            Metric("nees_orientation", quality.nees_orientation, "", "band", NEES_BAND),
            Metric("coverage", errors.span_s, "s", "higher", tolerance=QUANTISED_TOLERANCE),
        ]
        outcome.add(clipped(name, clip_s), figures, judged=name in JUDGED)
        outcome.notes += run.notes()
        if run.ok and name in CORE:
            ours[name] = quality
            if theirs is None:
                theirs, span_s = openvins(folder, WORDS[cameras], run)
                outcome.metrics += shown(theirs, span_s)
    if theirs is not None:
        outcome.metrics += best(ours, theirs)
    return outcome


def best(ours: dict[str, Quality], theirs: Quality) -> list[Metric]:
    """The best of our algorithms beside OpenVINS: the bars are its own figures.

    Args:
        ours: of the runs that ended well, by algorithm.
        theirs: OpenVINS' over the same time.
    """
    position = min(quality.position_m for quality in ours.values())
    orientation = min(quality.orientation_deg for quality in ours.values())
    no_worse = sum(quality.no_worse_than(theirs) for quality in ours.values())
    return [
        Metric("best.position", position, "m", "lower", theirs.position_m),
        Metric("best.orientation", orientation, "deg", "lower", theirs.orientation_deg),
        Metric("no_worse_in_all", no_worse, "algorithms", "higher", 1.0, tolerance=None),
    ]


def mean_nees(run: Run) -> tuple[float, float]:
    """Mean NEES of position and orientation of a run that was given its start."""
    if not run.ok:
        return math.nan, math.nan
    history = run.result.history
    values = nees(history.trajectory(), history.pose_covariances(), run.truth)
    return float(values.position.mean()), float(values.orientation.mean())


def openvins(folder: Path, word: str, run: Run) -> tuple[Quality, float]:
    """OpenVINS' errors by our own evaluation, the NEES that it wrote down, and the time it covers.

    Args:
        folder: of the recording.
        word: `mono` or `stereo`.
        run: one of ours, for the time over which to judge.
    """
    estimate = within(
        read_groundtruth(folder / f"openvins_{word}_nocalib_tum.txt"), run.result.trajectory
    )
    errors = Errors.of(run.truth, estimate, "none")
    table = np.genfromtxt(folder / f"openvins_{word}_nocalib_stats.csv", delimiter=",", names=True)
    first_s, last_s = estimate.stamps_ns[[0, -1]] * 1e-9
    table = table[(table["t"] > first_s - SLACK_S) & (table["t"] < last_s + SLACK_S)]
    nees_means = float(table["nees_pos"].mean()), float(table["nees_ori"].mean())
    return Quality(errors.position_m, errors.orientation_deg, *nees_means), errors.span_s


def shown(theirs: Quality, span_s: float) -> list[Metric]:
    """OpenVINS' figures."""
    return [
        info("openvins.position", theirs.position_m, "m"),
        info("openvins.orientation", theirs.orientation_deg, "deg"),
        info("openvins.nees_position", theirs.nees_position, ""),
        info("openvins.nees_orientation", theirs.nees_orientation, ""),
        info("openvins.coverage", span_s, "s"),
    ]


BENCHMARKS = {
    f"openvins_sim_{word}{suffix}": Benchmark(
        f"simulated V1_01 tracks, {word}, start given: unaligned errors, NEES{who}",
        (RECORDING,),
        partial(measure, cameras=cameras, algorithms=algorithms),
        quick=not suffix,
    )
    for suffix, who, algorithms in (
        ("", ", beside OpenVINS", CORE),
        ("_others", " of the algorithms that are only shown", (*UNBOUNDED, *PEERS)),
    )
    for cameras, word in WORDS.items()
}
