# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The front end on real stereo images of EuRoC MH_01, against the true motion."""

from collections.abc import Iterable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.frontend.frontend_protocol import build_frontend
from slam_graph.frontend.outliers import epipolar_distance, essential_matrix
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.sensors import ImuData
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, FeatureObservations
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.imu_consistent_path import at_imu_times, truth_delay_s

pytestmark = pytest.mark.data

FIRST_NS, LAST_NS = 1403636592613555456, 1403636593263555456
CORRUPT_NS = 1403636592913555456
GAP = 5


@pytest.fixture(scope="module")
def sequence(data_dir: Path) -> tuple[Rig, list[CameraFrame], Trajectory]:
    """Thirteen stereo pairs; the seventh has no right image, because its file is damaged."""
    recording = open_dataset(data_dir / "euroc" / "MH_01_easy_17s")
    frames = [packet.frame for packet in recording.packets(FIRST_NS, LAST_NS)]
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    truth, imu = recording.groundtruth(), ImuData.concatenate(list(recording.imu_blocks()))
    assert truth is not None
    assert recording.rig.imu is not None
    late_s = truth_delay_s(truth, imu, recording.rig.imu)
    return recording.rig, frames, at_imu_times(truth, late_s)


@pytest.fixture(scope="module")
def tracked(sequence: tuple[Rig, list[CameraFrame], Trajectory]) -> list[FeatureFrame]:
    rig, frames, _ = sequence
    frontend = build_frontend(rig)
    return [frontend.track(frame) for frame in frames]


def matches(
    a: FeatureObservations, b: FeatureObservations
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normalised coordinates of the features in both."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    return a.normalized[in_a], b.normalized[in_b]


def true_pose(truth: Trajectory, stamp_ns: int) -> gtsam.Pose3:
    nearest = int(np.argmin(np.abs(truth.stamps_ns - stamp_ns)))
    assert abs(int(truth.stamps_ns[nearest]) - stamp_ns) < 2_600_000
    return truth.pose(nearest)


def spread(frames: Iterable[FeatureFrame]) -> float:
    """Mean share of the cells of an 8 x 6 grid over the left image that hold a feature."""
    shares = []
    for frame in frames:
        u, v = frame.cameras[0].pixels.T
        shares.append(len(np.unique((u // 94).astype(int) + 8 * (v // 80).astype(int))) / 48)
    return float(np.mean(shares))


def test_tracks_fit_the_true_motion(
    sequence: tuple[Rig, list[CameraFrame], Trajectory], tracked: list[FeatureFrame]
) -> None:
    rig, _, truth = sequence
    body_T_camera = rig.cameras[0].body_T_camera
    errors_px = []
    for before, after in zip(tracked, tracked[GAP:], strict=False):
        world_T_a = true_pose(truth, before.stamp_ns) * body_T_camera
        world_T_b = true_pose(truth, after.stamp_ns) * body_T_camera
        E = essential_matrix(world_T_b.between(world_T_a))
        m_a, m_b = matches(before.cameras[0], after.cameras[0])
        assert len(m_a) > 100
        errors_px.append(epipolar_distance(E, m_a, m_b) * rig.cameras[0].camera.fx)
    error_px = np.concatenate(errors_px)
    # The ground truth's own error, some tenths of a degree and of a pixel, is in here
    assert np.median(error_px) < 0.6
    assert np.mean(error_px > 4.0) < 0.0016


def test_stereo_matches_fit_the_calibration(
    sequence: tuple[Rig, list[CameraFrame], Trajectory], tracked: list[FeatureFrame]
) -> None:
    rig, frames, _ = sequence
    left, right = rig.cameras
    E = essential_matrix(right.body_T_camera.between(left.body_T_camera))
    for frame, images in zip(tracked, frames, strict=True):
        if images.images[1] is None:
            continue
        m_left, m_right = matches(*frame.cameras)
        assert len(m_left) > 50
        assert np.median(epipolar_distance(E, m_left, m_right)) * left.camera.fx < 0.36


def test_features_are_many_spread_and_long_lived(tracked: list[FeatureFrame]) -> None:
    counts = [len(frame.cameras[0]) for frame in tracked]
    assert min(counts) > 150
    assert spread(tracked) > 0.8
    # The camera moves sideways by 300 px in these frames: only the left part stays in view
    first = tracked[0].cameras[0]
    stays = first.ids[first.pixels[:, 0] < 400]
    assert np.mean(np.isin(stays, tracked[-1].cameras[0].ids)) > 0.4


def test_the_corrupt_right_image_loses_no_left_track(
    sequence: tuple[Rig, list[CameraFrame], Trajectory], tracked: list[FeatureFrame]
) -> None:
    rig, frames, _ = sequence
    corrupt = [frame.stamp_ns for frame in frames].index(CORRUPT_NS)
    assert frames[corrupt].images[1] is None
    assert len(tracked[corrupt].cameras[1]) == 0
    left_only = build_frontend(rig.select(1))
    for frame, both in zip(frames, tracked, strict=True):
        alone = left_only.track(CameraFrame(frame.stamp_ns, frame.images[:1]))
        np.testing.assert_array_equal(alone.cameras[0].ids, both.cameras[0].ids)
    matched = [len(tracked[corrupt + step].cameras[1]) for step in (-1, 1)]
    assert matched[1] > 0.9 * matched[0]


def test_two_runs_are_the_same(
    sequence: tuple[Rig, list[CameraFrame], Trajectory], tracked: list[FeatureFrame]
) -> None:
    rig, frames, _ = sequence
    frontend = build_frontend(rig)
    for frame, before in zip(frames, tracked, strict=True):
        for seen, again in zip(before.cameras, frontend.track(frame).cameras, strict=True):
            np.testing.assert_array_equal(seen.ids, again.ids)
            np.testing.assert_array_equal(seen.pixels, again.pixels)
