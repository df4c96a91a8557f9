# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Consistency of every combination of policies that is accepted, over Monte Carlo runs.

The noise is exactly what the estimators assume; gate and robust loss are those that ship. A
combination may be careful but not too sure: the bar is the upper χ² bound of the mean over the
flights. The frames of one flight are correlated, so the flights are the samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.experiments import compared, folder_of, note_failures, results_of
from benchmarks.metric import EXACT, Metric, info
from benchmarks.policy_combinations import combinations, values_of
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from benchmarks.suite import Benchmark, Outcome
from slam_graph.backend.cost.selection_policies import FEATURE_POLICIES, POSE_SELECTIONS
from slam_graph.backend.policies import AlgorithmConfig, CostPolicy
from slam_graph.config import RunConfig
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.experiment.comparison_figures import NEES_DOF
from slam_graph.experiment.comparison_plan import Comparison
from slam_graph.experiment.comparison_results import Series, read_series
from slam_graph.experiment.tasks import find_sources

SEEDS = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + 5)
DURATION_S = 8.0
CAMERAS = 2
FLIGHT = ("rate_hz=10", "tracks.features=60", "flight.hover_s=0")

MAX_PAST_POSES = {"evenly_spaced": 15, "keyframes": 5}
"""As the algorithms that ship have them; the default for other selections."""


def product() -> Iterator[AlgorithmConfig]:
    """All combinations of what is registered, with first-estimates Jacobians."""
    default = CostPolicy().max_past_poses
    return combinations(
        {
            name: {
                "cost.past_poses": name,
                "cost.max_past_poses": MAX_PAST_POSES.get(name, default),
            }
            for name in POSE_SELECTIONS
        },
        values_of("cost.features", FEATURE_POLICIES),
        {f"held{n}": {"cost.max_state_features": n} for n in (0, 40)},
        {f"recent{n}": {"cost.recent_frames": n} for n in (1, 3)},
        {f"steps{n}": {"gauss_newton.max_steps": n} for n in (1, 3)},
    )


def measure(data: Path) -> Outcome:
    """Mean pose NEES over all flights and frames of every combination, with its upper bound."""
    outcome = Outcome()
    (source,) = find_sources(["sim:figure8"], DURATION_S, FLIGHT)
    configs = {
        algorithm.name: RunConfig(algorithm=algorithm, cameras=CAMERAS, duration_s=DURATION_S)
        for algorithm in product()
    }
    comparison = compared(folder_of("policy_product"), [source], configs, SEEDS)
    for name in configs:
        outcome.add(name, figures_of(comparison, source.name, name), held_out=True)
    note_failures(outcome, comparison)
    bound = mean_bounds(NEES_DOF["pose"], len(SEEDS))[1]
    outside = [m.key for m in outcome.metrics if m.meets_bar is False]
    outcome.notes.append(
        f"{len(configs)} combinations on {len(SEEDS)} stereo flights of {DURATION_S:g} s from "
        f"seed {SEEDS[0]} on, loss and gate as they ship; upper bound of the pose NEES "
        f"{bound:.1f} (ideal 6); outside: {', '.join(outside) or 'none'}"
    )
    return outcome


def figures_of(comparison: Comparison, data: str, name: str) -> list[Metric]:
    """What the flights say of one combination."""
    results = results_of(comparison, data, name)
    series = [read_series(task.result) for task, _ in results]
    errors = [r["metrics"]["accuracy"]["none"]["ate"]["translation_m"]["rmse"] for _, r in results]
    return [
        Metric("finished", len(results), "runs", "higher", len(SEEDS), EXACT),
        pose_nees(series),
        info("position", float(np.mean(errors)) if errors else math.nan, "m"),
    ]


def pose_nees(runs: Iterable[Series]) -> Metric:
    """The mean over runs and frames, with its upper bound."""
    means = [series["nees_pose"].mean() for series in runs]
    mean = float(np.mean(means)) if means else math.nan
    bound = mean_bounds(NEES_DOF["pose"], len(SEEDS))[1]
    # no baseline: within the bounds a NEES is neither better nor worse than another
    return Metric("nees_pose", mean, "", "lower", bound, tolerance=None)


BENCHMARKS = {
    "policy_product": Benchmark(
        "Pose NEES of every combination of policies within its χ² bound, simulated stereo flights",
        (),
        measure,
    )
}
