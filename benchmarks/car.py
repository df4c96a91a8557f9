# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated car with KITTI's stereo cameras and no IMU: its drift, and its error with GNSS.

Drift is that of KITTI's odometry benchmark (Geiger, Lenz & Urtasun 2012): the error of the motion
over 100, 200, … 800 m, by their length. With position fixes errors are taken without alignment.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metric import EXACT, Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph import run
from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.evaluation import ape, rpe
from slam_graph.evaluation.choices import PoseRelation
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.geometry import Trajectory
from slam_graph.results import RunResult
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

ALGORITHM = "msckf"
SEEDS = range(5)
LENGTHS_M = range(100, 900, 100)
DRIVE_S, LONG_DRIVE_S = 100.0, 1000.0
"""At 10 m/s: 1 km and 10 km."""
GNSS = {"sigma_m": 1.0, "multipath": 0.2}


def measure_drift(_: Path) -> Outcome:
    """Errors of 1 km in five drives."""
    drifts = []
    for seed in SEEDS:
        sequence, result = _driven(DRIVE_S, seed)
        drifts.append(kitti_drift(sequence.groundtruth(), result.trajectory))
    translation, rotation = np.mean(drifts, axis=0)
    outcome = Outcome()
    outcome.add(
        ALGORITHM,
        [
            Metric("translation", float(translation), "%", "lower", 0.8),
            Metric("rotation", float(rotation), "deg/m", "lower", 0.003),
        ],
    )
    return outcome


def measure_gnss(_: Path) -> Outcome:
    """Error and NEES over 10 km with fixes, from a start of its own."""
    sequence, result = _driven(LONG_DRIVE_S, 0, gnss=GNSS)
    path, truth = result.trajectory, sequence.groundtruth()
    error = ape(truth, path, alignment="none").statistics
    nees = result.metrics["nees"]
    low, high = mean_bounds(3, 1)
    figures = [
        Metric("covered", len(path) / len(truth), "", "higher", 0.99, EXACT),
        Metric("position", error.rmse, "m", "lower", 0.5),
        info("largest", error.max, "m"),
    ]
    for part in ("position", "orientation"):
        figures.append(info(f"nees_{part}", nees[part]["mean"], ""))
        figures.append(info(f"nees_{part}_inside", nees[part]["inside_bounds"], ""))
    outcome = Outcome()
    outcome.add(ALGORITHM, figures)
    outcome.notes.append(f"bounds of the NEES of one state: {low:.2f} to {high:.2f}")
    return outcome


def _driven(duration_s: float, seed: int, **settings: Any) -> tuple[SimulatedSequence, RunResult]:
    sequence = simulate(
        trajectory="car", duration_s=duration_s, seed=seed, with_imu=False, **settings
    )
    return sequence, run(sequence, algorithm=ALGORITHM, final_ba={"enabled": False})


def kitti_drift(truth: Trajectory, path: Trajectory) -> tuple[float, float]:
    """Mean error of translation (%) and of rotation (°/m) over all lengths that there are."""
    translations, rotations = [], []
    for length_m in LENGTHS_M:
        try:
            moved = _errors(truth, path, "trans_part", length_m)
            turned = _errors(truth, path, "angle_deg", length_m)
        except DataError:  # it is shorter
            break
        translations.append(100.0 * moved / length_m)
        rotations.append(turned / length_m)
    return float(np.concatenate(translations).mean()), float(np.concatenate(rotations).mean())


def _errors(
    truth: Trajectory, path: Trajectory, relation: PoseRelation, length_m: float
) -> FloatArray:
    """Errors (N,) of the motions over a length of the true path."""
    return rpe(
        truth,
        path,
        relation,
        delta=length_m,
        unit="m",
        all_pairs=True,
        tolerance=0.05,
        pairs_from_reference=True,
    ).values


BENCHMARKS = {
    "car": Benchmark("Stereo without an IMU: drift of a car over 1 km, 5 seeds", (), measure_drift),
    "gnss": Benchmark("The same over 10 km with fixes of 1 m, a fifth multipath", (), measure_gnss),
}
