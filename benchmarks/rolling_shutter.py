# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rolling shutters: errors with a known readout time, without it, and with a global shutter.

A real IMU and a simulated camera along a recorded flight. Where the readout is not known, all rows
are taken as exposed at the time of the middle one, which is what a calibration of the time offset
that knows nothing of rows would say.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.flights import KIND, flight_is_held_out, flown_by_camera, in_parallel
from benchmarks.metric import Metric, info
from benchmarks.running import Errors, Run
from benchmarks.suite import RECURSIVE, Benchmark, Outcome
from slam_graph.sensors import Rig

FLIGHTS = ("euroc_inertial/V1_02_medium", "tumvi_inertial/room1", "tumvi_inertial/room3")
READOUTS_S = (0.02, 0.03)
SEEDS = (0, 1, 2)
DURATION_S = 20.0

RATIO_BAR = 1.3
"""Largest error relative to that with a global shutter; mean over flights of as many seeds."""

WITH_FINAL_BA = "msckf"
"""The bundle adjustment at the end is measured after this algorithm."""


@dataclass(frozen=True, slots=True)
class Flown:
    """Errors of one run.

    Attributes:
        ate: of the causal estimate, m.
        smoothed: of the bundle adjustment at its end, m; NaN without one.
        nees: of position and orientation.
    """

    ate: float
    smoothed: float
    nees: tuple[float, float]


def measure(data: Path, duration_s: float = DURATION_S) -> Outcome:
    """Errors of every algorithm with one camera and two.

    Args:
        data: folder of recordings.
        duration_s: how much of each flight to take.
    """
    outcome = Outcome()
    tasks = [
        (data / flight, cameras, algorithm, duration_s)
        for flight in FLIGHTS
        for cameras in (1, 2)
        for algorithm in RECURSIVE
    ]
    found = in_parallel(figures_of, tasks)
    for (path, cameras, algorithm, _), figures in zip(tasks, found, strict=True):
        held_out = flight_is_held_out(path)
        outcome.add(f"{path.name}.{KIND[cameras]}.{algorithm}", figures, held_out=held_out)
    return outcome


def figures_of(path: Path, cameras: int, algorithm: str, duration_s: float) -> list[Metric]:
    """Errors and their ratios, means over the seeds."""
    return list(_figures(path, cameras, algorithm, duration_s))


def _figures(path: Path, cameras: int, algorithm: str, duration_s: float) -> Iterator[Metric]:
    still = _flown(path, cameras, algorithm, duration_s, 0.0, True)
    yield info("global.ate", still.ate, "m")
    yield info("global.smoothed", still.smoothed, "m")
    for readout_s in READOUTS_S:
        known = _flown(path, cameras, algorithm, duration_s, readout_s, True)
        unknown = _flown(path, cameras, algorithm, duration_s, readout_s, False)
        name = f"{1e3 * readout_s:.0f}ms"
        ratio = known.ate / still.ate
        yield Metric(f"{name}.ratio", ratio, "× global", "lower", RATIO_BAR)
        yield info(f"{name}.ate", known.ate, "m")
        yield info(f"{name}.smoothed", known.smoothed, "m")
        yield info(f"{name}.nees_position", known.nees[0], "")
        yield info(f"{name}.nees_orientation", known.nees[1], "")
        yield info(f"{name}.ignored_ate", unknown.ate, "m")
        yield info(f"{name}.ignored_smoothed", unknown.smoothed, "m")


def ignored(rig: Rig) -> Rig:
    """The rig with global shutters, and with the time offset of the middle row."""
    cameras = (
        replace(c, readout_s=0.0, time_offset_s=c.time_offset_s + c.middle_s) for c in rig.cameras
    )
    return replace(rig, cameras=tuple(cameras))


def _flown(
    path: Path, cameras: int, algorithm: str, duration_s: float, readout_s: float, known: bool
) -> Flown:
    """Means over the seeds; NaN if a run did not come to a good end."""
    runs = [_run(path, cameras, algorithm, duration_s, readout_s, known, seed) for seed in SEEDS]
    nees = np.mean([run.nees for run in runs], axis=0)
    ate, smoothed = (float(np.mean([getattr(r, n) for r in runs])) for n in ("ate", "smoothed"))
    return Flown(ate, smoothed, (float(nees[0]), float(nees[1])))


def _run(
    path: Path,
    cameras: int,
    algorithm: str,
    duration_s: float,
    readout_s: float,
    known: bool,
    seed: int,
) -> Flown:
    sequence = flown_by_camera(path, cameras, seed, duration_s=duration_s, readout_s=readout_s)
    sequence.rig = sequence.rig if known else ignored(sequence.rig)
    run = Run(sequence, algorithm, final_ba=algorithm == WITH_FINAL_BA)
    smoothed = Errors.unknown()
    if run.ok and run.result.smoothed is not None:
        smoothed = Errors.of(run.truth, run.result.smoothed, "se3")
    nees = run.result.metrics["nees"] if run.ok else {}
    means = [nees[n]["mean"] if nees else float("nan") for n in ("position", "orientation")]
    return Flown(run.errors("se3").position_m, smoothed.position_m, (means[0], means[1]))


BENCHMARKS = {
    "rolling_shutter": Benchmark(
        "flights with a real IMU and rolling shutters: errors with known and unknown readout",
        FLIGHTS,
        measure,
    )
}
