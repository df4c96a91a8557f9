# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The law of the table under noise: no combination of policies is surer than its errors allow.

Another sample of the combinations every week, on a few simulated flights with exactly the noise
that the engine assumes; the benchmark `policy_product` measures all of them. A failure names the
seed of the sample: set SLAM_GRAPH_SAMPLE_SEED to it to draw the same one again.
"""

import datetime
import os

import numpy as np
import pytest
from groups import slow_but

from benchmarks.policy_product import CAMERAS, FLIGHT, product
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.config import RunConfig
from slam_graph.evaluation.consistency import mean_bounds, nees
from slam_graph.experiment.tasks import find_sources
from slam_graph.pipeline.run_recording import run
from slam_graph.settings.tree import ConfigTree

SAMPLE_SEED = "SLAM_GRAPH_SAMPLE_SEED"
SAMPLED = 4
FLIGHTS = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + 5)
DURATION_S = 5.0
POSE_DOF = 6
FALSE_ALARMS = 1e-4
"""Probability that any of the sampled combinations fails although all covariances are right."""


def sample_seed() -> int:
    """What the environment says, or the year and its week."""
    year, week, _ = datetime.date.today().isocalendar()
    return int(os.environ.get(SAMPLE_SEED) or 100 * year + week)


def sampled(seed: int) -> list[AlgorithmConfig]:
    """Some of the combinations of policies; the same ones whatever other tests register."""
    everything = [algorithm for algorithm in product() if "test_" not in algorithm.name]
    rows = np.random.default_rng(seed).choice(len(everything), SAMPLED, replace=False)
    return [everything[row] for row in rows]


def mean_nees(algorithm: AlgorithmConfig, seed: int) -> float:
    """Pose NEES over the frames of a flight whose start has an error drawn from its covariance."""
    (source,) = find_sources(["sim:figure8"], DURATION_S, FLIGHT)
    result = run(source.open(seed, CAMERAS), settings(algorithm))
    result.check()
    truth = result.groundtruth
    assert truth is not None
    return float(nees(result.trajectory, result.history.pose_covariances(), truth).pose.mean())


def settings(algorithm: AlgorithmConfig) -> RunConfig:
    """What ships, with the covariance of the start kept."""
    tree = {
        "algorithm": algorithm.model_dump(),
        "cameras": CAMERAS,
        "backend": {"initialization": {"fix_gauge": False, "check_calibration": False}},
        "final_ba": {"enabled": False},
    }
    return ConfigTree(tree).validated(RunConfig)


@pytest.mark.parametrize("number", slow_but({SAMPLED - 1}, range(SAMPLED)))
def test_no_combination_is_too_sure(number: int) -> None:
    seed = sample_seed()
    algorithm = sampled(seed)[number]
    # frames of one flight are correlated, so the flights are the samples
    bound = mean_bounds(POSE_DOF, len(FLIGHTS), 1.0 - 2.0 * FALSE_ALARMS / SAMPLED)[1]
    means = [mean_nees(algorithm, flight) for flight in FLIGHTS]
    assert np.mean(means) < bound, (
        f"{algorithm.name}: pose NEES {np.mean(means):.1f} of at most {bound:.1f} "
        f"({', '.join(f'{mean:.1f}' for mean in means)}); {SAMPLE_SEED}={seed}"
    )
