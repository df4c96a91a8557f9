# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings without an IMU: constant velocity as dynamics, depth as a measurement, the gauge."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from groups import slow, slow_but
from scipy.spatial.transform import Rotation

from slam_graph import load_config, run
from slam_graph.backend.backend_config import BackendConfig, CalibrationConfig, DynamicsConfig
from slam_graph.backend.depth_camera import with_depth_camera, with_depth_observed
from slam_graph.backend.dynamics import Dynamics, model_rig, motionless_samples
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.visual_motion import VisualMotion, depths_within, pose_of_most
from slam_graph.backend.world_gauge import gauge_motion, with_unknown_gauge, world_motion
from slam_graph.config import algorithm_names
from slam_graph.datasets import open_dataset
from slam_graph.errors import ConfigError, DataError
from slam_graph.evaluation import ape
from slam_graph.frontend.image_rotation import ImageRotation
from slam_graph.geometry import NavState
from slam_graph.sensors import (
    Camera,
    DepthSensor,
    FeatureFrame,
    FeatureObservations,
    ImuData,
    Rig,
    RigCamera,
)
from slam_graph.sensors import rig as sensors_rig
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

OWN_START = "backend.initialization.mode=motion"
"""Not the state that comes with a simulation."""
CAMERA = Camera(500.0, 510.0, 320.0, 240.0, "none", (), 640, 480)


def simulated(**settings: Any) -> SimulatedSequence:
    """Tracks of a flight without an IMU."""
    asked = {"with_imu": False, "duration_s": 8.0, "rate_hz": 10.0, "seed": 3}
    asked["trajectory"] = "random"
    return simulate(**(asked | settings))


# --- dynamics -----------------------------------------------------------------------------------


@pytest.mark.parametrize("seconds", [0.02, 0.1, 0.5])
def test_constant_velocity_has_the_covariance_of_white_noise_on_acceleration(
    seconds: float,
) -> None:
    config = DynamicsConfig(accel_density=2.0, angular_accel_density=3.0)
    rig = model_rig(Rig((RigCamera(CAMERA, gtsam.Pose3()),)), config)
    until = motionless_samples(0, round(seconds * 1e9))
    samples = ImuData.concatenate([motionless_samples(None, 0), until])
    params = rig.imu.preintegration_params(0.0)
    found = samples.preintegrated(gtsam.imuBias.ConstantBias(), params).preintMeasCov()
    rotation, position, velocity, rate = (np.diag(found)[rows] for rows in (0, 3, 6, 12))
    assert position == pytest.approx(2.0**2 * seconds**3 / 3.0, rel=0.01)
    assert velocity == pytest.approx(2.0**2 * seconds, rel=1e-6)
    assert found[3, 6] == pytest.approx(2.0**2 * seconds**2 / 2.0, rel=0.01)
    assert rate == pytest.approx(3.0**2 * seconds, rel=1e-3)
    assert rotation == pytest.approx(3.0**2 * seconds**3 / 3.0, rel=0.1)


@pytest.mark.parametrize("algorithm", ["msckf", "fixed_lag_isam2"])
@pytest.mark.parametrize("given", [(), ("backend.gating.robust_loss=huber",)])
def test_settings_that_are_written_mean_the_same_when_they_are_read(
    algorithm: str, given: tuple[str, ...], tmp_path: Path
) -> None:
    """What is not given follows from the sensors, and is not given in a file of all settings."""
    config = load_config(algorithm, given)
    written = tmp_path / "config.yaml"
    written.write_text(config.as_yaml())
    rig = simulate(with_imu=False, cameras=2, duration_s=1.0).rig
    used = [Dynamics.of(rig, one.algorithm, one.backend) for one in (config, load_config(written))]
    assert used[0].config.gating.loss == ("huber" if given else "cauchy")
    for part in ("config", "algorithm"):
        first, second = (getattr(dynamics, part).model_dump() for dynamics in used)
        assert first == second


