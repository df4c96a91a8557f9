# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One camera without an IMU: the start by two views, and results that are up to scale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from groups import slow_but
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph import run
from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.unit_of_length import scale_direction
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.initialization.start_diagnosis import Refusal
from slam_graph.backend.initialization.two_views import TwoViews, two_view_motion
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dims_of
from slam_graph.config import algorithm_names
from slam_graph.errors import DataError
from slam_graph.evaluation import ape
from slam_graph.geometry import Similarity, Trajectory
from slam_graph.results import SavedRun
from slam_graph.sensors import Camera, FeatureFrame, FeatureObservations, Rig, RigCamera
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

OWN_START = "backend.initialization.mode=motion"
CAMERA = Camera(450.0, 450.0, 376.0, 240.0, "none", (), 752, 480)
MOUNTED = RigCamera(CAMERA, gtsam.Pose3(gtsam.Rot3.Expmap([0.2, -0.1, 0.3]), [0.05, 0.0, -0.02]))
SIGMA = 1.0 / 450.0
SECOND = gtsam.Pose3(gtsam.Rot3.Expmap([0.02, -0.05, 0.03]), np.array([0.6, -0.2, 0.1]))
"""first_T_second of two views."""


def simulated(**settings: Any) -> SimulatedSequence:
    """Tracks of a flight with one camera and without an IMU."""
    asked = {
        "with_imu": False, "cameras": 1, "duration_s": 8.0, "rate_hz": 10.0,
        "seed": 4, "trajectory": "random"
    }  # fmt: skip
    return simulate(**(asked | settings))


def rms_m(truth: Trajectory, estimate: Trajectory) -> float:
    """Root mean square position error after an alignment in rotation, position and scale."""
    return ape(truth, estimate, "trans_part", "sim3").statistics.rmse


# --- two views ----------------------------------------------------------------------------------


def views(
    points: FloatArray, first_T_second: gtsam.Pose3, noise: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """What two views see of points (N, 3) in the first one."""
    there = np.asarray(first_T_second.transformTo(points.T)).T
    seen = [local[:, :2] / local[:, 2:] for local in (points, there)]
    return seen[0] + np.asarray(noise), seen[1] - np.asarray(noise)


def room(rng: np.random.Generator, count: int = 100) -> FloatArray:
    """Points (N, 3) before a camera at depths of 2 to 8 m."""
    z = rng.uniform(2.0, 8.0, count)
    return np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)) * z[:, None], z])


def wall(rng: np.random.Generator, count: int = 100) -> FloatArray:
    """Points (N, 3) on a slanted plane before a camera."""
    m = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    return m * (4.0 / (m @ [0.5, 0.3, 1.0]))[:, None]


@pytest.mark.parametrize("place", [room, wall])
def test_two_views_give_rotation_and_direction(place: Any) -> None:
    points = place(np.random.default_rng(1))
    found = two_view_motion(*views(points, SECOND), SIGMA)
    if isinstance(found, Refusal):  # two motions explain a plane whose points both views see
        assert place is wall
        assert "two motions fit" in found.needs
        return
    assert found.model == ("essential" if place is room else "homography")
    direction = SECOND.translation() / np.linalg.norm(SECOND.translation())
    np.testing.assert_allclose(found.first_T_second.translation(), direction, atol=1e-5)
    assert found.first_T_second.rotation().equals(SECOND.rotation(), 1e-5)
    scale = np.linalg.norm(SECOND.translation())
    np.testing.assert_allclose(found.points * scale, points, rtol=1e-3)


def test_outliers_do_not_move_two_views() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 0.3 * SIGMA, (100, 2))
    noise[:20] += rng.uniform(-0.3, 0.3, (20, 2))
    found = two_view_motion(*views(room(rng), SECOND, noise), SIGMA)
    assert isinstance(found, TwoViews)
    assert np.count_nonzero(found.good[:20]) <= 3
    turn = found.first_T_second.rotation().between(SECOND.rotation())
    assert np.linalg.norm(gtsam.Rot3.Logmap(turn)) < 0.02


@pytest.mark.parametrize("degrees", [0.0, 2.0, 10.0])
def test_a_camera_that_only_turns_shows_no_depth(degrees: float) -> None:
    rng = np.random.default_rng(3)
    turned = gtsam.Pose3(
        gtsam.Rot3.Expmap(np.radians(degrees) * np.array([0.2, 0.9, 0.1])), [0] * 3
    )
    found = two_view_motion(*views(room(rng), turned, rng.normal(0, SIGMA, (100, 2))), SIGMA)
    assert isinstance(found, Refusal)
    assert "motion" in found.needs


def test_too_few_features_are_refused() -> None:
    found = two_view_motion(*views(room(np.random.default_rng(1), 12), SECOND), SIGMA)
    assert isinstance(found, Refusal)
    assert "12 so far" in found.needs


