# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's smoothers as peers of the engine: the same residuals, start and output."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from flight import FISHEYE, RADTAN, Flight, rig, room, scene
from groups import slow
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.gtsam_smoothers import smoother_solvers
from slam_graph.backend.gtsam_smoothers.smoother_features import (
    ProjectionFactors,
    joint_prior,
    pixel_noise,
)
from slam_graph.backend.gtsam_smoothers.smoother_solvers import SOLVERS
from slam_graph.backend.initialization.first_state import prior_covariance, prior_of
from slam_graph.backend.policies import SmootherPolicy
from slam_graph.backend.solve.state import imu_state_keys
from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.geometry.trajectory import NavState
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.camera import Camera
from slam_graph.simulation import simulate

PLAIN = replace(RADTAN, distortion="none", coefficients=())


@pytest.mark.parametrize("camera", [PLAIN, RADTAN, FISHEYE], ids=["none", "radtan", "equidistant"])
def test_native_projections_have_the_residuals_of_the_engine(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    two = rig(2, camera)
    obs, at = scene(Flight(), two, room(60, rng), np.linspace(0.0, 4.0, 6), rng)
    values = gtsam.Values()
    for i, (rotation, position) in enumerate(zip(at.rotations, at.positions, strict=True)):
        values.insert(X(obs.frames[i]), gtsam.Pose3(gtsam.Rot3(rotation), position))
    for j, point in zip(obs.ids.tolist(), at.points, strict=True):
        values.insert(L(j), point)
    noise = pixel_noise(2.0, RobustLoss("none"))
    factors = ProjectionFactors(two, noise).of(obs)
    assert len(factors) == len(obs) > 100
    residuals, _ = RigProjection(two).residuals(obs, at)
    # GTSAM's residual is the prediction minus the measurement
    plain = [factor for factor in factors if isinstance(factor, gtsam.NoiseModelFactor)]
    native = np.array([factor.unwhitenedError(values) for factor in plain])
    np.testing.assert_allclose(-native, residuals, rtol=1e-9, atol=1e-8)
    errors = np.array([factor.error(values) for factor in factors])
    np.testing.assert_allclose(errors, 0.5 * np.sum((residuals / 2.0) ** 2, axis=1), atol=1e-8)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_smoother_gives_back_its_prior(name: str) -> None:
    """With nothing measured, estimate and joint covariance are those of the prior, correlated."""
    rng = np.random.default_rng(5)
    mixed = np.eye(15) + 0.2 * rng.normal(size=(15, 15))
    covariance = mixed @ prior_covariance(BackendConfig().initialization.prior) @ mixed.T
    turned = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 2.0, 3.0]))
    biases = {"accel_bias": np.full(3, 0.1), "gyro_bias": np.full(3, 0.01)}
    given = NavState(0, turned, np.ones(3), **biases, covariance=covariance)
    values = gtsam.Values()
    values.insert(X(0), turned)
    values.insert(V(0), given.velocity)
    values.insert(B(0), gtsam.imuBias.ConstantBias(given.accel_bias, given.gyro_bias))
    keys = imu_state_keys(0)
    solver = SOLVERS[name](SmootherPolicy())
    solver.update([joint_prior(prior_of(given), values)], values, dict.fromkeys(keys, 0.0))
    np.testing.assert_allclose(solver.covariance(keys), covariance, rtol=1e-6, atol=1e-12)
    assert solver.estimate(keys).atPose3(X(0)).equals(turned, 1e-9)


def test_a_dense_covariance_is_that_of_elimination() -> None:
    """Of poses in a chain, the last of them given first."""
    rng, values = np.random.default_rng(6), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(rng.uniform(0.01, 1.0, 6))
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), noise))
    step = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 0.5, 0.2]))
    for k in range(5):
        values.insert(X(k), gtsam.Pose3() if not k else values.atPose3(X(k - 1)).compose(step))
        if k:
            graph.push_back(gtsam.BetweenFactorPose3(X(k - 1), X(k), step, noise))
    linear, keys = graph.linearize(values), [X(4), X(2)]
    order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, keys)
    found = smoother_solvers._covariance_of_dense(linear, order, keys)
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(keys)
    expected = np.block([[joint.at(i, j) for j in keys] for i in keys])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["fixed_lag_isam2", slow("isam2"), slow("fixed_lag_batch")])
def test_a_drive_with_an_imu_and_fixes_of_a_metre(name: str) -> None:
    drive = simulate(
        trajectory="car",
        with_imu=True,
        seed=1,
        duration_s=8.0,
        tracks={"features": 40},
        gnss={"sigma_m": 1.0, "rate_hz": 2.0},
    )
    told = load_config(overrides=["final_ba.enabled=false", BELIEVED], algorithm=name)
    result = run(drive, told)
    assert result.status == "ok"
    assert len(result.segments) == 1
    assert result.georeferenced
    assert "smoother_restarted" not in result.warnings
    assert result.groundtruth is not None
    errors = ape(result.groundtruth, result.trajectory, "trans_part", "none").values
    assert np.max(errors[-10:]) < 2.0


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", SOLVERS)
def test_the_wheels_tracks(data_dir: Path, name: str) -> None:
    """From rest through the take-off into the flight, without being told the start state."""
    truth = data_dir / "euroc_inertial" / "V1_01_easy"
    sequence = open_dataset("demo", groundtruth=truth)
    result = run(
        sequence, load_config(overrides=["final_ba.enabled=false"], algorithm=name, duration_s=16.0)
    )
    assert result.status == "ok"
    assert np.isfinite(result.history.sigmas()).all()
    reference = sequence.groundtruth()
    assert reference is not None
    error = ape(reference, result.trajectory, "trans_part", "se3").statistics.rmse
    assert error <= 0.020
