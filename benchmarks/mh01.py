# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The real images of EuRoC MH_01, 17 s from a start in flight, beside what others make of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.metric import EXACT, QUANTISED_TOLERANCE, Metric, info
from benchmarks.running import Errors, Run, clipped, decoded_once, within
from benchmarks.suite import CORE, PEERS, UNBOUNDED, Benchmark, Outcome
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.geometry.trajectory import Trajectory

RECORDING = "euroc/MH_01_easy_17s"

START_BAR_S = 3.0
ATE_BARS_M = {
    1: {"msckf": 0.01, "swf": 0.02},
    2: {"msckf": 0.01, "swf": 0.02, "okvis": 0.01},
}
"""For each number of cameras; an algorithm without a bar is only shown."""

SEEDS = range(3)
"""Of the front end: one run scatters by more than what a change is judged by."""

CLIP_S = 6.0
"""How much of it algorithms run on whose cost has no bound."""

OTHERS = {
    1: {"openvins": "openvins_mono"},
    2: {"openvins": "openvins_stereo", "basalt": "basalt_stereo", "okvis2": "okvis2_slam_causal"},
}
"""Files of causal estimates of others by their name, for each number of cameras."""


@decoded_once()
def measure(data: Path, cameras: int, algorithms: Sequence[str]) -> Outcome:
    """Start-up, errors after alignment in SE(3), and lost frames; then the others' errors."""
    outcome = Outcome()
    folder = data / RECORDING
    peers = {
        name: read_groundtruth(folder / "peers" / f"{file}.tum")
        for name, file in OTHERS[cameras].items()
    }
    bars = ATE_BARS_M[cameras]
    for name in algorithms:
        clip_s = CLIP_S if name in UNBOUNDED else None
        seeds = SEEDS if name in bars else SEEDS[:1]
        runs = [Run(folder, name, cameras, duration_s=clip_s, seed=seed) for seed in seeds]
        outcome.add(
            clipped(name, clip_s), _figures(runs, bars.get(name), peers["openvins"]), name in bars
        )
        outcome.notes += dict.fromkeys(line for run in runs for line in run.notes())
    truth = read_groundtruth(folder)
    for name, peer in peers.items():
        errors = Errors.of(truth, peer, "se3")
        outcome.metrics += [
            info(f"{name}.ate", errors.position_m, "m"),
            info(f"{name}.orientation", errors.orientation_deg, "deg"),
            info(f"{name}.coverage", errors.span_s, "s"),
        ]
    return outcome


def _figures(runs: list[Run], bar_m: float | None, openvins: Trajectory) -> Iterator[Metric]:
    """Means over the seeds of the front end; of starts, lost frames and coverage the worst."""
    errors = [run.errors("se3") for run in runs]
    start = float(np.max([run.seconds_to_start for run in runs]))
    lost = float(np.max([run.frames_lost for run in runs]))
    span = min(error.span_s for error in errors)
    ate, orientation, shared = np.mean(
        [
            (error.position_m, error.orientation_deg, _ate_within(run, openvins))
            for run, error in zip(runs, errors, strict=True)
        ],
        axis=0,
    )
    yield Metric("start", start, "s", "lower", START_BAR_S, QUANTISED_TOLERANCE)
    yield Metric("ate", float(ate), "m", "lower", bar_m)
    yield Metric("orientation", float(orientation), "deg", "lower")
    yield Metric("frames_lost", lost, "frames", "lower", 0.0, EXACT)
    yield Metric("coverage", span, "s", "higher", tolerance=QUANTISED_TOLERANCE)
    yield info("ate_where_openvins", float(shared), "m")


def _ate_within(run: Run, span: Trajectory) -> float:
    """ATE over the time that another estimate covers, in metres."""
    if not run.ok:
        return math.nan
    return Errors.of(run.truth, within(run.result.trajectory, span), "se3").position_m


BENCHMARKS = {
    f"mh01_{word}{suffix}": Benchmark(
        f"EuRoC MH_01, 17 s of images, {word}, started in flight: start-up, ATE, lost frames{who}",
        (RECORDING,),
        partial(measure, cameras=cameras, algorithms=algorithms),
        quick=not suffix,
    )
    for suffix, who, algorithms in (
        ("", "", CORE),
        ("_others", " of the algorithms that are only shown", (*UNBOUNDED, *PEERS)),
    )
    for word, cameras in (("mono", 1), ("stereo", 2))
}