# --- the first state ----------------------------------------------------------------------------


@dataclass
class Walk:
    """A camera that looks at points while it moves; its frames, and where they were taken."""

    frames: list[FeatureFrame]
    poses: list[gtsam.Pose3]
    points: FloatArray


def walk(seed: int, turning: range = range(0), count: int = 60, speed: float = 0.6) -> Walk:
    """A walk sideways at 20 Hz; in some frames it only turns to and fro.

    Args:
        seed: of the noise of 1 px.
        turning: frames without translation.
        count: of frames.
        speed: in m/s.
    """
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [rng.uniform(-6, 6, 400), rng.uniform(-3, 3, 400), rng.uniform(3, 8, 400)]
    )
    frames, poses, place = [], [], 0.0
    for k in range(count):
        place += 0.0 if k in turning else speed / 20.0
        yaw = 0.15 * np.sin(0.25 * k)
        world_T_camera = gtsam.Pose3(
            gtsam.Rot3.Expmap([0.0, yaw, 0.0]),
            np.array([place, 0.1 * np.sin(2.0 * place), 0.2 * np.cos(1.5 * place)]),
        )
        local = np.asarray(world_T_camera.transformTo(points.T)).T
        pixels = 450.0 * local[:, :2] / local[:, 2:] + [376.0, 240.0]
        seen = (local[:, 2] > 0.5) & (pixels > 0).all(axis=1) & (pixels < [752, 480]).all(axis=1)
        ids = np.flatnonzero(seen)
        pixels = pixels[ids] + rng.normal(0.0, 1.0, (len(ids), 2))
        m = (pixels - [376.0, 240.0]) / 450.0
        frames.append(FeatureFrame(k * 50_000_000, (FeatureObservations(ids, pixels, m),)))
        poses.append(world_T_camera.compose(MOUNTED.body_T_camera.inverse()))
    return Walk(frames, poses, points)


def estimator() -> Estimator:
    """`msckf` for one camera without an IMU."""
    return Estimator(Rig((MOUNTED,), has_imu=False), AlgorithmConfig(name="msckf"), BackendConfig())


def test_the_start_is_as_certain_as_it_says() -> None:
    """Points relative to the camera, in units of the scale, are within their joint covariance."""
    squares = []
    for seed in range(5):
        taken, found = walk(seed), estimator()
        number = next(k for k, f in enumerate(taken.frames) if found.add_frame(f) is not None)
        window = found.window
        assert window is not None
        values, ids = window.state.estimate, window.state_features
        assert values.atPose3(X(window.frame)).equals(MOUNTED.body_T_camera.inverse(), 1e-9)
        # the world is that of the camera then
        camera = taken.poses[number].compose(MOUNTED.body_T_camera)
        true = np.asarray(camera.transformTo(taken.points[ids].T)).T
        estimated = np.array([values.atPoint3(L(j)) for j in ids.tolist()])
        inverse = [np.linalg.norm(p, axis=1) ** -1.0 for p in (true, estimated)]
        weights = inverse[1] / np.sum(inverse[1])
        ratio = 1.0 / np.sum(weights * inverse[0] / inverse[1])
        true *= 1.0 / ratio
        keys = [*map(L, ids.tolist())]
        covariance = window.prior.covariance_of(keys)
        error = (estimated - true).ravel()
        squares.append(error @ np.linalg.solve(covariance, error) / len(error))
    # each is a mean of some hundred squares of 1, less one for the scale
    assert 0.8 < np.mean(squares) < 1.2, squares


def test_images_do_not_change_when_the_world_is_scaled_about_the_path_of_the_camera() -> None:
    arm, centre, rate = np.array([0.3, -0.2, 0.1]), np.array([0.5, 1.0, -2.0]), np.ones(3) * 0.7
    values = gtsam.Values()
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.2, -0.4, 1.0])), np.array([1.0, 2.0, 3.0]))
    values.insert(X(0), pose)
    values.insert(V(0), np.array([0.3, -0.5, 0.2]))
    values.insert(B(0), gtsam.imuBias.ConstantBias(np.zeros(3), -rate))
    values.insert(L(0), np.array([4.0, -1.0, 2.0]))
    layout = Layout(dims_of([L(0), X(0), V(0), B(0)]))
    direction = scale_direction(values, layout, centre, arm)
    step = 1e-3
    moved = pose.retract(step * direction[layout.indices([X(0)])])
    point = values.atPoint3(L(0)) + step * direction[layout.indices([L(0)])]
    before = pose.transformTo(values.atPoint3(L(0))) - arm
    np.testing.assert_allclose(moved.transformTo(point) - arm, (1.0 + step) * before)
    turning = np.cross(rate, arm)
    velocity = values.atVector(V(0)) + step * direction[layout.indices([V(0)])]
    of_camera = pose.rotation().unrotate(values.atVector(V(0))) + turning
    np.testing.assert_allclose(
        moved.rotation().unrotate(velocity) + turning, (1.0 + step) * of_camera
    )