def test_a_body_that_keeps_its_velocities_is_predicted_exactly() -> None:
    rig = model_rig(Rig((RigCamera(CAMERA, gtsam.Pose3()),)), DynamicsConfig())
    rate, velocity = np.array([0.3, -0.8, 1.1]), np.array([1.0, 2.0, -0.5])
    state = NavState(
        0, gtsam.Pose3(), velocity, accel_bias=np.zeros(3), gyro_bias=-rate, covariance=None
    )
    samples = ImuData.concatenate([motionless_samples(None, 0), motionless_samples(0, 10**8)])
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), -rate)
    pim = samples.preintegrated(bias, rig.imu.preintegration_params(0.0))
    later = state.predicted(pim, 10**8)
    expected = gtsam.Pose3(gtsam.Rot3.Expmap(0.1 * rate), 0.1 * velocity)
    assert later.world_T_body.equals(expected, 1e-9)
    np.testing.assert_allclose(later.velocity, velocity, atol=1e-12)


def test_dynamics_are_those_that_the_recording_has() -> None:
    rig, algorithm = Rig((RigCamera(CAMERA, gtsam.Pose3()),)), AlgorithmConfig(name="swf")
    assert Dynamics.of(rig, algorithm, BackendConfig()).rig is rig
    without = Dynamics.of(replace(rig, has_imu=False), algorithm, BackendConfig())
    assert not without.rig.has_imu
    assert without.config.noise.gravity == 0.0
    wanted = BackendConfig(dynamics=DynamicsConfig(model="imu"))
    with pytest.raises(ConfigError, match="has no IMU; use constant_velocity"):
        Dynamics.of(replace(rig, has_imu=False), algorithm, wanted)
    offset = BackendConfig(calibration=CalibrationConfig(time_offset=True))
    with pytest.raises(ConfigError, match="time_offset compares cameras with an IMU"):
        Dynamics.of(replace(rig, has_imu=False), algorithm, offset)


# --- whole runs ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "algorithm",
    slow_but({"msckf"}, [name for name in algorithm_names() if name != "isam2"]),
)
def test_every_algorithm_runs_on_stereo_without_an_imu(algorithm: str) -> None:
    recording = simulated(cameras=2)
    result = run(recording, algorithm=algorithm, overrides=["final_ba.enabled=false", OWN_START])
    assert result.status == "ok", result.message
    assert result.coverage > 0.98
    assert result.metrics["extent"]["alignment"] == "se3"
    assert ape(result.groundtruth, result.trajectory, "trans_part", "se3").statistics.rmse < 0.05


@pytest.mark.parametrize("depth", ["stereo", slow("kinect")])
def test_a_depth_sensor_takes_the_place_of_a_second_camera(depth: str) -> None:
    recording = simulated(cameras=1, depth={"sensor": depth})
    result = run(recording, algorithm="msckf", overrides=[OWN_START])
    assert result.status == "ok", result.message
    assert result.smoothed is not None
    causal = ape(result.groundtruth, result.trajectory, "trans_part", "se3").statistics.rmse
    smoothed = ape(result.groundtruth, result.smoothed, "trans_part", "se3").statistics.rmse
    assert smoothed < causal < 0.009
    assert smoothed < 0.006


@pytest.mark.slow
def test_what_is_known_without_an_imu_is_what_the_covariance_says() -> None:
    values = []
    for seed in range(6):
        recording = simulated(cameras=2, seed=seed)
        result = run(recording, algorithm="msckf", overrides=[OWN_START])
        table = result.metrics["final_ba"]["nees"]
        assert table["alignment"] == "first_pose"
        values.append([table[name]["mean"] for name in ("orientation", "position")])
    # 3 is ideal; the states of a run are correlated, so six runs are six samples of 3 each
    assert (np.mean(values, axis=0) < 7.0).all(), values
    assert (np.mean(values, axis=0) > 1.0).all(), values


@pytest.mark.slow
def test_a_recording_with_an_imu_can_be_run_without_it(data_dir: Path) -> None:
    result = run(
        data_dir / "euroc" / "MH_01_easy_17s",
        algorithm="msckf",
        cameras=2,
        duration_s=8.0,
        overrides=["backend.dynamics.model=constant_velocity"],
    )
    assert result.status == "ok", result.message
    assert ape(result.groundtruth, result.trajectory, "trans_part", "se3").statistics.rmse < 0.015
    assert ape(result.groundtruth, result.smoothed, "trans_part", "se3").statistics.rmse < 0.01


def test_a_real_rgbd_recording_is_run(data_dir: Path) -> None:
    result = run(data_dir / "tum_rgbd" / "freiburg1_rpy_12s", algorithm="msckf", duration_s=3.0)
    assert result.status == "ok", result.message
    assert result.coverage > 0.9
    assert ape(result.groundtruth, result.trajectory, "trans_part", "se3").statistics.rmse < 0.05


