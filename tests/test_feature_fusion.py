# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tracks of one point become one feature, others do not, and a drift is taken out by it."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.smoothing import segment_adjustment
from slam_graph.backend.smoothing.final_adjustment import adjust_recording
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.keyframe_states import states_at
from slam_graph.backend.smoothing.projected_matches import (
    Scene,
    consistent_matches,
    drift_jacobian,
    match_probabilities,
)
from slam_graph.backend.smoothing.recording_segment import read_segment, triangulated
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.backend.smoothing.smoothing_task import SegmentStart, SmoothingTask
from slam_graph.backend.smoothing.track_fusion import (
    fused_labels,
    relabelled,
    with_fused_features,
)
from slam_graph.datasets.sequence import Sequence
from slam_graph.errors import EstimationError
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.sensors.measurements import FeatureObservations
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulation_config import (
    FlightConfig,
    LandmarkConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

LENGTH_S = 40.0
BROKEN_EVERY_S = 5.0


def flight() -> SimulatedSequence:
    """Two rounds through a room; features keep the identity of their landmark."""
    return simulate(
        SimulationConfig(
            cameras=2,
            duration_s=LENGTH_S,
            rate_hz=5.0,
            flight=FlightConfig(hover_s=0.0),
            landmarks=LandmarkConfig(density=4.0),
            tracks=TrackConfig(features=60, keep_ids=True),
        )
    )


def broken(ids: np.ndarray, stamp_ns: int) -> np.ndarray:
    """Identities that are given anew from time to time; the landmark is what divides by 1000."""
    return ids * 1000 + int(stamp_ns * 1e-9 / BROKEN_EVERY_S)


@pytest.fixture(scope="module")
def sequence() -> SimulatedSequence:
    return flight()


@pytest.fixture(scope="module")
def log(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> FrameLog:
    folder: Path = tmp_path_factory.mktemp("frames")
    with FrameLog.recording(sequence.rig, FinalBaConfig(), folder) as log:
        for packet in sequence.packets():
            frame = packet.frame
            cameras = tuple(
                replace(seen, ids=broken(seen.ids, frame.stamp_ns)) for seen in frame.cameras
            )
            log.add(packet.imu, replace(frame, cameras=cameras), (1.0, 1.0))
    return log


def drifting(truth: Trajectory, metres: float, radians: float) -> Trajectory:
    """A trajectory that has turned and moved by so much at its end."""
    part = np.linspace(0.0, 1.0, len(truth))
    poses = [
        gtsam.Pose3(gtsam.Rot3.Yaw(radians * p), metres * p * np.array([0.6, -0.8, 0.3])).compose(
            truth.pose(k)
        )
        for k, p in enumerate(part.tolist())
    ]
    quaternions = [pose.rotation().toQuaternion().coeffs() for pose in poses]
    positions = np.array([pose.translation() for pose in poses])
    return replace(truth, positions=positions, quaternions=np.array(quaternions))


def scene_of(log: FrameLog, poses: Trajectory) -> Scene:
    backend = BackendConfig()
    segment = read_segment(log, log.keyframes, log.rig, backend.zero_velocity)
    seen = segment.seen_by_keyframes()
    seen = seen.subset(seen.counts > 3)
    rows = np.searchsorted(poses.stamps_ns, segment.keyframe_stamps_ns)
    matrices = np.array([poses.pose(int(row)).matrix() for row in rows])
    rotations, positions = matrices[:, :3, :3], matrices[:, :3, 3]
    projection = RigProjection(log.rig)
    points, usable = triangulated(seen, (rotations, positions), projection, backend)
    first = np.searchsorted(seen.feature, np.arange(len(seen.ids)))
    times_s = segment.keyframe_stamps_ns[seen.frame[first]] * 1e-9
    return Scene(seen, Geometry(rotations, positions, points), usable, times_s, projection, 1.0)


def check_disjoint(seen: Observations, label: np.ndarray) -> None:
    """No camera sees a feature twice in one frame."""
    together = relabelled(seen, label)
    rows = np.stack([together.feature, together.frame, together.camera], axis=1)
    assert len(np.unique(rows, axis=0)) == len(seen)


@pytest.mark.parametrize("drift", [(0.0, 0.0), (0.06, 0.01)], ids=["exact", "drifting"])
def test_what_is_fused_is_one_landmark(
    log: FrameLog, sequence: Sequence, drift: tuple[float, float]
) -> None:
    truth = sequence.groundtruth()
    assert truth is not None
    scene = scene_of(log, drifting(truth, *drift))
    label = fused_labels(scene)
    landmarks = scene.seen.ids // 1000
    joined = np.flatnonzero(label != np.arange(len(label)))
    right = landmarks[joined] == landmarks[label[joined]]
    copies = sum(count - 1 for count in Counter(landmarks.tolist()).values())
    assert right.mean() > 0.97
    assert right.sum() > 0.6 * copies
    check_disjoint(scene.seen, label)


def test_poses_that_are_off_by_more_than_the_reach_fuse_nothing_wrong(
    log: FrameLog, sequence: Sequence
) -> None:
    truth = sequence.groundtruth()
    assert truth is not None
    scene = scene_of(log, drifting(truth, 1.0, 0.2))
    label = fused_labels(scene)
    landmarks = scene.seen.ids // 1000
    joined = np.flatnonzero(label != np.arange(len(label)))
    wrong = np.sum(landmarks[joined] != landmarks[label[joined]])
    assert wrong <= 0.02 * len(label)


def test_fusion_takes_out_drift(log: FrameLog, sequence: Sequence) -> None:
    truth = sequence.groundtruth()
    assert truth is not None
    causal = drifting(truth, 0.06, 0.01)

    def error_m(config: FinalBaConfig) -> float:
        found = adjust_recording(
            log, causal, sequence.rig, BackendConfig(), config, lambda *_: None
        )
        return ape(truth, found.trajectory, "trans_part", "se3").statistics.rmse

    with_fusion, without = error_m(FinalBaConfig()), error_m(FinalBaConfig(fuse_features=False))
    assert with_fusion < 0.48 * without


@pytest.mark.parametrize("noisier", [1.0, 20.0])
def test_the_noise_of_the_imu_is_learned_with_the_fusion(
    log: FrameLog, sequence: Sequence, noisier: float
) -> None:
    """It is found where the accelerometer's bias walks faster than calibrated, and only there."""
    imu, truth = sequence.rig.imu, sequence.groundtruth()
    assert truth is not None
    quiet = replace(imu, accel_random_walk=imu.accel_random_walk / noisier)
    task = SmoothingTask.of(replace(sequence.rig, imu=quiet), BackendConfig(), FinalBaConfig())
    segment = read_segment(log, log.keyframes, task.rig, task.backend.zero_velocity)
    states = states_at(truth, segment.keyframe_stamps_ns, segment.imu, task.preintegration)
    found, _ = with_fused_features(SegmentStart(segment, states, 0), task, lambda *_: None)
    assert found.loose is not None
    assert (found.loose.noise.accel_walk > 2.0) == (noisier > 1.0)
    assert found.loose.given == states


def test_fused_observations_are_sorted_by_feature_frame_and_camera(log: FrameLog) -> None:
    task = SmoothingTask.of(log.rig, BackendConfig(), FinalBaConfig())
    seen = read_segment(log, log.keyframes, task.rig, task.backend.zero_velocity).seen
    label = np.arange(len(seen.ids))
    label[1::2] = label[::2][: len(label[1::2])] // 3  # every second one, with one far before it
    for table in (seen, relabelled(seen, label)):
        order = np.lexsort((table.camera, table.frame, table.feature))
        assert np.array_equal(table.feature, table.feature[order])
        assert np.array_equal(table.frame, table.frame[order])
        assert np.array_equal(table.camera, table.camera[order])
    assert len(relabelled(seen, label)) == len(seen)


def once(seen: FeatureObservations, stamp_ns: int) -> FeatureObservations:
    """Features that nothing else saw."""
    return replace(seen, ids=stamp_ns + np.arange(len(seen)))


def unseen(seen: FeatureObservations, stamp_ns: int) -> FeatureObservations:
    return FeatureObservations.empty()


@pytest.mark.parametrize("change", [once, unseen])
def test_without_tracks_there_is_nothing_to_adjust(
    sequence: Sequence,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    change: Callable[[FeatureObservations, int], FeatureObservations],
) -> None:
    truth = sequence.groundtruth()
    assert truth is not None
    with FrameLog.recording(sequence.rig, FinalBaConfig(), tmp_path) as log:
        for packet in islice(sequence.packets(), 50):
            frame = packet.frame
            cameras = tuple(change(seen, frame.stamp_ns) for seen in frame.cameras)
            log.add(packet.imu, replace(frame, cameras=cameras), (1.0, 1.0))
    with caplog.at_level("INFO"):
        smoothed = adjust_recording(
            log, truth, sequence.rig, BackendConfig(), FinalBaConfig(), lambda *_: None
        )
    assert smoothed is None
    assert "too few" in caplog.text


def test_points_that_are_nowhere_are_left_out(log: FrameLog, sequence: Sequence) -> None:
    truth = sequence.groundtruth()
    assert truth is not None
    scene = scene_of(log, truth)
    points, usable = scene.at.points.copy(), scene.usable.copy()
    points[5], usable[5] = np.nan, False
    label = fused_labels(replace(scene, at=replace(scene.at, points=points), usable=usable))
    assert label[5] == 5
    assert np.sum(label == 5) == 1
    assert np.sum(label != np.arange(len(label))) > 100


def test_tracks_are_adjusted_as_they_are_if_fusion_fails(
    log: FrameLog, sequence: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    causal = sequence.groundtruth()
    assert causal is not None

    def adjusted(config: FinalBaConfig) -> Trajectory:
        whole = adjust_recording(
            log, causal, sequence.rig, BackendConfig(), config, lambda *_: None
        )
        return whole.trajectory

    def refuse(*_: object) -> None:
        raise EstimationError("no minimum")

    monkeypatch.setattr(segment_adjustment, "with_fused_features", refuse)
    few = {"max_iterations": 2}
    found = adjusted(FinalBaConfig(**few))
    plain = adjusted(FinalBaConfig(fuse_features=False, **few))
    np.testing.assert_array_equal(found.positions, plain.positions)


def test_a_common_drift_is_found_among_wrong_matches() -> None:
    rng = np.random.default_rng(1)
    by_point, arms = rng.normal(0.0, 100.0, (20, 2, 3)), rng.normal(0.0, 3.0, (20, 3))
    J = drift_jacobian(by_point, arms)
    offsets = J @ [0.02, -0.03, 0.01, 0.005] + rng.normal(0.0, 0.3, (20, 2))
    offsets[12:] = rng.uniform(-10.0, 10.0, (8, 2))
    agree, left = consistent_matches(J, offsets, 3.0, 0.001, 1, rng)
    assert agree[:12].all()
    assert agree[12:].sum() <= 1
    assert np.all(np.linalg.norm(left[:12], axis=1) < 3.0)


def test_chance_agrees_on_no_drift() -> None:
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(200):
        count = int(rng.integers(3, 30))
        J = drift_jacobian(rng.normal(0.0, 100.0, (count, 2, 3)), rng.normal(0.0, 3.0, (count, 3)))
        radius, angle = 10.0 * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
        offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        agree, _ = consistent_matches(J, offsets, 3.0, 0.01, 200, rng)
        found += bool(agree.any())
    assert found <= 1


@pytest.mark.parametrize(
    ("share", "scatter", "least"),
    [(0.0, 0.0, 0.0), (0.25, 0.0, 0.4), (0.8, 0.0, 0.9), (0.0, 8.0, 0.0), (0.25, 8.0, 0.8)],
)
def test_probabilities_of_matches_are_their_frequencies(
    share: float, scatter: float, least: float
) -> None:
    """Sets of 40, of which some are true: of those that are believed few are false.

    With depths, which scatter among false ones, more can be believed.
    """
    rng = np.random.default_rng(3)
    reach, count = 10.0, 40
    found = wrong = expected = 0.0
    for _ in range(200):
        true = np.arange(count) < round(share * count)
        radius, angle = reach * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
        depths = scatter * rng.normal(size=count)
        false = np.stack([radius * np.cos(angle), radius * np.sin(angle), depths], axis=1)
        offsets = np.where(true[:, None], rng.normal(size=(count, 3)), false)
        known = offsets if scatter else offsets[:, :2]
        probabilities = match_probabilities(known, np.full(count, reach**-2.0))
        good = probabilities > 0.9
        found, wrong = found + np.sum(good & true), wrong + np.sum(good & ~true)
        expected += np.sum(1.0 - probabilities[good])
    # a set without true ones has now and then a few that are close by chance
    assert wrong <= 1.5 * expected + 0.005 * 200 * count
    # the fewer are true, the closer they must be
    assert found >= least * share * 200 * count


def test_no_matches_have_no_probabilities() -> None:
    assert match_probabilities(np.zeros((0, 3)), np.zeros(0)).shape == (0,)


def test_a_turn_about_the_vertical_is_what_its_derivative_says() -> None:
    arm, turn = np.array([[1.0, 2.0, 0.5]]), 1e-6
    J = drift_jacobian(np.eye(3)[None, :2], arm)
    moved = gtsam.Rot3.Yaw(turn).matrix() @ arm[0] - arm[0]
    np.testing.assert_allclose(J[0, :, 3], moved[:2] / turn, atol=1e-5)
