# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure: relative poses are right, roll and pitch stay, false loops stay out, drift goes."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from flight import rig, room
from loop_flights import CONFIG, tour, true_relative
from scipy.spatial.transform import Rotation
from test_rolling_shutter import FAST, rolling, rows_of

from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.loop_closure.loop_closing import LoopClosures, close_loops, correct_by
from slam_graph.loop_closure.loop_config import KeyframeConfig, VerificationConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe, KeyframeLog
from slam_graph.loop_closure.loop_pose_graph import level_graph, split_yaw
from slam_graph.loop_closure.loop_verification import (
    FLOOR_SIGMAS,
    SIGMA_PX,
    LoopVerifier,
    tilt_error,
)
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.optimize import optimize_pose_graph
from slam_graph.sensors import DepthSensor, FeatureFrame, FeatureObservations, Rig

Tour = tuple[Rig, list[Keyframe], Trajectory, Trajectory]


@pytest.fixture(scope="module")
def flown() -> Tour:
    return tour(seed=1)


@pytest.fixture(scope="module")
def closed(flown: Tour) -> LoopClosures:
    rig, keyframes, _, _ = flown
    return close_loops(keyframes, rig, CONFIG)


def test_loops_are_where_they_are_said_to_be(flown: Tour, closed: LoopClosures) -> None:
    _, keyframes, _, truth = flown
    assert len(closed.loops) >= 10
    for loop in closed.loops:
        error = gtsam.Pose3.localCoordinates(
            true_relative(keyframes, truth, loop.first, loop.second), loop.first_T_second
        )
        assert np.linalg.norm(error[:3]) < 0.027
        assert np.linalg.norm(error[3:]) < 0.1


def test_drift_goes(flown: Tour, closed: LoopClosures) -> None:
    _, _, drifting, truth = flown
    before = ape(truth, drifting, "trans_part", "yaw").statistics.rmse
    after = ape(truth, closed.correct(drifting), "trans_part", "yaw").statistics.rmse
    assert after < 0.5 * before


def test_roll_and_pitch_stay(flown: Tour, closed: LoopClosures) -> None:
    causal = np.array([k.world_T_body.rotation().matrix()[2] for k in flown[1]])
    np.testing.assert_allclose(closed.poses.rotations[:, 2], causal, atol=1e-9)


def test_keyframes_of_the_corrected_trajectory(flown: Tour, closed: LoopClosures) -> None:
    _, keyframes, drifting, _ = flown
    corrected = closed.correct(drifting)
    rows = np.searchsorted(corrected.stamps_ns, [k.stamp_ns for k in keyframes])
    np.testing.assert_allclose(corrected.positions[rows], closed.poses.translations, atol=1e-9)


def test_nothing_moves_without_loops(flown: Tour) -> None:
    rig, keyframes, drifting, _ = flown
    config = CONFIG.model_copy(update={"verification": VerificationConfig(min_inliers=10_000)})
    closures = close_loops(keyframes, rig, config)
    assert closures.loops == []
    np.testing.assert_array_equal(closures.correct(drifting).positions, drifting.positions)


def test_a_point_seen_again_is_where_it_was(flown: Tour) -> None:
    """The points of a keyframe, seen from the pose of another, give that pose."""
    rig, keyframes, _, _ = flown
    first, config = keyframes[20], VerificationConfig()
    rng = np.random.default_rng(0)
    mounted = rig.cameras[0]
    moved = gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.array([0.2, -0.1, 0.05]))
    known = np.isfinite(first.points).all(axis=1)
    body = (first.points - moved.translation()) @ moved.rotation().matrix()
    camera = mounted.body_T_camera
    seen = (body - camera.translation()) @ camera.rotation().matrix()
    rays = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, 1e-4, (len(seen), 2))
    wrong = np.flatnonzero(known)[:5]
    rays[wrong] += 0.3
    second = replace(first, normalized=rays, world_T_body=first.world_T_body.compose(moved))
    loop = LoopVerifier(mounted, config).verify([first, second], 0, 1)
    assert loop is not None
    assert known.sum() - 10 < loop.inliers <= known.sum() - 5
    error = gtsam.Pose3.localCoordinates(moved, loop.first_T_second)
    assert np.abs(error).max() < 2.3e-4