# --- depth --------------------------------------------------------------------------------------


def test_depth_has_the_noise_of_its_sensor() -> None:
    sensor = DepthSensor.kinect(5000.0)
    rig = Rig((RigCamera(CAMERA, gtsam.Pose3()),), has_imu=False, depth=sensor)
    both = with_depth_camera(rig)
    assert len(both.cameras) == 2
    z = 2.0
    point = np.array([0.3, -0.2, z])
    beside = both.cameras[1]
    local = beside.body_T_camera.transformTo(point)
    J = []  # of the four coordinates by the point, in pixels
    for mounted, p in ((both.cameras[0], point), (beside, local)):
        x, y, depth = p
        f = np.array([mounted.camera.fx, mounted.camera.fy])
        J.append(f[:, None] * np.array([[1, 0, -x / depth], [0, 1, -y / depth]]) / depth)
    covariance = np.linalg.inv(np.vstack(J).T @ np.vstack(J))
    expected = float(sensor.sigma_m(np.array([z]))[0])
    assert expected < np.sqrt(covariance[2, 2]) < 2.5 * expected
    # the pixel counts once: its own noise is nearly that of one observation
    assert np.sqrt(covariance[1, 1] * (500.0 / z) ** 2) == pytest.approx(1.0, abs=0.1)


def test_features_with_a_depth_are_where_it_says() -> None:
    rig = Rig((RigCamera(CAMERA, gtsam.Pose3()),), has_imu=False, depth=DepthSensor())
    m = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 2))
    z = np.random.default_rng(2).uniform(0.8, 5.0, 20)
    z[3] = np.nan
    pixels = m * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    seen = FeatureObservations(np.arange(20), pixels, m, None, z, rig.depth.sigma_m(z))
    frame = with_depth_observed(FeatureFrame(0, (seen,)), rig)
    known = depths_within(frame, with_depth_camera(rig))
    assert 3 not in known.ids
    assert len(known.ids) == 19
    assert known.located.all()
    expected = np.column_stack([m, np.ones(20)]) * z[:, None]
    np.testing.assert_allclose(known.points, expected[known.ids], rtol=1e-6)


def test_features_without_parallax_are_directions() -> None:
    """Their disparity is smaller than its noise, or has the wrong sign."""
    rig = simulate(cameras=2, duration_s=1.0, with_imu=False).rig
    ids, m = np.arange(30), np.random.default_rng(1).uniform(-0.3, 0.3, (30, 2))
    rays = np.column_stack([m, np.ones(30)])
    depths = np.where(ids < 20, np.linspace(1.0, 5.0, 30), 1e6)
    body = np.asarray(rig.cameras[0].body_T_camera.transformFrom((rays * depths[:, None]).T)).T
    seen = []
    for mounted in rig.cameras:
        local = np.asarray(mounted.body_T_camera.transformTo(body.T)).T
        pixels = mounted.camera.project(local)
        if seen:
            pixels[25:, 0] += 1.0
        seen.append(FeatureObservations(ids, pixels, mounted.camera.undistort(pixels)))
    known = depths_within(FeatureFrame(0, tuple(seen)), rig)
    np.testing.assert_array_equal(known.ids, ids)
    np.testing.assert_array_equal(known.located, ids < 20)
    np.testing.assert_allclose(known.points[:20], body[:20], rtol=1e-5)
    local = np.asarray(rig.cameras[0].body_T_camera.transformTo(known.points.T)).T
    assert np.all(local[20:, 2] > 20.0)
    np.testing.assert_allclose(local[:, :2] / local[:, 2:], m, atol=2e-3)


# --- images and gauge ---------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [(0, 0, 0), (3, -6, 2), (-6, 7, -5)])
def test_the_rotation_between_two_images_is_found(degrees: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (960, 1280)).astype(np.float32), (0, 0), 12)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    after_R_before = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    middle = np.array([[1.0, 0, -320], [0, 1, -240], [0, 0, 1]])
    before = cv2.warpPerspective(texture, middle, (640, 480))
    after = cv2.warpPerspective(texture, K @ after_R_before @ np.linalg.inv(K) @ middle, (640, 480))
    found = Rotation.from_matrix(ImageRotation(CAMERA).between(before, after))
    difference = found * Rotation.from_matrix(after_R_before).inv()
    assert np.degrees(difference.magnitude()) < 0.25


