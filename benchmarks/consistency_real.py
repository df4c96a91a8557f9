# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How honest covariances are with a real IMU: the first part of flights of EuRoC and TUM-VI.

The camera is simulated along a path that agrees with the IMU: 20 Hz, 150 features, 1 px. So the
truth is exact and the pixel noise is as assumed, and only the IMU differs from what is assumed of
it. No start is given: the covariance of the first state counts as well. Smoothed trajectories
hardly depend on the algorithm of the run, so that only those of one are judged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.flights import (
    FLIGHTS,
    KIND,
    flight_is_held_out,
    flown_by_camera,
    in_parallel,
    without_start,
)
from benchmarks.metric import EXACT, Metric, info
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.running import Run
from benchmarks.suite import PEERS, RECURSIVE, Benchmark, Outcome
from slam_graph.evaluation import ape, nees_of_run

SECONDS = 30.0
SMOOTHED_WITH = "msckf"
"""The run whose smoothed trajectory is judged."""
NEES_BAR = 4.5
"""One and a half times the ideal, of three degrees of freedom."""
PARTS = ("orientation", "position")


@dataclass(frozen=True, slots=True)
class Consistency:
    """What one run found, or the smoothed trajectory of one.

    Attributes:
        ate_m: root mean square position error after alignment; NaN if it did not end well.
        nees: means over the run, of orientation and position.
        late: the same over its second half, where a start is forgotten.
        note: why it did not end well.
    """

    ate_m: float
    nees: tuple[float, float]
    late: tuple[float, float]
    note: str = ""


_UNKNOWN = (np.nan, np.nan)


def measure(
    data: Path,
    algorithms: tuple[str, ...] = (*RECURSIVE, *PEERS),
    flights: tuple[str, ...] = FLIGHTS,
    seconds: float = SECONDS,
) -> Outcome:
    """Errors and NEES of all algorithms on all flights, with one camera and two.

    Args:
        data: folder of recordings.
        algorithms: those to run.
        flights: below the folder.
        seconds: how much of each flight to take.
    """
    outcome = Outcome()
    tasks = [
        (data / flight, cameras, name, seconds)
        for flight in flights
        for cameras in (1, 2)
        for name in algorithms
    ]
    found = in_parallel(flown, tasks)
    for (path, cameras, name, _), runs in zip(tasks, found, strict=True):
        held_out = flight_is_held_out(path)
        flight = f"{path.name}.{KIND[cameras]}"
        for what, run in zip((name, f"smoothed_{name}"), runs, strict=False):
            judged = name not in PEERS
            outcome.add(f"{flight}.{what}", figures_of(run), judged, held_out)
            if run.note:
                outcome.notes.append(f"{flight}.{what}: {run.note}")
    return outcome


def flown(path: Path, cameras: int, algorithm: str, seconds: float) -> list[Consistency]:
    """A causal run, and the smoothed trajectory if it is judged."""
    seed = FIRST_HELD_OUT_SEED if flight_is_held_out(path) else 0
    sequence = flown_by_camera(path, cameras, seed, duration_s=seconds)
    smoothed = algorithm == SMOOTHED_WITH
    run = Run(without_start(sequence), algorithm, cameras, final_ba=smoothed)
    if not run.ok:
        failed = Consistency(np.nan, _UNKNOWN, _UNKNOWN, run.result.message)
        return [failed] * (1 + smoothed)
    found = [_judged(run, smoothed=False)]
    return [*found, _judged(run, smoothed=True)] if smoothed else found


def figures_of(run: Consistency) -> Iterator[Metric]:
    """Error and NEES of one trajectory."""
    yield Metric("finished", float(not run.note), "runs", "higher", 1.0, EXACT)
    yield Metric("ate", run.ate_m, "m", "lower")
    for part, mean, late in zip(PARTS, run.nees, run.late, strict=True):
        yield Metric(f"nees_{part}", mean, "", "lower", NEES_BAR)
        yield info(f"nees_{part}_late", late, "")


def _judged(run: Run, smoothed: bool) -> Consistency:
    """The causal estimate under an alignment at its first state, or the smoothed one of a run.

    The truth is exact, so that covariances of causal states can be taken as they are.
    """
    final_ba = run.result.final_ba
    if smoothed and final_ba is None:
        return Consistency(np.nan, _UNKNOWN, _UNKNOWN, "no smoothed trajectory")
    history = run.result.history if not smoothed or final_ba is None else final_ba.history
    found, _ = nees_of_run(run.truth, history, False, final_ba if smoothed else None)
    middle = (found.stamps_ns[0] + found.stamps_ns[-1]) // 2
    series = (found.orientation, found.position)
    whole, late = (
        [float(np.mean(nees[rows])) for nees in series]
        for rows in (slice(None), found.stamps_ns > middle)
    )
    ate = ape(run.truth, history.trajectory(), "trans_part", "se3").statistics.rmse
    return Consistency(ate, (whole[0], whole[1]), (late[0], late[1]))


BENCHMARKS = {
    "consistency_real": Benchmark(
        f"the first {SECONDS:g} s of flights with a real IMU: NEES of all algorithms and of the "
        "smoothed trajectory",
        FLIGHTS,
        measure,
    )
}
