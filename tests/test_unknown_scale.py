# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""NEES where nothing measures lengths: in the unit to which the covariances are relative.

Simulated estimates whose covariances are exact: the logarithm of the scale and the place are random
walks from the first state on, as those of one camera that loses its features.
"""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.evaluation.evaluation_report import accuracy_report, nees_of_run
from slam_graph.geometry.state_history import StateHistory
from slam_graph.geometry.trajectory import NavState, Trajectory

STATES, DRAWS = 120, 300
LATE = slice(60, None)
UNIT_M = 1.3
"""Metres of one unit of the estimate."""
SCALE_STEP, PLACE_STEP_M, FIRST_M = 0.004, 0.0004, 1e-6
FALSE_ALARMS = 1e-4
MOUNTED = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, -0.4, 1.9), np.array([0.3, -0.2, 0.1]))
"""body_T_camera: the path of the camera is scaled, and its place in the body is not."""


def path() -> Trajectory:
    """A loop of 25 m that ends where it began, with the body turning."""
    phase = np.linspace(0.0, 2 * np.pi, STATES)
    positions = np.column_stack([4 * np.sin(phase), 4 - 4 * np.cos(phase), np.sin(2 * phase)])
    turns = Rotation.from_euler("zy", np.column_stack([phase, 0.3 * np.sin(phase)]))
    stamps = 1_000_000_000 + 50_000_000 * np.arange(STATES)
    return Trajectory(stamps, positions, turns.as_quat())


def state_at(truth: Trajectory, k: int, pose: gtsam.Pose3, P: FloatArray | None) -> NavState:
    none = np.zeros(3)
    stamp_ns = int(truth.stamps_ns[k])
    return NavState(stamp_ns, pose, none, accel_bias=none, gyro_bias=none, covariance=P)


def estimate(truth: Trajectory, rng: np.random.Generator) -> StateHistory:
    """States with errors of known covariance, in a unit of their own and another world."""
    truth = truth.mounted(MOUNTED)
    arms = truth.positions - truth.positions[0]
    logs = np.concatenate([[0.0], np.cumsum(SCALE_STEP * rng.normal(size=STATES - 1))])
    places = np.cumsum(PLACE_STEP_M * rng.normal(size=(STATES, 3)), axis=0)
    turned = Rotation.from_euler("xyz", [0.4, -0.2, 2.0])
    history = StateHistory(level=False, scaled_camera=MOUNTED)
    for k in range(STATES):
        p = turned.apply((1.0 + logs[k]) * arms[k] + places[k] - places[0]) / UNIT_M
        R = turned * Rotation.from_quat(truth.quaternions[k])
        along = R.as_matrix().T @ turned.apply(arms[k]) / UNIT_M
        P = np.eye(15)  # of the camera first
        P[3:6, 3:6] = k * SCALE_STEP**2 * np.outer(along, along)
        P[3:6, 3:6] += (k * (PLACE_STEP_M / UNIT_M) ** 2 + FIRST_M**2) * np.eye(3)
        pose = gtsam.Pose3(gtsam.Rot3(R.as_matrix()), p).compose(MOUNTED.inverse())
        P[:6, :6] = MOUNTED.AdjointMap() @ P[:6, :6] @ MOUNTED.AdjointMap().T
        history.append(state_at(truth, k, pose, P))
    return history


@pytest.fixture(scope="module")
def drawn() -> tuple[FloatArray, FloatArray]:
    """NEES (DRAWS, STATES) of the position, and (DRAWS,) the scales that were taken."""
    rng, truth = np.random.default_rng(8), path()
    found = []
    for _ in range(DRAWS):
        result, alignment = nees_of_run(truth, estimate(truth, rng), False)
        assert alignment == "first_pose_and_scale"
        found.append((result.position, result.similarity.scale))
    return np.array([nees for nees, _ in found]), np.array([scale for _, scale in found])


@pytest.mark.slow
def test_errors_far_from_the_start_are_as_large_as_the_covariances_say(
    drawn: tuple[FloatArray, FloatArray],
) -> None:
    means = drawn[0].mean(axis=0)
    low, high = mean_bounds(3, DRAWS, 1.0 - FALSE_ALARMS)
    assert np.all(means < high), means
    assert np.all(means[LATE] > low), means


@pytest.mark.slow
def test_the_scale_is_that_of_the_start_and_not_of_the_whole_path(
    drawn: tuple[FloatArray, FloatArray],
) -> None:
    """The drift of the scale over the path is ten times as large as what is taken for its unit."""
    drift = SCALE_STEP * np.sqrt(STATES)
    assert np.std(drawn[1] / UNIT_M) < 0.4 * drift
    assert np.mean(drawn[1]) == pytest.approx(UNIT_M, rel=0.1 * drift)


def test_without_covariances_there_is_no_nees_and_no_failure() -> None:
    truth = path()
    history = StateHistory(level=False, scaled_camera=MOUNTED)
    for k in range(STATES):
        pose = gtsam.Pose3(gtsam.Rot3(), truth.positions[k])
        history.append(state_at(truth, k, pose, None))
    assert len(nees_of_run(truth, history, False)[0].pose) == 0


def test_a_scaled_path_of_the_camera_has_no_error() -> None:
    """Although the path of the body, whose place beside the camera is in metres, is not scaled."""
    truth = path()
    cameras = truth.mounted(MOUNTED)
    scaled = Trajectory(cameras.stamps_ns, cameras.positions / UNIT_M, cameras.quaternions)
    estimate = scaled.mounted(MOUNTED.inverse())
    of_camera, of_body = (
        accuracy_report(truth, estimate, camera)["sim3"] for camera in (MOUNTED, gtsam.Pose3())
    )
    assert of_camera["scale"] == pytest.approx(UNIT_M)
    assert of_camera["ate"]["translation_m"]["max"] < 1e-9
    assert of_camera["ate"]["rotation_deg"]["max"] < 1e-6
    assert of_body["ate"]["translation_m"]["max"] > 0.01
