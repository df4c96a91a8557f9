# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects: the test of motion, segmentation, the engine in their frames, files, metrics."""

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED

from slam_graph.arrays import FloatArray
from slam_graph.backend import BackendConfig, Estimator, RigProjection
from slam_graph.backend.objects.ego_motion import EgoMotion, EgoWindow
from slam_graph.backend.objects.motion_segmentation import rigid_groups
from slam_graph.backend.objects.motion_test import MotionTest, Verdict, judge_tracks
from slam_graph.backend.objects.object_errors import motion_error, object_errors
from slam_graph.backend.objects.object_state import ObjectMotion, ObjectState
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.relative_motion import RelativeStep
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.config import load_config
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.streams.object_truth import (
    OBJECT_TRUTH,
    object_truth_file,
    read_object_truth,
)
from slam_graph.errors import DataError
from slam_graph.evaluation.detection import detection
from slam_graph.geometry import NavState, Trajectory
from slam_graph.pipeline import run
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, FeatureObservations, Rig
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulator import euroc_rig, simulate

RATE_HZ, FRAMES, SIGMA_PX = 10.0, 6, 0.5


def drawn_pose(rng: np.random.Generator, size: float = 1.0) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(size * rng.normal(size=6))


def stereo_frame(
    rig: Rig, stamp_ns: int, body: gtsam.Pose3, points: FloatArray, rng: np.random.Generator
) -> FeatureFrame:
    """Where the cameras see points (N, 3) of the world, with noise."""
    seen = []
    for mounted in rig.cameras:
        camera = body.compose(mounted.body_T_camera)
        local = np.asarray(camera.transformTo(points.T)).T
        pixels = mounted.camera.distort(local[:, :2] / local[:, 2:])[0]
        pixels = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
        ids = np.arange(len(points))
        seen.append(FeatureObservations(ids, pixels, mounted.camera.undistort(pixels)))
    return FeatureFrame(stamp_ns, tuple(seen))


def scattered(rig: Rig, count: int, rng: np.random.Generator) -> FloatArray:
    """Points (N, 3) two to six metres ahead of the first camera at the origin of the body."""
    depth = rng.uniform(2.0, 6.0, count)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.3, 0.3, count)])
    local = np.column_stack([rays, np.ones(count)]) * depth[:, None]
    return np.asarray(rig.cameras[0].body_T_camera.transformFrom(local.T)).T


def judged(
    velocities: FloatArray, rng: np.random.Generator, rate_error: float = 0.0
) -> tuple[MotionTest, FloatArray]:
    """The test of points with velocities (N, 3), by a platform that moves; and where they are.

    Args:
        velocities: m/s.
        rng: places and noise.
        rate_error: of the angular rate of the platform, and what is said of it, rad/s.
    """
    rig = euroc_rig()
    points = scattered(rig, len(velocities), rng)
    window = TrackWindow(rig, BackendConfig())
    error = rate_error * rng.normal(size=3)
    poses, stamps = [], []
    for k in range(FRAMES):
        seconds = (k - FRAMES + 1) / RATE_HZ
        body = gtsam.Pose3(gtsam.Rot3.Expmap([0.0, 0.0, 0.2 * seconds]), [0.3 * seconds, 0.0, 0.0])
        stamps.append(round((k + 1) * 1e9 / RATE_HZ))
        frame = stereo_frame(rig, stamps[-1], body, points + velocities * seconds, rng)
        window.add(frame, 0)
        wrong = gtsam.Pose3(gtsam.Rot3.Expmap(error * seconds), np.zeros(3))
        poses.append(wrong.compose(body))
    state = NavState(
        stamps[-1], poses[-1], np.zeros(3), accel_bias=np.zeros(3), gyro_bias=np.zeros(3)
    )
    ego = EgoMotion(
        tuple(stamps),
        tuple(poses),
        np.zeros((FRAMES, 3)),
        state,
        1e-8 * np.eye(3),
        max(rate_error, 1e-6) ** 2 * np.eye(3),
        np.zeros((6, 6)),
    )
    obs = window.observations(np.arange(len(points)), 3, stamps)
    result = judge_tracks(
        obs, RigProjection(rig), ego, SIGMA_PX, BackendConfig(), ObjectsConfig(false_alarm=1e-3)
    )
    return result, points


