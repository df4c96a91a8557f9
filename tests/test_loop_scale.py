# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loops of one camera without an IMU: their scales, and the graph of similarities."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam_graph import run
from slam_graph.arrays import FloatArray
from slam_graph.evaluation import ape
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.loop_closure.loop_verification import Loop, LoopVerifier
from slam_graph.loop_closure.similarity_graph import correct_up_to_scale, loop_factor
from slam_graph.pose_graph import Poses
from slam_graph.simulation import simulate

CONFIG = LoopClosureConfig(enabled=True, degrees_of_freedom=6)
COUNT, LAP = 60, 30
SECOND_NS = 1_000_000_000


def true_poses() -> list[gtsam.Pose3]:
    """Two laps of a circle that rises and falls."""
    poses = []
    for k in range(COUNT):
        angle = 2 * np.pi * k / LAP
        place = np.array([5 * np.cos(angle), 5 * np.sin(angle), np.sin(2 * angle)])
        poses.append(gtsam.Pose3(gtsam.Rot3.Ypr(angle, 0.2 * np.sin(angle), 0.1), place))
    return poses


def drifted(poses: list[gtsam.Pose3], scales: FloatArray) -> list[gtsam.Pose3]:
    """The same composed along the way, in the unit of length of each time (N)."""
    found = [poses[0]]
    for k in range(len(poses) - 1):
        step = poses[k].between(poses[k + 1])
        moved = gtsam.Pose3(step.rotation(), step.translation() / scales[k])
        found.append(found[-1].compose(moved))
    return found


def loop_between(
    poses: list[gtsam.Pose3], scales: FloatArray, first: int, second: int, off: float = 0.0
) -> Loop:
    """An exact loop closure, in the unit of the first; its translation is wrong by `off` metres."""
    motion = poses[first].between(poses[second])
    shift = motion.translation() / scales[first] + off
    # one unit of the second is scales[second] metres
    scale = float(scales[second] / scales[first])
    pose = gtsam.Pose3(motion.rotation(), shift)
    return Loop(first, second, pose, 1e-4 * np.eye(6), 30, 40, np.zeros((0, 2), int), scale, 5e-3)


def test_a_drifted_scale_is_corrected_and_a_false_loop_refused() -> None:
    """The unit of length grows evenly by a third on the way; positions come back to 2 %."""
    truth, scales = true_poses(), np.exp(0.3 * np.arange(COUNT) / COUNT)
    estimate = drifted(truth, scales)
    loops = [loop_between(truth, scales, k, k + LAP) for k in range(0, LAP, 3)]
    loops.insert(4, loop_between(truth, scales, 2, 50, off=1.0))
    stamps = SECOND_NS * np.arange(COUNT)
    poses, found, kept = correct_up_to_scale(stamps, Poses.from_gtsam(estimate), loops, CONFIG)
    assert kept.tolist() == [k != 4 for k in range(len(loops))]
    assert found == pytest.approx(scales, rel=0.02)
    places = np.array([pose.translation() for pose in truth])
    before = np.linalg.norm(np.array([p.translation() for p in estimate]) - places, axis=1)
    after = np.linalg.norm(poses.translations - places, axis=1)
    assert before.max() > 1.0
    assert after.max() < 0.1


def test_without_drift_nothing_changes() -> None:
    truth, ones = true_poses(), np.ones(COUNT)
    loops = [loop_between(truth, ones, k, k + LAP) for k in range(0, LAP, 5)]
    stamps, exact = SECOND_NS * np.arange(COUNT), Poses.from_gtsam(truth)
    poses, scales, kept = correct_up_to_scale(stamps, exact, loops, CONFIG)
    assert kept.all()
    assert np.abs(scales - 1.0).max() < 1e-6
    assert np.abs(poses.translations - exact.translations).max() < 1e-5


class Break:
    """Where the trajectory begins again, in a world and a unit of length of its own."""

    begin_ns, joint_sigmas = 40 * SECOND_NS, (np.pi, 1000.0)


