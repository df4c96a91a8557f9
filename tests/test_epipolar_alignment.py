# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Clock and mounting by epipolar errors: exact without noise, and where two views are ambiguous."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from flight import Flight, packets, rig, room
from groups import slow

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.initialization.epipolar_alignment import align_by_epipolar_errors
from slam_graph.backend.initialization.gyro_alignment import GyroAlignment
from slam_graph.config import load_config
from slam_graph.datasets import open_dataset
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.evaluation import ape
from slam_graph.geometry import NavState, StateHistory
from slam_graph.sensors import FeatureFrame, ImuBuffer, RigCamera
from slam_graph.sensors.camera import Camera
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence


def seen(offset_s: float, seconds: float = 4.0) -> tuple[list[FeatureFrame], ImuBuffer]:
    """Frames whose stamps are off, and the samples of the IMU."""
    rng, imu, frames = np.random.default_rng(2), ImuBuffer(), []
    for packet in packets(Flight(), rig(), 0.5 * room(300, rng), seconds, rng, 20.0):
        imu.add(packet.imu)
        assert isinstance(packet.frame, FeatureFrame)
        stamp_ns = packet.frame.stamp_ns - round(offset_s * 1e9)
        frames.append(FeatureFrame(stamp_ns, packet.frame.cameras))
    return frames, imu


def turned(by_deg: float) -> FloatArray:
    """A mounting that is off."""
    axis = np.deg2rad(by_deg) * np.array([0.6, 0.8, 0.0])
    return (
        np.asarray(rig().cameras[0].body_T_camera.rotation().matrix())
        @ gtsam.Rot3.Expmap(axis).matrix()
    )


def angle(one: FloatArray, two: FloatArray) -> float:
    """Between two rotations (3, 3), rad."""
    return float(np.linalg.norm(gtsam.Rot3.Logmap(gtsam.Rot3(one).between(gtsam.Rot3(two)))))


@pytest.mark.parametrize("offset_s", [-0.08, 0.0, 0.038])
def test_an_offset_is_found_within_its_sigma(offset_s: float) -> None:
    frames, imu = seen(offset_s)
    found = align_by_epipolar_errors(frames, rig().cameras[0], 1.0, imu, None, mounted=True)
    assert found is not None
    assert found.is_clear()
    assert abs(found.offset_s - offset_s) < 2.0 * found.offset_sigma_s < 0.02
    assert abs(found.offset_s - offset_s) < 3e-3
    for near_s in (offset_s + 8e-3, -offset_s):  # nearly right, and from before a change
        again = align_by_epipolar_errors(frames, rig().cameras[0], 1.0, imu, None, True, near_s)
        assert again is not None
        assert again.is_clear()
        assert again.offset_s == pytest.approx(found.offset_s, abs=1e-6)


def test_a_mounting_is_found_wherever_it_is_sought_from() -> None:
    (frames, imu), found = seen(0.038), []
    for away_deg in (0.0, 12.0):
        coarse = GyroAlignment(0.02, 0.01, 5.0, np.zeros(3), turned(away_deg), 0.2, 100.0)
        one = align_by_epipolar_errors(frames, rig().cameras[0], 1.0, imu, coarse, mounted=False)
        assert one is not None
        assert angle(turned(0.0), one.body_R_camera) < 2.0 * one.rotation_sigma_rad < 0.2
        assert abs(one.offset_s - 0.038) < 2.0 * one.offset_sigma_s
        found.append(one.body_R_camera)
    assert angle(*found) < np.deg2rad(0.2)


def test_rows_do_not_move_by_a_mounting_that_is_unknown() -> None:
    frames, imu = seen(0.0)
    coarse, found = GyroAlignment(0.0, 0.01, 5.0, np.zeros(3), turned(3.0), 0.2, 100.0), []
    for pose in (rig().cameras[0].body_T_camera, gtsam.Pose3()):
        camera = replace(rig().cameras[0], body_T_camera=pose, readout_s=0.03)
        one = align_by_epipolar_errors(frames, camera, 1.0, imu, coarse, mounted=False)
        assert one is not None
        found.append(one)
    assert found[0].offset_s == found[1].offset_s
    np.testing.assert_array_equal(found[0].body_R_camera, found[1].body_R_camera)