def test_static_points_are_seldom_called_moving() -> None:
    result, _ = judged(np.zeros((2000, 3)), np.random.default_rng(0))
    assert np.count_nonzero(result.verdicts == Verdict.MOVING) < 10
    assert np.median(result.probabilities) < 0.05


def test_errors_of_the_platform_are_not_taken_for_motion() -> None:
    """An angular rate that is 3°/s off moves points at 6 m by 0.3 m/s."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        result, _ = judged(np.zeros((300, 3)), rng, rate_error=0.05)
        assert np.mean(result.verdicts == Verdict.MOVING) < 0.02


def test_sideways_motion_is_found_and_its_velocity_right() -> None:
    rng = np.random.default_rng(2)
    across = euroc_rig().cameras[0].body_T_camera.rotation().rotate(np.array([0.5, 0.0, 0.0]))
    result, _ = judged(np.tile(across, (300, 1)), rng)
    assert np.mean(result.verdicts == Verdict.MOVING) > 0.95
    error = result.velocities - across
    nees = np.einsum(
        "ni,ni->n", error, np.linalg.solve(result.covariances, error[..., None])[..., 0]
    )
    assert 0.1 < np.mean(nees) / 3 < 1.2, "the allowance for drifting patches makes it small"


def test_it_cannot_tell_what_moves_slowly_along_the_ray() -> None:
    """At 5 m a stereo pair of 11 cm does not see 0.2 m/s along the ray within half a second."""
    rig, rng = euroc_rig(), np.random.default_rng(3)
    ahead = rig.cameras[0].body_T_camera.rotation().rotate(np.array([0.0, 0.0, 0.2]))
    result, points = judged(np.tile(ahead, (500, 1)), rng)
    far = np.linalg.norm(points, axis=1) > 4.5
    assert np.mean(result.verdicts[far] == Verdict.UNKNOWN) > 0.9
    assert not np.any(result.verdicts[far] == Verdict.STATIC)


def test_two_rigid_motions_are_two_groups() -> None:
    rig, rng = euroc_rig(), np.random.default_rng(4)
    middles = np.array([[-0.9, 0.0, 3.5], [0.9, 0.0, 3.5]])
    camera = rig.cameras[0].body_T_camera
    points = np.concatenate([m + rng.uniform(-0.4, 0.4, (20, 3)) for m in middles])
    moves = [
        gtsam.Pose3(gtsam.Rot3.Ry(0.1), [0.15, 0.0, 0.0]),
        gtsam.Pose3(gtsam.Rot3.Rx(-0.1), [0.0, 0.12, 0.05]),
    ]
    frames = []
    for k in range(2):
        moved = [
            np.asarray(moves[n].transformFrom((points[20 * n : 20 * n + 20] - m).T)).T + m
            if k
            else points[20 * n : 20 * n + 20]
            for n, m in enumerate(middles)
        ]
        world = np.asarray(camera.transformFrom(np.concatenate(moved).T)).T
        frames.append(stereo_frame(rig, k + 1, gtsam.Pose3(), world, rng))
    groups = rigid_groups(np.arange(40), frames, rig, 6, SIGMA_PX)
    assert len(groups) == 2
    for group in groups:
        sides = group // 20
        assert len(group) >= 16
        assert np.count_nonzero(sides == np.bincount(sides).argmax()) >= len(group) - 1


def test_motion_of_an_object_and_its_covariance() -> None:
    """M = Y₀ U Y₁⁻¹: by small errors of each, as the formula says."""
    rng = np.random.default_rng(5)
    before, now, ego, start = (drawn_pose(rng, 0.3) for _ in range(4))
    joint = np.diag(rng.uniform(0.5, 2.0, 12)) * 1e-12
    own = np.diag(rng.uniform(0.5, 2.0, 6)) * 1e-12
    motion = ObjectMotion.of(RelativeStep(0, 1, before, now, joint), start, ego, own)
    truth = start.compose(before).compose(ego).compose(start.compose(now).inverse())
    assert motion.motion.equals(truth, 1e-12)
    samples = []
    for _ in range(4000):
        errors = np.split(
            rng.normal(size=18)
            * np.sqrt(np.diag(np.block([[joint, np.zeros((12, 6))], [np.zeros((6, 12)), own]]))),
            3,
        )
        parts = [
            pose.retract(error) for pose, error in zip((before, now, ego), errors, strict=True)
        ]
        step = RelativeStep(0, 1, parts[0], parts[1], joint)
        drawn = ObjectMotion.of(step, start, parts[2], own)
        samples.append(gtsam.Pose3.Logmap(motion.motion.between(drawn.motion)))
    sampled = np.cov(np.array(samples).T)
    np.testing.assert_allclose(sampled, motion.covariance, rtol=0.15, atol=0.1 * sampled.max())


def test_motion_error_does_not_depend_on_the_frame_of_the_estimate() -> None:
    rng = np.random.default_rng(6)
    before, now, offset, error = (drawn_pose(rng) for _ in range(4))
    estimated = [pose.compose(offset) for pose in (before, now)]
    world = estimated[1].compose(estimated[0].inverse())
    assert motion_error(before, now, world).equals(gtsam.Pose3(), 1e-9)
    wrong = before.compose(before.between(now)).compose(error).compose(before.inverse())
    assert motion_error(before, now, wrong).equals(error, 1e-9)


def test_object_errors_count_switches_and_pose_drift() -> None:
    rng = np.random.default_rng(7)
    stamps = np.arange(1, 11, dtype=np.int64) * 10**8
    poses = [gtsam.Pose3(gtsam.Rot3.Rz(0.1 * k), [0.1 * k, 0.0, 3.0]) for k in range(10)]
    truth = {1: path_of(stamps, poses)}
    body = path_of(stamps, [gtsam.Pose3()] * 10)
    offset = drawn_pose(rng, 0.3)
    states = [
        seen_at(
            int(stamps[k]),
            4 if k < 6 else 5,
            poses[k].compose(offset),
            int(stamps[k - 1]),
            poses[k - 1].compose(offset),
        )
        for k in range(1, 10)
    ]
    found = object_errors(states, truth, body)
    assert found.switches == 1
    np.testing.assert_allclose(found.tangents, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.poses, 0.0, atol=1e-6)


def seen_at(
    stamp_ns: int, number: int, pose: gtsam.Pose3, before_ns: int, before: gtsam.Pose3
) -> ObjectState:
    step = ObjectMotion(before_ns, stamp_ns, before.between(pose), np.eye(6))
    return ObjectState(
        stamp_ns, number, 0, pose, np.eye(6), gtsam.Pose3(), step, np.zeros(3), np.eye(3), True, 20
    )


def path_of(stamps: Any, poses: list[gtsam.Pose3]) -> Trajectory:
    quaternions = []
    for pose in poses:
        quaternion: Any = pose.rotation().toQuaternion()
        quaternions.append(quaternion.coeffs())
    positions = np.array([pose.translation() for pose in poses])
    return Trajectory(stamps, positions, np.array(quaternions))


def test_detection_counts() -> None:
    moving = np.array([True, True, True, False, False])
    found = detection(np.array([0.9, 0.8, 0.2, 0.7, 0.1]), moving)
    assert found.precision == pytest.approx(2 / 3)
    assert found.recall == pytest.approx(2 / 3)
    assert found.area == pytest.approx(5 / 6), "of six pairs one is in the wrong order"


def test_true_poses_are_read_as_they_were_written(tmp_path: Path) -> None:
    stamps = np.array([1, 5], np.int64)
    truth = {3: path_of(stamps, [gtsam.Pose3(), drawn_pose(np.random.default_rng(8))])}
    (name, text), *_ = object_truth_file(truth).items()
    (tmp_path / name).write_text(text, encoding="utf-8")
    read = read_object_truth(tmp_path / OBJECT_TRUTH)
    np.testing.assert_allclose(read[3].positions, truth[3].positions, atol=1e-8)
    (tmp_path / name).write_text(text + text.splitlines()[-1] + "\n", encoding="utf-8")
    with pytest.raises(DataError, match="times of object 3"):
        read_object_truth(tmp_path / OBJECT_TRUTH)


# --- end to end ----------------------------------------------------------------------------------


def flight(**objects: Any) -> SimulatedSequence:
    """Eight seconds at 10 Hz with stereo tracks."""
    return simulate(
        duration_s=8.0, rate_hz=RATE_HZ, seed=0, tracks={"pixel_sigma": SIGMA_PX}, objects=objects
    )


def estimated(sequence: SimulatedSequence, **options: Any) -> RunResult:
    changes = ["objects.enabled=true", f"backend.noise.pixel_sigma={SIGMA_PX}", BELIEVED]
    return run(sequence, overrides=[*changes, "final_ba.enabled=false"], **options)


@pytest.fixture(scope="module")
def turning() -> RunResult:
    return estimated(flight(count=1))


def test_the_motion_of_an_object(turning: RunResult) -> None:
    found = turning.metrics["moving_objects"]["accuracy"]
    assert found["steps"] > 60
    assert found["median_motion_rotation_deg"] < 0.5
    assert found["median_motion_translation_m"] < 0.01
    assert found["motion_translation_m"] < 0.02
    assert 0.5 < found["nees"] < 2.0
    assert found["identity_switches"] == 0


def test_its_files(turning: RunResult, tmp_path: Path) -> None:
    files = {path.relative_to(tmp_path).as_posix() for path in turning.save(tmp_path)}
    assert {"objects.csv", "objects/1.tum", "objects/1.ply"} <= files
    lines = (tmp_path / "objects.csv").read_text(encoding="utf-8").splitlines()
    assert turning.objects is not None
    assert len(lines) == 1 + len(turning.objects.all_states())
    assert all(len(line.split(",")) == len(lines[0].split(",")) for line in lines)
    track = (tmp_path / "objects/1.tum").read_text(encoding="utf-8").splitlines()
    assert len([line for line in track if not line.startswith("#")]) == len(
        turning.objects.states(1)
    )


def test_the_platform_does_not_suffer(turning: RunResult) -> None:
    alone = run(flight(count=0), overrides={"backend.noise.pixel_sigma": SIGMA_PX}, duration_s=8.0)

    def error(result: RunResult) -> float:
        return float(result.metrics["accuracy"]["yaw"]["ate"]["translation_m"]["rmse"])

    assert error(turning) < 1.5 * error(alone) + 0.002


@pytest.mark.slow
def test_an_object_that_stops_is_known_to_stand() -> None:
    sequence = flight(count=1, motion="stop_and_go")
    result = estimated(sequence)
    assert result.objects is not None
    (body,) = sequence.bodies
    late = 0.5e9  # what began within the last half second may not be noticed yet
    verdicts = [
        (state.moving, body.standing(state.stamp_ns))
        for state in result.objects.all_states()
        if body.standing(state.stamp_ns) == body.standing(round(state.stamp_ns - late))
    ]
    assert len(verdicts) > 25
    assert np.mean([moving != standing for moving, standing in verdicts]) > 0.8


def test_nothing_is_found_where_nothing_moves() -> None:
    result = estimated(flight(count=0))
    assert result.objects is not None
    assert len(result.objects) == 0
    assert result.metrics["moving_objects"]["accuracy"] is None


def test_a_saved_recording_has_the_true_poses(tmp_path: Path) -> None:
    sequence = simulate(duration_s=1.0, rate_hz=5.0, objects={"count": 2})
    sequence.save(tmp_path / "flight")
    read = open_dataset(tmp_path / "flight")
    assert isinstance(read, RecordedSequence)
    truth = read.object_truth()
    assert truth.keys() == {1, 2}
    np.testing.assert_allclose(truth[1].positions, sequence.object_truth()[1].positions, atol=1e-7)


def test_the_window_of_the_platform_forgets_the_first_pose() -> None:
    """No image has corrected it."""
    config = load_config()
    sequence = flight(count=0)
    estimator = Estimator(sequence.rig, config.algorithm, config.backend)
    estimator.start(sequence.initial_state())
    window, seen = EgoWindow(0.5), []
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
        if state is not None:
            seen.append(window.add(packet.frame.stamp_ns, state, estimator))
        if len(seen) > 8:
            break
    assert seen[0] is None
    last = seen[-1]
    assert last is not None
    assert len(last.stamps_ns) == 6, "half a second at 10 Hz"
    assert np.all(np.linalg.eigvalsh(last.velocity_covariance) > 0)


@pytest.mark.slow
def test_images_of_a_rendered_object_show_its_motion() -> None:
    sequence = simulate(
        kind="images", duration_s=3.0, rate_hz=RATE_HZ, objects={"count": 1, "masks": True}
    )
    result = run(sequence, overrides={"objects.enabled": True, "final_ba.enabled": False})
    found = result.metrics["moving_objects"]["accuracy"]
    assert found["steps"] > 8
    assert found["median_motion_rotation_deg"] < 0.5
    assert found["median_motion_translation_m"] < 0.01