@pytest.mark.parametrize("with_imu", [False, True])
def test_rows_of_a_rolling_shutter_are_undone_where_images_show_the_motion(with_imu: bool) -> None:
    """A body that turns; the prediction says that it does not, as where samples are missing."""
    rig = simulate(cameras=1, duration_s=1.0).rig
    mounted = replace(rig.cameras[0], readout_s=0.02, rolling_shutter=True)
    rig = replace(rig, cameras=(mounted,), has_imu=with_imu)
    rate, step_ns = np.array([0.3, -0.8, 0.5]), 50_000_000
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(rate * step_ns * 1e-9), np.zeros(3))
    rng = np.random.default_rng(4)
    camera = mounted.camera
    z = rng.uniform(2.0, 6.0, 80)
    m = rng.uniform(-0.35, 0.35, (80, 2))
    local = np.asarray(mounted.body_T_camera.transformFrom(np.column_stack([m, 0 * z + 1]).T * z))
    points = np.asarray(pose.transformFrom(local)).T
    pixels = camera.project(np.column_stack([m, np.ones(80)]))
    for _ in range(8):  # the row tells the time, and the pose at this time the row
        late = mounted.row_times_s(pixels[:, 1]) - mounted.middle_s
        turned = [
            pose.compose(gtsam.Pose3(gtsam.Rot3.Expmap(rate * s), np.zeros(3)))
            .compose(mounted.body_T_camera)
            .transformTo(point)
            for s, point in zip(late, points, strict=True)
        ]
        pixels = camera.project(np.array(turned))
    ids = np.arange(80)
    frame = FeatureFrame(step_ns, (FeatureObservations(ids, pixels, camera.undistort(pixels)),))
    none = np.zeros(3)
    before = NavState(0, gtsam.Pose3(), none, accel_bias=none, gyro_bias=none)
    predicted = replace(before, stamp_ns=step_ns)
    found = VisualMotion(rig, 10).corrected(before, predicted, (None, frame), (ids, points))
    turn = gtsam.Rot3.Logmap(found.world_T_body.rotation().between(pose.rotation()))
    assert np.linalg.norm(turn) < 2e-4
    assert np.linalg.norm(found.world_T_body.translation()) < 1e-3


def test_the_motion_is_that_of_most_points_also_where_others_are_near() -> None:
    """The near ones have moved: a motion between the two is within 4 px of nearly all of them."""
    rng, mounted = np.random.default_rng(2), RigCamera(CAMERA, gtsam.Pose3())
    far = rng.uniform([-3, -2, 2], [3, 2, 16], (90, 3))
    near = rng.uniform([-0.4, -0.4, 2.5], [0.4, 0.4, 3.2], (40, 3))
    seen = np.vstack([far, near + np.array([0.06, 0.0, 0.0])])
    rays = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, 0.3 / CAMERA.fx, (130, 2))
    solved = pose_of_most(mounted, np.vstack([far, near]), rays)
    assert solved is not None
    assert np.linalg.norm(solved.world_T_body.translation()) < 0.008
    assert np.mean(solved.fits[:90]) > 0.9
    assert np.mean(solved.fits[90:]) < 0.1


def test_a_guess_leads_where_samples_of_points_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """From one that is near no samples are drawn; from one that is not they still are."""
    rng, mounted = np.random.default_rng(3), RigCamera(CAMERA, gtsam.Pose3())
    points = rng.uniform([-3, -2, 2], [3, 2, 16], (120, 3))
    pose = gtsam.Pose3(gtsam.Rot3.Expmap([0.01, -0.02, 0.015]), np.array([0.04, -0.02, 0.03]))
    seen = np.asarray(pose.transformTo(points.T)).T
    rays = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, 0.3 / CAMERA.fx, (120, 2))
    rays[:30] += 5.0 / CAMERA.fx
    sampled = pose_of_most(mounted, points, rays)
    draws = []
    drawn = sensors_rig.camera_pose
    monkeypatch.setattr(sensors_rig, "camera_pose", lambda *a: draws.append(a) or drawn(*a))
    far = gtsam.Pose3(gtsam.Rot3.Expmap([0.0, 2.0, 0.0]), np.zeros(3))
    for guess, draws_samples in (gtsam.Pose3(), False), (far, True):
        found = pose_of_most(mounted, points, rays, guess=guess)
        assert found is not None
        assert sampled is not None
        assert found.world_T_body.equals(sampled.world_T_body, 1e-4)
        assert found.fits[30:].all()
        assert bool(draws) == draws_samples


