# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Clock and mounting by epipolar errors: exact without noise, and where two views are ambiguous."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

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
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.evaluation import ape
from slam_graph.geometry import NavState, StateHistory
from slam_graph.sensors import FeatureFrame, ImuBuffer
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


def test_few_frames_say_nothing() -> None:
    frames, imu = seen(0.0, 1.0)
    assert align_by_epipolar_errors(frames, rig().cameras[0], 1.0, imu, None, True) is None


def phone(data: Path, folder: Path, offset_s: float) -> SimulatedSequence:
    """A narrow lens in the hand, with tracks of one pixel, of which 1 % are wrong."""
    path = str(data / "tumvi_inertial" / "room1")
    base = simulate(trajectory=path, duration_s=0.5, cameras=1, real_imu=True).rig
    lens = Camera(502.0, 502.0, 320.0, 240.0, "none", (), 640, 480)
    camera = replace(base.cameras[0], camera=lens, time_offset_s=offset_s)
    write_kalibr(replace(base, cameras=(camera,)), folder / "phone.yaml")
    sequence = simulate(
        trajectory=path,
        calibration=folder / "phone.yaml",
        start_s=10.0,
        duration_s=8.0,
        rate_hz=25.0,
        seed=1,
        tracks={"features": 100, "outliers": 0.01},
        cameras=1,
        real_imu=True,
    )
    assert isinstance(sequence, SimulatedSequence)
    return sequence


@pytest.mark.parametrize("known", [True, slow(False)])
def test_a_narrow_lens_with_another_clock_starts_in_the_hand(
    data_dir: Path, tmp_path: Path, known: bool
) -> None:
    """Two views of a wall leave several rotations here: it never started by these."""
    sequence = phone(data_dir, tmp_path, 0.038)
    camera = replace(sequence.rig.cameras[0], time_offset_s=0.0, rotation_known=known)
    camera = camera if known else replace(camera, body_T_camera=gtsam.Pose3())
    algorithm = load_config(algorithm="msckf").algorithm
    estimator = Estimator(replace(sequence.rig, cameras=(camera,)), algorithm, BackendConfig())
    states: list[NavState] = []
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        states = (states if estimator.replayed is None else []) + estimator.states
    assert estimator.calibration is not None
    assert abs(estimator.calibration.rig.cameras[0].time_offset_s - 0.038) < 1e-3
    history = StateHistory()
    for state in states:
        history.append(state)
    assert states[0].stamp_ns - sequence.info().start_ns < 4_000_000_000
    assert ape(sequence.groundtruth(), history.trajectory(), alignment="yaw").statistics.rmse < 0.03