def test_a_segment_of_another_scale_is_joined() -> None:
    truth = true_poses()
    scales = np.where(np.arange(COUNT) < 40, 1.0, 2.5)
    estimate = drifted(truth, scales)
    elsewhere = gtsam.Pose3(gtsam.Rot3.Ypr(2.0, 0.3, 1.0), np.array([30.0, -10.0, 5.0]))
    estimate[40:] = [elsewhere.compose(pose) for pose in estimate[40:]]
    loops = [loop_between(truth, scales, k - LAP, k) for k in range(42, COUNT, 3)]
    stamps = SECOND_NS * np.arange(COUNT)
    poses, found, kept = correct_up_to_scale(
        stamps, Poses.from_gtsam(estimate), loops, CONFIG, [Break()]
    )
    assert kept.all()
    assert found == pytest.approx(scales, rel=5e-3)
    places = np.array([pose.translation() for pose in truth])
    assert np.abs(poses.translations - places).max() < 0.02


def test_the_factor_vanishes_at_the_truth_and_its_jacobian_is_the_numerical_one() -> None:
    truth, scales = true_poses(), np.exp(0.3 * np.arange(COUNT) / COUNT)
    factor, values, step = loop_factor(loop_between(truth, scales, 3, 35)), gtsam.Values(), 1e-6
    for k in (3, 35):
        local = truth[k].translation() / scales[k]
        values.insert(k, gtsam.Similarity3(truth[k].rotation(), local, float(scales[k])))
    assert np.abs(factor.whitenedError(values)).max() < 1e-9
    A, _ = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
    for column in range(14):
        key, e = (3, 35)[column // 7], np.eye(7)[column % 7]
        ends = []
        for sign in (step, -step):
            moved = gtsam.Values(values)
            moved.update(key, values.atSimilarity3(key).retract(sign * e))
            ends.append(np.asarray(factor.whitenedError(moved)))
        numerical = (ends[0] - ends[1]) / (2 * step)
        assert np.abs(A[:, column] - numerical).max() < 1e-4 * max(np.abs(numerical).max(), 1.0)


def test_depths_of_common_points_tell_the_scale() -> None:
    """Two keyframes of one place, the second in units that are a fifth longer."""
    rng, rig = np.random.default_rng(0), simulate(duration_s=2.0, cameras=1).rig
    count, unit = 60, 1.2
    camera = rig.cameras[0].body_T_camera
    seen = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 8, count)])
    world = np.asarray(camera.transformFrom(seen.T)).T
    motion = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.02, -0.05), np.array([0.2, -0.1, 0.1]))
    in_second = np.asarray(motion.transformTo(world.T)).T
    of_camera = np.asarray(camera.transformTo(in_second.T)).T
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    first = Keyframe(
        0, gtsam.Pose3(), np.arange(count), seen[:, :2] / seen[:, 2:], descriptors, world
    )
    second = replace(first, normalized=of_camera[:, :2] / of_camera[:, 2:], points=in_second / unit)
    verifier = LoopVerifier(rig.cameras[0], CONFIG.verification, has_scale=False)
    loop = verifier.verify([first, second], 0, 1, gravity=False)
    assert loop is not None
    assert loop.first_T_second.equals(motion, 1e-4)
    # lengths from the camera, which is not at the origin of the body
    assert loop.scale == pytest.approx(unit, rel=0.02)
    blind = replace(second, points=np.full((count, 3), np.nan))
    assert verifier.verify([first, blind], 0, 1, gravity=False) is None


@pytest.mark.slow
def test_loops_of_one_camera_correct_pose_and_scale() -> None:
    sequence = simulate(
        trajectory="rooms",
        duration_s=60.0,
        rate_hz=10.0,
        seed=1,
        cameras=1,
        with_imu=False,
        landmarks={"density": 4.0},
        tracks={"features": 80, "descriptors": True},
    )
    result = run(
        sequence, algorithm="msckf", final_ba={"enabled": False}, loop_closure={"enabled": True}
    )
    assert result.status == "ok"
    assert result.loops is not None
    assert result.loops.accepted.sum() >= 8
    assert result.loop_closed is not None
    errors = [
        ape(sequence.groundtruth(), path, alignment="sim3").statistics.rmse
        for path in (result.trajectory, result.loop_closed)
    ]
    assert errors[1] < 0.6 * errors[0]