def test_a_box_that_begins_to_move_does_not_pull_two_cameras() -> None:
    """It is near: it has many of the features whose depth is known, and tells the translation."""
    flight = {"duration_s": 8.0, "rate_hz": 10.0, "cameras": 2, "tracks": {"pixel_sigma": 0.5}}
    sequence = simulate(**flight, seed=9, objects={"count": 1}, with_imu=False)
    overrides = ["final_ba.enabled=false", "backend.noise.pixel_sigma=0.5", OWN_START]
    result = run(sequence, algorithm="msckf", overrides=overrides)
    assert result.status == "ok"
    assert ape(result.groundtruth, result.trajectory, "trans_part", "se3").statistics.rmse < 0.025


def test_a_camera_is_found_by_points_that_it_sees_and_outliers_are_named() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform([-2, -2, 3], [2, 2, 8], (40, 3))
    camera_T_world = gtsam.Pose3(gtsam.Rot3.Expmap([0.1, -0.2, 0.05]), np.array([0.2, 0.1, -0.3]))
    seen = np.asarray(camera_T_world.transformFrom(points.T)).T
    rays = seen[:, :2] / seen[:, 2:]
    rays[:6] += 0.2
    body_T_camera = gtsam.Pose3(gtsam.Rot3.Expmap([0.3, 0.1, -0.7]), np.array([0.1, 0.0, 0.05]))
    found = RigCamera(CAMERA, body_T_camera).body_pose(points, rays, 2.5)
    assert found is not None
    assert found[0].compose(body_T_camera).inverse().equals(camera_T_world, 1e-6)
    assert not found[1][:6].any()
    assert found[1][6:].all()


@pytest.mark.parametrize("level", [True, False])
def test_the_gauge_moves_poses_as_the_world_moves(level: bool) -> None:
    pose = gtsam.Pose3(gtsam.Rot3.Expmap([0.4, -0.2, 0.9]), np.array([1.0, -2.0, 0.5]))
    arm = pose.translation()
    motion = gauge_motion(arm[None], level)[0]
    for k in range(motion.shape[1]):
        step = np.zeros(6)
        step[[3, 4, 5, 2] if level else [3, 4, 5, 0, 1, 2]] = np.eye(motion.shape[1])[k] * 1e-6
        world = gtsam.Pose3(gtsam.Rot3.Expmap(step[:3]), step[3:])
        moved = world.compose(pose)
        turn = gtsam.Rot3.Logmap(moved.rotation().compose(pose.rotation().inverse()))
        shift = moved.translation() - pose.translation()
        np.testing.assert_allclose(np.concatenate([turn, shift]) / 1e-6, motion[:, k], atol=1e-5)
    other = gtsam.Pose3(gtsam.Rot3.Expmap([0.1, 0.3, -0.5]), np.array([3.0, 1.0, 2.0]))
    to = world_motion(pose, other, level).compose(pose)
    np.testing.assert_allclose(to.translation(), other.translation(), atol=1e-12)
    assert to.equals(other, 1e-9) is (not level)


def test_what_is_not_known_of_the_rotation_of_a_world_is_added_about_all_axes() -> None:
    state = NavState(
        0,
        gtsam.Pose3(gtsam.Rot3(), np.array([10.0, 0.0, 0.0])),
        np.array([1.0, 0.0, 0.0]),
        accel_bias=np.zeros(3),
        gyro_bias=np.zeros(3),
        covariance=np.zeros((15, 15)),
    )
    unknown = np.diag([0.0, 0.0, 0.0, 0.0, 0.01**2, 0.0])  # about y
    P = with_unknown_gauge(state, unknown, np.zeros(3)).covariance
    assert P is not None
    np.testing.assert_allclose(np.diag(P)[:9], [0, 1e-4, 0, 0, 0, 1e-2, 0, 0, 1e-4], atol=1e-12)


def test_a_recording_that_has_an_imu_says_so(data_dir: Path) -> None:
    sequence = open_dataset(data_dir / "tum_rgbd" / "freiburg1_rpy_12s")
    assert not sequence.info().has_imu
    with pytest.raises((ConfigError, DataError), match="no IMU"):
        run(sequence, overrides=["backend.dynamics.model=imu"])