def logged(mounted: Rig, frames: list[FeatureFrame], poses: list[gtsam.Pose3]) -> Keyframe:
    """The last keyframe of some frames."""
    log = KeyframeLog(mounted, KeyframeConfig(angle_rad=0.3))
    for frame, pose in zip(frames, poses, strict=True):
        first = frame.cameras[0]
        first = replace(first, descriptors=np.zeros((len(first), 32), np.uint8))
        log.add(replace(frame, cameras=(first, *frame.cameras[1:])), pose)
    return log.keyframes[-1]


def test_rows_of_a_keyframe_are_seen_from_one_pose() -> None:
    """A rolling shutter, by poses alone: as a global one up to how rates change."""
    mounted, points = rolling(), room(300, np.random.default_rng(3))
    times = np.linspace(1.0, 1.5, 11).tolist()
    frames = [rows_of(FAST, mounted, points, t) for t in times]
    keyframe = logged(mounted, frames, [FAST.nav_state(t).world_T_body for t in times])
    exact = np.asarray(keyframe.world_T_body.transformTo(points[keyframe.ids].T)).T
    camera = mounted.cameras[0].body_T_camera
    local = np.asarray(camera.transformTo(exact.T)).T
    at_once = local[:, :2] / local[:, 2:]
    by_row = next(f for f in frames if f.stamp_ns == keyframe.stamp_ns).cameras[0].normalized
    known = np.isfinite(keyframe.points).all(axis=1)
    assert np.count_nonzero(known) > 20
    away = np.linalg.norm(keyframe.points - exact, axis=1)[known]
    assert np.median(away) < 0.02
    errors = np.linalg.norm(keyframe.normalized - at_once, axis=1)
    assert np.median(errors) < 0.1 * np.median(np.linalg.norm(by_row - at_once, axis=1))


def test_measured_depths_are_points_of_a_keyframe() -> None:
    """Of a camera that only turns, which triangulates nothing."""
    mounted = replace(rig(1), depth=DepthSensor())
    points, camera = room(300, np.random.default_rng(3)), mounted.cameras[0].body_T_camera
    frames, poses = [], []
    for k in range(5):
        turn = gtsam.Pose3(gtsam.Rot3.Rz(0.1 * k), np.zeros(3))
        poses.append(camera * turn * camera.inverse())  # about the axis of the camera
        local = np.asarray(poses[-1].compose(camera).transformTo(points.T)).T
        plane = local[:, :2] / local[:, 2:]
        ids = np.flatnonzero((np.abs(plane) < 0.4).all(axis=1) & (local[:, 2] > 0.5))
        depth = local[ids, 2]
        pixels = mounted.cameras[0].camera.distort(plane[ids])[0]
        sigma = DepthSensor().sigma_m(depth)
        seen = FeatureObservations(
            ids, pixels, plane[ids], depth_m=np.where(ids % 2, depth, np.nan), depth_sigma_m=sigma
        )
        frames.append(FeatureFrame((k + 1) * 10**8, (seen,)))
    keyframe = logged(mounted, frames, poses)
    known = np.isfinite(keyframe.points).all(axis=1)
    exact = np.asarray(keyframe.world_T_body.transformTo(points[keyframe.ids].T)).T
    assert known.sum() > 10
    np.testing.assert_array_equal(known, keyframe.ids % 2 == 1)
    np.testing.assert_allclose(keyframe.points[known], exact[known], atol=1e-6)


def test_a_tilted_loop_is_refused(flown: Tour) -> None:
    """What contradicts gravity is no loop, however well the points fit."""
    rig, keyframes, _, _ = flown
    first = keyframes[20]
    lying = gtsam.Pose3(
        gtsam.Rot3.Rx(0.2) * first.world_T_body.rotation(), first.world_T_body.translation()
    )
    verifier = LoopVerifier(rig.cameras[0], VerificationConfig())
    assert verifier.verify([first, first], 0, 1) is not None
    second = replace(first, world_T_body=lying)
    assert verifier.verify([first, second], 0, 1) is None
    assert verifier.verify([first, second], 0, 1, gravity=False) is not None
    assert tilt_error(first.world_T_body, lying, gtsam.Pose3()) == pytest.approx(0.2)