def test_a_camera_that_only_turns_waits_and_starts_when_it_moves() -> None:
    taken, found = walk(1, turning=range(40), count=90), estimator()
    states = [found.add_frame(frame) for frame in taken.frames[:40]]
    assert states == [None] * 40
    assert "motion" in found.waiting_for
    assert any(found.add_frame(frame) is not None for frame in taken.frames[40:])


def test_turning_on_the_spot_after_the_start_does_not_destroy_the_map() -> None:
    taken, found = walk(2, turning=range(40, 100), count=160), estimator()
    stamps, own, true = [], [], []
    for frame, pose in zip(taken.frames, taken.poses, strict=True):
        state = found.add_frame(frame)
        if state is not None:
            stamps.append(frame.stamp_ns)
            own.append(state.world_T_body)
            true.append(pose)
    positions = [np.array([pose.translation() for pose in poses]) for poses in (true, own)]
    assert len(own) > 120
    onto = Similarity.of_positions(positions[0], positions[1], "sim3")
    aligned = onto.scale * positions[1] @ onto.rotation.T + onto.translation
    assert np.sqrt(np.mean(np.sum((aligned - positions[0]) ** 2, axis=1))) < 0.03
    # the scale after the turn is that before it
    ratios = [
        np.linalg.norm(p[1][b] - p[1][a]) / np.linalg.norm(p[0][b] - p[0][a])
        for p, a, b in ((positions, 0, 25), (positions, -40, -1))
    ]
    assert ratios[1] / ratios[0] == pytest.approx(1.0, abs=0.1)


# --- whole runs ---------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", slow_but({"msckf"}, algorithm_names()))
def test_every_algorithm_runs_on_one_camera(algorithm: str) -> None:
    settings = ["final_ba.enabled=false", OWN_START]
    result = run(simulated(), algorithm=algorithm, overrides=settings)
    assert result.status == "ok", result.message
    assert rms_m(result.groundtruth, result.trajectory) < 0.03
    assert result.warnings["scale_unknown"] == 1


def test_results_are_up_to_scale_and_say_so(tmp_path: Path) -> None:
    result = run(simulated(), algorithm="msckf", overrides=[OWN_START])
    assert result.metrics["extent"]["scale"] == "unknown"
    assert result.metrics["extent"]["alignment"] == "sim3"
    assert result.smoothed is not None
    causal, smoothed = (rms_m(result.groundtruth, t) for t in (result.trajectory, result.smoothed))
    assert smoothed < 0.6 * causal
    for table in (result.metrics["accuracy"], result.metrics["final_ba"]["accuracy"]):
        assert table["sim3"]["ate"]["translation_m"]["rmse"] < 0.03
        assert all("scale is unknown" in table[m]["unavailable"] for m in ("none", "yaw", "se3"))
    assert result.metrics["nees"]["alignment"] == "first_pose_and_scale"
    result.save(tmp_path)
    assert (tmp_path / "trajectory.png").is_file()
    saved, camera = SavedRun(tmp_path), result.history.scaled_camera
    assert saved.scaled_camera is not None
    assert saved.scaled_camera.equals(camera, 1e-9)
    of_camera = rms_m(saved.groundtruth.mounted(camera), saved.trajectory.mounted(camera))
    reported = result.metrics["accuracy"]["sim3"]["ate"]["translation_m"]["rmse"]
    assert of_camera == pytest.approx(reported, rel=1e-6)


def test_the_unit_is_the_median_depth_that_is_asked_for() -> None:
    lengths = []
    for depth in (2.0, 6.0):
        asked = [OWN_START, "final_ba.enabled=false", f"backend.dynamics.median_depth={depth}"]
        result = run(simulated(duration_s=4.0), algorithm="msckf", overrides=asked)
        assert result.status == "ok", result.message
        lengths.append(np.linalg.norm(np.ptp(result.trajectory.positions, axis=0)))
    assert lengths[1] / lengths[0] == pytest.approx(3.0, rel=0.15)


def test_a_map_in_metres_is_refused() -> None:
    with pytest.raises(DataError, match="does not know the scale"):
        run(simulated(duration_s=2.0), algorithm="msckf", overrides=["map.enabled=true"])


@pytest.mark.slow
def test_a_real_camera_alone(data_dir: Path) -> None:
    result = run(
        data_dir / "euroc" / "MH_01_easy_17s",
        algorithm="msckf",
        cameras=1,
        duration_s=8.0,
        overrides=["backend.dynamics.model=constant_velocity"],
    )
    assert result.status == "ok", result.message
    assert rms_m(result.groundtruth, result.trajectory) < 0.03
    assert rms_m(result.groundtruth, result.smoothed) < 0.015
