# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The real images of EuRoC MH_01, 17 s from a start in flight, beside what others make of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from benchmarks.metric import EXACT, QUANTISED_TOLERANCE, Metric, info
from benchmarks.running import Errors, Run, clipped, within
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

CLIP_S = 6.0
"""How much of it algorithms run on whose cost has no bound."""

OTHERS = {
    1: {"openvins": "openvins_mono"},
    2: {"openvins": "openvins_stereo", "basalt": "basalt_stereo", "okvis2": "okvis2_slam_causal"},
}
"""Files of causal estimates of others by their name, for each number of cameras."""


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
        run = Run(folder, name, cameras, duration_s=clip_s)
        errors = run.errors("se3")
        figures = [
            Metric("start", run.seconds_to_start, "s", "lower", START_BAR_S, QUANTISED_TOLERANCE),
            Metric("ate", errors.position_m, "m", "lower", bars.get(name)),
            Metric("orientation", errors.orientation_deg, "deg", "lower"),
            Metric("frames_lost", run.frames_lost, "frames", "lower", 0.0, EXACT),
            Metric("coverage", errors.span_s, "s", "higher", tolerance=QUANTISED_TOLERANCE),
            info("ate_where_openvins", _ate_within(run, peers["openvins"]), "m"),
        ]
        outcome.add(clipped(name, clip_s), figures, judged=name in bars)
        outcome.notes += run.notes()
    truth = read_groundtruth(folder)
    for name, peer in peers.items():
        errors = Errors.of(truth, peer, "se3")
        outcome.metrics += [
            info(f"{name}.ate", errors.position_m, "m"),
            info(f"{name}.orientation", errors.orientation_deg, "deg"),
            info(f"{name}.coverage", errors.span_s, "s"),
        ]
    return outcome


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
