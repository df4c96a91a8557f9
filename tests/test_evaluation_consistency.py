# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""NEES follows its χ² distribution when, and only when, covariances are right."""

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from slam_graph.evaluation.consistency import average_nees, mean_bounds, nees
from slam_graph.evaluation.evaluation_report import consistency_report, innovation_report
from slam_graph.geometry.state_history import StateHistory
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.geometry.trajectory_alignment import Similarity

COUNT = 2000
START_NS = 1_403_636_580_838_555_648


def true_poses(rng: np.random.Generator) -> list[gtsam.Pose3]:
    return [
        gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3) * 5)
        for _ in range(COUNT)
    ]


def as_trajectory(poses: list[gtsam.Pose3]) -> Trajectory:
    return Trajectory(
        START_NS + 50_000_000 * np.arange(len(poses), dtype=np.int64),
        np.array([pose.translation() for pose in poses]),
        np.array([pose.rotation().toQuaternion().coeffs() for pose in poses]),
    )


def noisy_history(
    poses: list[gtsam.Pose3], rng: np.random.Generator, claimed: float
) -> StateHistory:
    """Estimates with errors of random covariances, which claim `claimed` times the sigmas."""
    history = StateHistory()
    for index, pose in enumerate(poses):
        A = rng.normal(size=(6, 6)) * 0.01
        P = A @ A.T + 1e-6 * np.eye(6)
        error = rng.multivariate_normal(np.zeros(6), P)
        covariance = np.eye(15)
        covariance[:6, :6] = P * claimed**2
        history.append(
            NavState(
                START_NS + 50_000_000 * index,
                # the truth is at `error` from the estimate: truth = estimate ⊕ error
                pose.compose(gtsam.Pose3.Expmap(error).inverse()),
                np.zeros(3),
                accel_bias=np.zeros(3),
                gyro_bias=np.zeros(3),
                covariance=covariance,
            )
        )
    return history


@pytest.mark.parametrize("seed", range(3))
def test_right_covariances_give_a_mean_within_the_bounds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = true_poses(rng)
    history = noisy_history(poses, rng, claimed=1.0)
    result = nees(history.trajectory(), history.pose_covariances(), as_trajectory(poses))
    for values, dof in result.series().values():
        assert len(values) == COUNT
        low, high = mean_bounds(dof, COUNT, confidence=0.9999)
        assert low < values.mean() < high


def test_overconfidence_scales_the_mean() -> None:
    rng = np.random.default_rng(7)
    poses = true_poses(rng)
    history = noisy_history(poses, rng, claimed=0.5)
    result = nees(history.trajectory(), history.pose_covariances(), as_trajectory(poses))
    low, high = mean_bounds(6, COUNT, confidence=0.9999)
    assert low < result.pose.mean() * 0.25 < high


def test_a_rigid_map_of_the_world_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    poses = true_poses(rng)[:50]
    history = noisy_history(poses, rng, claimed=1.0)
    move = gtsam.Pose3(gtsam.Rot3.Rz(1.0), np.array([1.0, -2.0, 3.0]))
    moved_truth = as_trajectory([move.compose(pose) for pose in poses])
    same = nees(history.trajectory(), history.pose_covariances(), as_trajectory(poses))
    mapped = nees(
        history.trajectory(),
        history.pose_covariances(),
        moved_truth,
        Similarity(move.rotation().matrix(), move.translation()),
    )
    np.testing.assert_allclose(mapped.pose, same.pose, rtol=1e-6)


def test_states_without_covariance_or_truth_are_left_out() -> None:
    rng = np.random.default_rng(4)
    poses = true_poses(rng)[:20]
    truth = as_trajectory(poses[:15])
    history = noisy_history(poses, rng, claimed=1.0)
    covariances = history.pose_covariances()
    covariances[0] = np.nan
    assert len(nees(history.trajectory(), covariances, truth).pose) == 14
    report = consistency_report(truth, history, aligned=True)
    assert report is not None
    assert report["states"] == 15
    assert report["pose"]["ideal_mean"] == 6


def test_history_gives_back_what_it_was_given() -> None:
    rng = np.random.default_rng(1)
    state = NavState(
        START_NS,
        gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3)),
        rng.normal(size=3),
        accel_bias=rng.normal(size=3),
        gyro_bias=rng.normal(size=3),
    )
    history = StateHistory()
    history.append(state)
    trajectory = history.trajectory()
    assert trajectory.stamps_ns.tolist() == [START_NS]
    assert trajectory.pose(0).equals(state.world_T_body, 1e-12)
    np.testing.assert_array_equal(trajectory.velocities[0], state.velocity)
    np.testing.assert_array_equal(trajectory.gyro_biases[0], state.gyro_bias)
    np.testing.assert_array_equal(trajectory.accel_biases[0], state.accel_bias)
    assert np.isnan(history.sigmas()).all()


@pytest.mark.parametrize("dof", [3, 6])
def test_mean_bounds_close_in_on_the_degrees_of_freedom(dof: int) -> None:
    widths = []
    for count in (1, 10, 1000):
        low, high = mean_bounds(dof, count)
        assert low < dof < high
        widths.append(high - low)
    assert widths == sorted(widths, reverse=True)


def test_the_average_over_runs_of_a_right_covariance_is_inside_its_bounds() -> None:
    runs = np.random.default_rng(5).chisquare(6, (20, 4000))
    average = average_nees(runs, 6)
    assert average.bounds == mean_bounds(6, 20)
    assert average.inside == pytest.approx(0.95, abs=0.02)
    assert average.mean == pytest.approx(6.0, rel=0.02)
    assert average_nees(2.0 * runs, 6).inside < 0.1


def test_innovations_are_judged_by_what_passes_the_gate() -> None:
    rng = np.random.default_rng(6)
    dof, frames = 3, 3000
    distances = rng.chisquare(dof, (frames, 50))
    largest = chi2.ppf(0.95, dof)
    passed = distances < largest
    entered = passed.sum(axis=1)
    columns = {
        "tested": np.full(frames, 50.0),
        "rejected": 50.0 - entered,
        "distance": distances.sum(axis=1),
        "dof": np.full(frames, 50.0 * dof),
        "passed_distance": np.where(passed, distances, 0.0).sum(axis=1),
        "passed_dof": dof * entered.astype(float),
        "expected": dof * entered * chi2.cdf(largest, dof + 2) / 0.95,
    }
    report = innovation_report(columns)
    assert report is not None
    assert report["mean_before_gate"] == pytest.approx(1.0, rel=0.01)
    assert report["mean"] == pytest.approx(report["expected_mean"], rel=0.01)
    assert report["mean"] < 0.95
    assert report["inside_bounds"] >= 0.95
    assert report["rejected"] == pytest.approx(0.05, rel=0.05)
    assert innovation_report({name: np.zeros(0) for name in columns}) is None
