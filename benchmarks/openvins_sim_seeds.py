# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated V1_01 as in `openvins_sim`, over other seeds of the noise: one seed says little.

Our simulator flies the same path with the same settings: 250 features of 1 px at 10 Hz whose points
are found again, an IMU of 400 Hz, and the true start. Errors are without alignment.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.flights import in_parallel
from benchmarks.metric import EXACT, Metric, info
from benchmarks.openvins_sim import NEES_BAND, RECORDING, WORDS, Quality, mean_nees
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.running import Run
from benchmarks.suite import CORE, Benchmark, Outcome
from slam_graph.datasets import open_dataset
from slam_graph.simulation import simulate

SEEDS = 8
JUDGED = ("msckf", "swf")
POSITION_BARS_M = {1: 0.030, 2: 0.020}
ORIENTATION_BARS_DEG = {1: 0.2, 2: 0.12}
OPENVINS = {1: (0.045, 0.33), 2: (0.025, 0.25)}
"""OpenVINS' own means over eight other seeds of its simulator, in m and degrees."""


def measure(data: Path, cameras: int, seeds: int = SEEDS) -> Outcome:
    """Means over the seeds, for each algorithm.

    Args:
        data: folder of recordings.
        cameras: one or two.
        seeds: how many; they are held out.
    """
    outcome = Outcome()
    tasks = [
        (data / RECORDING, cameras, name, FIRST_HELD_OUT_SEED + seed)
        for name in CORE
        for seed in range(seeds)
    ]
    found = in_parallel(flown, tasks)
    for k, name in enumerate(CORE):
        runs = found[k * seeds : (k + 1) * seeds]
        outcome.add(name, figures_of(runs, cameras), name in JUDGED, held_out=True)
    position, orientation = OPENVINS[cameras]
    outcome.metrics.append(info("openvins.position", position, "m"))
    outcome.metrics.append(info("openvins.orientation", orientation, "deg"))
    return outcome


def flown(folder: Path, cameras: int, algorithm: str, seed: int) -> Quality | None:
    """One run, given the true start; None if it did not end well."""
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "path.txt"
        truth = open_dataset(folder).groundtruth()
        assert truth is not None
        path.write_text("".join(truth.tum_lines()))
        sequence = simulate(
            trajectory=str(path),
            cameras=cameras,
            rate_hz=10.0,
            tracks={"features": 250, "pixel_sigma": 1.0, "keep_ids": True},
            landmarks={"kind": "ahead"},
            imu={"rate_hz": 400.0},
            seed=seed,
        )
        given = ["backend.initialization.mode=given"]
        run = Run(sequence, algorithm, cameras, overrides=given)
    if not run.ok:
        return None
    errors = run.errors("none")
    return Quality(errors.position_m, errors.orientation_deg, *mean_nees(run))


def figures_of(runs: list[Quality | None], cameras: int) -> Iterator[Metric]:
    """Means over the seeds of one algorithm, and its worst position."""
    ended = [run for run in runs if run is not None]
    yield Metric("finished", len(ended), "runs", "higher", float(len(runs)), EXACT)
    position = [run.position_m for run in ended] or [np.nan]
    orientation = [run.orientation_deg for run in ended] or [np.nan]
    yield Metric("position", float(np.mean(position)), "m", "lower", POSITION_BARS_M[cameras])
    yield info("position_worst", float(np.max(position)), "m")
    bar = ORIENTATION_BARS_DEG[cameras]
    yield Metric("orientation", float(np.mean(orientation)), "deg", "lower", bar)
    nees_position = [run.nees_position for run in ended] or [np.nan]
    yield Metric("nees_position", float(np.mean(nees_position)), "", "band", NEES_BAND)
    nees_orientation = [run.nees_orientation for run in ended] or [np.nan]
    yield Metric("nees_orientation", float(np.mean(nees_orientation)), "", "band", NEES_BAND)


BENCHMARKS = {
    f"openvins_sim_seeds_{word}": Benchmark(
        f"simulated V1_01 tracks, {word}, start given: means over {SEEDS} other seeds",
        (RECORDING,),
        partial(measure, cameras=cameras),
    )
    for cameras, word in WORDS.items()
}