def test_covariance_of_a_loop_is_that_of_its_noise(flown: Tour) -> None:
    rig, keyframes, _, _ = flown
    first, mounted = keyframes[20], rig.cameras[0]
    config = VerificationConfig(max_error_px=40.0)
    verifier = LoopVerifier(mounted, config)
    camera = mounted.body_T_camera
    seen = (first.points - camera.translation()) @ camera.rotation().matrix()
    errors, covariances = [], []
    for seed in range(60):
        noise = np.random.default_rng(seed).normal(size=(len(seen), 2)) * SIGMA_PX / 458.0
        second = replace(first, normalized=seen[:, :2] / seen[:, 2:] + noise)
        loop = verifier.verify([first, second], 0, 1)
        assert loop is not None
        errors.append(gtsam.Pose3.Logmap(loop.first_T_second))
        covariances.append(loop.covariance)
    nees = [e @ np.linalg.solve(P, e) for e, P in zip(errors, covariances, strict=True)]
    # what is added to every covariance is not in this noise
    of_noise = [np.linalg.solve(P, P - np.diag(FLOOR_SIGMAS**2)) for P in covariances]
    expected = np.mean(np.trace(of_noise, axis1=1, axis2=2))
    assert abs(np.mean(nees) - expected) < 3.0 * np.sqrt(2.0 * expected / len(nees))


def test_false_loops_stay_out(flown: Tour, closed: LoopClosures) -> None:
    """Loops between other keyframes than were seen are rejected by the pose graph."""
    _, keyframes, drifting, truth = flown
    rng = np.random.default_rng(3)
    false = [
        replace(loop, first=int(a), second=int(b))
        for loop in closed.loops[:8]
        for a, b in [np.sort(rng.choice(len(keyframes), 2, replace=False))]
    ]
    mixed = correct_by(keyframes, [*closed.loops, *false], CONFIG)
    assert not mixed.accepted[len(closed.loops) :].any()
    before = ape(truth, closed.correct(drifting), "trans_part", "yaw").statistics.rmse
    after = ape(truth, mixed.correct(drifting), "trans_part", "yaw").statistics.rmse
    assert after == pytest.approx(before, rel=0.02)


def test_a_loop_between_consecutive_keyframes_is_no_odometry(
    flown: Tour, closed: LoopClosures
) -> None:
    """Of two keyframes in a row a true loop is kept, and a false one is rejected."""
    _, keyframes, _, _ = flown
    n = len(keyframes) // 2
    true = keyframes[n].world_T_body.between(keyframes[n + 1].world_T_body)
    away = gtsam.Pose3(gtsam.Rot3(), np.array([3.0, 0.0, 0.0]))
    for pose, kept in ((true, True), (true.compose(away), False)):
        loop = replace(closed.loops[0], first=n, second=n + 1, first_T_second=pose)
        assert correct_by(keyframes, [*closed.loops, loop], CONFIG).accepted[-1] == kept


def test_level_graphs_have_level_optima() -> None:
    rng, count = np.random.default_rng(0), 12
    yaw = np.linspace(0.0, 6.0, count)
    tilts = rng.uniform(-0.4, 0.4, (count, 2))
    angles = np.column_stack([yaw, tilts])
    rotations = Rotation.from_euler("ZYX", angles).as_matrix()
    truth = Poses(rotations, rng.normal(size=(count, 3)))
    i = np.r_[np.arange(count - 1), 0]
    j = np.r_[np.arange(1, count), count - 1]
    exact = truth.select(i).inverse().compose(truth.select(j))
    noise = Rotation.from_rotvec(0.01 * rng.normal(size=(count, 3))).as_matrix()
    measured = exact.compose(Poses(noise, 0.02 * rng.normal(size=(count, 3))))
    information = np.tile(np.diag([2500.0] * 3 + [1e4] * 3), (count, 1, 1))
    edges = np.column_stack([i, j])
    graph = level_graph(PoseGraph(np.arange(count), truth, edges, measured, information))
    poses = optimize_pose_graph(graph).poses
    np.testing.assert_allclose(poses.rotations[:, 2], np.tile([0, 0, 1.0], (count, 1)), atol=1e-3)
    # measurements without noise lead back to the truth
    graph = level_graph(PoseGraph(np.arange(count), truth, edges, exact, information))
    upright, rest = split_yaw(truth)
    poses = optimize_pose_graph(graph).poses.compose(rest)
    np.testing.assert_allclose(poses.rotations, truth.rotations, atol=1e-6)
    np.testing.assert_allclose(poses.translations, upright.translations, atol=1e-6)
