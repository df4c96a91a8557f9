# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whole recordings through the estimator, measured against the truth.

Bounds of errors are 1.5 times what was measured, here and in all tests of whole runs.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from groups import slow, slow_but

from slam_graph.config import algorithm_names, load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.sequence import Sequence
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.evaluation.choices import PoseRelation
from slam_graph.geometry.trajectory_alignment import AlignmentMode
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult

CAUSAL = ["final_ba.enabled=false"]
"""What is smoothed in the end is not looked at here."""


def rmse(
    sequence: Sequence, result: RunResult, alignment: AlignmentMode, relation: PoseRelation
) -> float:
    truth = sequence.groundtruth()
    assert truth is not None
    return float(ape(truth, result.trajectory, relation, alignment).statistics.rmse)


@pytest.mark.data
@pytest.mark.parametrize("algorithm", ["msckf", slow("swf")])
def test_the_wheels_tracks(data_dir: Path, algorithm: str) -> None:
    """Monocular, at rest for five seconds, without being told the start state."""
    truth = data_dir / "euroc_inertial" / "V1_01_easy"
    sequence = open_dataset("demo", groundtruth=truth)
    result = run(sequence, load_config(overrides=CAUSAL, algorithm=algorithm))
    assert result.status == "ok"
    stamps = result.trajectory.stamps_ns
    assert stamps[-1] - stamps[0] >= 28_000_000_000
    assert rmse(sequence, result, "se3", "trans_part") <= 0.020


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    ("algorithm", "cameras", "seconds", "position_m", "angle_deg"),
    [
        ("msckf", 1, 30.0, 0.019, 0.21),
        ("msckf", 2, 30.0, 0.015, 0.19),
        ("swf", 2, 30.0, 0.015, 0.19),
    ],
)
def test_a_simulation_from_a_given_start(
    data_dir: Path,
    algorithm: str,
    cameras: int,
    seconds: float,
    position_m: float,
    angle_deg: float,
) -> None:
    """The first seconds, not aligned: the world is that of the start state.

    `test_simulation_runs` has a quick one, and `make gate` measures the whole flight.
    """
    sequence = open_dataset(data_dir / "openvins_sim" / "euroc_V1_01", cameras=cameras)
    result = run(sequence, load_config(overrides=CAUSAL, algorithm=algorithm, duration_s=seconds))
    assert result.status == "ok"
    assert result.start_was_given
    assert result.coverage > 0.999
    assert rmse(sequence, result, "none", "trans_part") <= position_m
    assert rmse(sequence, result, "none", "angle_deg") <= angle_deg


# --- what every algorithm must do -----------------------------------------------------------------

CONTRACT: dict[str, Any] = {
    "overrides": CAUSAL,
    "start_s": 3.5,
    "duration_s": 5.0,
    "min_coverage": 0.3,
}
"""Of the wheel's tracks: a start from rest, the take-off, and three seconds of flight."""


@pytest.fixture(scope="module")
def contract_runs() -> dict[str, RunResult]:
    """The runs that are shared by the tests below."""
    return {}


BRIEF = ("ekf", "fixed_lag_isam2", "msckf", "okvis", "swf")
"""Algorithms that `make test` runs."""


@pytest.fixture(params=slow_but(BRIEF, algorithm_names()))
def contract_run(request: pytest.FixtureRequest, contract_runs: dict[str, RunResult]) -> RunResult:
    name = str(request.param)
    if name not in contract_runs:
        contract_runs[name] = run(open_dataset("demo"), load_config(algorithm=name, **CONTRACT))
    return contract_runs[name]


def test_every_algorithm_gives_sane_states(contract_run: RunResult) -> None:
    contract_run.check()
    trajectory = contract_run.trajectory
    assert len(trajectory) > 50
    assert np.all(np.diff(trajectory.stamps_ns) > 0)
    assert trajectory.velocities is not None
    assert trajectory.gyro_biases is not None
    assert trajectory.accel_biases is not None
    for values in (
        trajectory.positions,
        trajectory.quaternions,
        trajectory.velocities,
        trajectory.gyro_biases,
        trajectory.accel_biases,
    ):
        assert np.isfinite(values).all()
    np.testing.assert_allclose(np.linalg.norm(trajectory.quaternions, axis=1), 1.0, atol=1e-9)
    travelled = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum()
    assert 0.5 < travelled < 1.1


def test_every_algorithm_gives_positive_definite_covariances(contract_run: RunResult) -> None:
    sigmas = contract_run.history.sigmas()
    assert np.isfinite(sigmas).all()
    assert np.all(sigmas > 0)
    covariances = contract_run.history.pose_covariances()
    np.testing.assert_allclose(covariances, covariances.transpose(0, 2, 1), rtol=1e-9, atol=1e-15)
    assert np.all(np.linalg.eigvalsh(covariances) > 0)


@pytest.mark.parametrize(
    "contract_run", slow_but({"ekf", "okvis"}, algorithm_names()), indirect=True
)
def test_every_algorithm_is_deterministic(contract_run: RunResult) -> None:
    """Two runs give the same states to the last bit; the second one ends soon after take-off.

    `test_repeats` compares whole runs of other algorithms.
    """
    algorithm = contract_run.config.algorithm
    again = run(
        open_dataset("demo"), load_config(algorithm=algorithm.name, **{**CONTRACT, "duration_s": 3})
    )
    count = len(again.trajectory)
    assert count > 30
    for name in ("stamps_ns", "positions", "quaternions", "velocities", "gyro_biases"):
        one, two = (getattr(r.trajectory, name) for r in (contract_run, again))
        np.testing.assert_array_equal(one[:count], two)
    np.testing.assert_array_equal(contract_run.history.sigmas()[:count], again.history.sigmas())
