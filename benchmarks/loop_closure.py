# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure: drift taken out of a long flight, false loops, and the time of a place query."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from time import process_time

import gtsam
import numpy as np

from benchmarks.metric import EXACT, TIMING_TOLERANCE, Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph.config import load_config
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.loop_closure.loop_closing import LoopClosures
from slam_graph.loop_closure.place_recognition import PlaceDatabase, Vocabulary
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.simulation.simulation_config import LandmarkConfig, SimulationConfig, TrackConfig
from slam_graph.simulation.simulator import simulate

LONG_S, LONG_SEED = 1200.0, 1
ATE_BAR = 4.0
"""How many times smaller the error of the long flight must be."""

SEEDS, SHORT_S = 20, 90.0
LOOKS = 300
"""So few looks that each is shared by several landmarks."""
FALSE_RAD, FALSE_M = 0.1, 0.4
"""A loop closure that is further off than this shows another place."""

SIZES = (50, 100, 200, 500, 1000, 2000, 5000)
DESCRIPTORS, WORDS = 150, 2000
QUERIES = 50
QUERY_BAR = 3.0
"""How much longer a query of the largest database may take than of one a hundredth its size."""


def rooms(seed: int, duration_s: float, cameras: int, looks: int) -> RunResult:
    """A tour through three rooms with loop closure."""
    config = SimulationConfig(
        trajectory="rooms",
        duration_s=duration_s,
        rate_hz=5.0,
        seed=seed,
        cameras=cameras,
        landmarks=LandmarkConfig(density=4.0),
        tracks=TrackConfig(
            features=80, loss=0.02, outliers=0.01, descriptors=True, distinct_descriptors=looks
        ),
    )
    settings = load_config(None, ["loop_closure.enabled=true"])
    return run(simulate(config), settings)


def long_flight(cameras: int, folder: Path) -> Outcome:
    """Twenty minutes, of which every minute comes back to places."""
    outcome, result = Outcome(), rooms(LONG_SEED, LONG_S, cameras, 2000)
    if result.loops is None or result.input.truth is None:
        return Outcome(failure=result.message or "no loops")
    causal, corrected = result.trajectory, result.loops.correct(result.best_trajectory)
    before, after = (
        ape(result.input.truth, trajectory, "trans_part", "yaw").statistics.rmse
        for trajectory in (causal, corrected)
    )
    false = false_loops(result.loops, result.input.truth) & result.loops.accepted
    outcome.metrics += [
        Metric("ate_ratio", before / after, "", "higher", ATE_BAR),
        Metric("ate_m", after, "m", "lower"),
        info("causal_ate_m", before, "m"),
        info("loops", float(result.loops.accepted.sum()), ""),
        Metric(
            "false_loops", float(np.sum(false & result.loops.accepted)), "", "lower", 0.0, EXACT
        ),
    ]
    return outcome


def many_flights(folder: Path) -> Outcome:
    """Short flights with looks that many landmarks share."""
    outcome, verified, accepted, loops = Outcome(), 0, 0, 0
    for seed in range(SEEDS):
        result = rooms(seed, SHORT_S, 2, LOOKS)
        if result.loops is None or result.input.truth is None:
            return Outcome(failure=f"seed {seed}: {result.message or 'no loops'}")
        false = false_loops(result.loops, result.input.truth)
        verified, accepted = (
            verified + int(false.sum()),
            accepted + int(np.sum(false & result.loops.accepted)),
        )
        loops += int(result.loops.accepted.sum())
    outcome.metrics += [
        Metric("false_accepted", float(accepted), "", "lower", 0.0, EXACT),
        info("false_verified", float(verified), ""),
        info("loops", float(loops), ""),
    ]
    return outcome


def false_loops(closures: LoopClosures, truth: Trajectory) -> np.ndarray:
    """(L,) which loop closures show another place than they say."""
    false = np.zeros(len(closures.loops), np.bool_)
    for row, loop in enumerate(closures.loops):
        stamps = [closures.keyframes[k].stamp_ns for k in (loop.first, loop.second)]
        i, j = np.searchsorted(truth.stamps_ns, stamps).tolist()
        true = truth.pose(i).between(truth.pose(j))
        error = gtsam.Pose3.localCoordinates(true, loop.first_T_second)
        false[row] = np.linalg.norm(error[:3]) > FALSE_RAD or np.linalg.norm(error[3:]) > FALSE_M
    return false


def place_query(folder: Path) -> Outcome:
    """The CPU time of a query in databases of 50 to 5000 keyframes."""
    outcome, rng = Outcome(), np.random.default_rng(0)
    pool = rng.integers(0, 256, (20_000, 32), dtype=np.uint8)
    vocabulary = Vocabulary.train([pool], WORDS, rng, len(pool), 2)

    def keyframe() -> np.ndarray:
        return pool[rng.integers(0, len(pool), DESCRIPTORS)]

    database, times = PlaceDatabase(WORDS), {}
    queries = [keyframe() for _ in range(QUERIES)]
    for size in SIZES:
        while len(database) < size:
            database.add(vocabulary.words_of(keyframe()))
        start = process_time()
        for query in queries:
            database.query(vocabulary.words_of(query))
        times[size] = (process_time() - start) / QUERIES
        outcome.metrics.append(info(f"{size}.ms", 1e3 * times[size], "ms"))
    growth = times[SIZES[-1]] / times[SIZES[0]]
    outcome.metrics.append(
        Metric("growth", growth, "", "lower", QUERY_BAR, tolerance=TIMING_TOLERANCE)
    )
    return outcome


BENCHMARKS = {
    "loop_query": Benchmark("Time of a place query up to 5000 keyframes", (), place_query),
    "loop_flights": Benchmark("False loop closures on 20 simulated flights", (), many_flights),
    "loop_stereo": Benchmark(
        "Loop closure against 20 minutes of drift, stereo", (), partial(long_flight, 2)
    ),
    "loop_mono": Benchmark(
        "Loop closure against 20 minutes of drift, one camera", (), partial(long_flight, 1)
    ),
}