def test_a_bearing_far_beyond_the_image_is_one_of_many() -> None:
    """There the slopes of a lens model are huge, so that it seems to be known beyond doubt."""
    frames, imu = seen(0.0)
    bent = []
    for frame in frames:
        normalized = frame.cameras[0].normalized.copy()
        normalized[0] = 1e9
        one = replace(frame.cameras[0], normalized=normalized)
        bent.append(FeatureFrame(frame.stamp_ns, (one,)))
    found = align_by_epipolar_errors(bent, rig().cameras[0], 1.0, imu, None, mounted=True)
    assert found is not None
    assert abs(found.offset_s) < 2.0 * found.offset_sigma_s < 0.02


def test_few_frames_say_nothing() -> None:
    frames, imu = seen(0.0, 1.0)
    assert align_by_epipolar_errors(frames, rig().cameras[0], 1.0, imu, None, True) is None


def phone(
    data: Path, folder: Path, offset_s: float, room: str = "room1", **options: Any
) -> SimulatedSequence:
    """A narrow lens in the hand; 1 % of the observations are wrong."""
    path = str(data / "tumvi_inertial" / room)
    base = open_dataset(path, cameras=1).rig
    lens = Camera(502.0, 502.0, 320.0, 240.0, "none", (), 640, 480)
    readout_s = options.pop("readout_s", 0.0)
    camera = replace(
        base.cameras[0],
        camera=lens,
        time_offset_s=offset_s,
        rolling_shutter=readout_s > 0.0,
        readout_s=readout_s,
    )
    write_kalibr(replace(base, cameras=(camera,)), folder / "phone.yaml")
    settings = {"start_s": 10.0, "duration_s": 8.0, "seed": 1, "rate_hz": 25.0} | options
    sequence = simulate(
        trajectory=path,
        calibration=folder / "phone.yaml",
        tracks={"features": 100, "outliers": 0.01, "pixel_sigma": settings.pop("sigma", 1.0)},
        cameras=1,
        real_imu=True,
        **settings,
    )
    assert isinstance(sequence, SimulatedSequence)
    return sequence


def flown(sequence: SimulatedSequence, camera: RigCamera) -> tuple[Estimator, list[NavState]]:
    """The estimator at the end under a calibration, and the states that are left."""
    algorithm = load_config(algorithm="msckf").algorithm
    estimator = Estimator(replace(sequence.rig, cameras=(camera,)), algorithm, BackendConfig())
    states: list[NavState] = []
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        states = (states if estimator.replayed is None else []) + estimator.states
    return estimator, states


def error_m(sequence: SimulatedSequence, states: list[NavState]) -> float:
    history = StateHistory()
    for state in states:
        history.append(state)
    found = ape(sequence.groundtruth(), history.trajectory(), alignment="yaw")
    return float(found.statistics.rmse)


@pytest.mark.parametrize("known", [True, slow(False)])
def test_a_narrow_lens_with_another_clock_starts_in_the_hand(
    data_dir: Path, tmp_path: Path, known: bool
) -> None:
    """Two views of a wall leave several rotations here: it never started by these."""
    sequence = phone(data_dir, tmp_path, 0.038)
    camera = replace(sequence.rig.cameras[0], time_offset_s=0.0, rotation_known=known)
    camera = camera if known else replace(camera, body_T_camera=gtsam.Pose3())
    estimator, states = flown(sequence, camera)
    assert estimator.calibration is not None
    assert abs(estimator.calibration.rig.cameras[0].time_offset_s - 0.038) < 1e-3
    assert states[0].stamp_ns - sequence.info().start_ns < 4_000_000_000
    assert error_m(sequence, states) < 0.03


@pytest.mark.slow
def test_a_right_start_is_not_corrected_by_a_wrong_minimum(data_dir: Path, tmp_path: Path) -> None:
    """What follows the start, solved from nothing, fits 123 of 179 features, 0.9 m/s off."""
    options = {"start_s": 60.0, "duration_s": 6.0, "seed": 106, "sigma": 0.5}
    options["readout_s"] = 0.02
    sequence = phone(data_dir, tmp_path, 0.0, "room3", **options)
    estimator, states = flown(sequence, sequence.rig.cameras[0])
    assert "start_corrected" not in estimator.diagnostics.counts
    assert error_m(sequence, states) < 0.03
