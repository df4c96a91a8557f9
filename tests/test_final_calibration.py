# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The final adjustment says how far the calibration is off, and goes on with the right one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from groups import slow

from benchmarks.wrong_setups import WronglySetUp, baseline
from slam_graph import run
from slam_graph.backend import FinalBa
from slam_graph.backend.smoothing.calibration_faults import calibration_faults
from slam_graph.datasets import RecordedSequence, dataset_from_arrays, read_kalibr
from slam_graph.evaluation import ape
from slam_graph.results import RunResult
from slam_graph.sensors import CalibrationEstimate, FeatureFrame, ImuData, Rig
from slam_graph.simulation import simulate

TURN_DEG = 1.0


def given(rig: Rig, change: str) -> Rig:
    """A calibration with a fault."""
    (mounted,) = rig.cameras
    pose, lens = mounted.body_T_camera, mounted.camera
    if change == "turned":
        turn = gtsam.Rot3.Expmap(np.deg2rad(TURN_DEG) * np.array([1.0, 2.0, 2.0]) / 3.0)
        mounted = replace(mounted, body_T_camera=gtsam.Pose3(turn, np.zeros(3)) * pose)
    elif change == "late":
        mounted = replace(mounted, time_offset_s=0.006)
    elif change == "longer":
        mounted = replace(mounted, camera=replace(lens, fx=1.015 * lens.fx, fy=1.015 * lens.fy))
    elif change == "bent":
        coefficients = tuple(0.9 * value for value in lens.coefficients)
        mounted = replace(mounted, camera=replace(lens, coefficients=coefficients))
    return replace(rig, cameras=(mounted,))


@cache
def flight(rate_hz: float = 10.0) -> RecordedSequence:
    return simulate(trajectory="figure8", cameras=1, duration_s=14.0, rate_hz=rate_hz, seed=4)


@cache
def adjusted(change: str, *settings: str, rate_hz: float = 10.0) -> RunResult:
    """The run of a flight with one camera, whose calibration has a fault."""
    sequence = flight(rate_hz)
    packets = list(sequence.packets())
    imu = ImuData.concatenate([packet.imu for packet in packets])
    rig = given(sequence.rig, change)
    lens = rig.cameras[0].camera
    frames = [
        FeatureFrame(f.stamp_ns, (replace(seen, normalized=lens.undistort(seen.pixels)),))
        for f in (packet.frame for packet in packets)
        if isinstance(f, FeatureFrame)
        for seen in f.cameras
    ]
    recording = dataset_from_arrays(
        rig,
        imu_stamps_ns=imu.stamps_ns,
        gyro=imu.gyro,
        accel=imu.accel,
        features=frames,
        groundtruth=sequence.groundtruth(),
    )
    return run(recording, overrides=list(settings))


def minimum(change: str) -> FinalBa:
    found = adjusted(change).final_ba
    assert found is not None
    return found


def error_m(change: str) -> float:
    truth = flight().groundtruth()
    assert truth is not None
    return ape(truth, minimum(change).trajectory, alignment="yaw").statistics.rmse


def test_a_right_calibration_is_found_to_be_right() -> None:
    found = minimum("right")
    assert found.calibration_faults == []
    assert found.calibration is not None
    off = [(p.value - p.start) / p.sigma for p in found.calibration.parameters()]
    assert len(off) == 15
    assert np.max(np.abs(off)) < 3.5
    assert np.mean(np.square(off)) < 2.0  # of 15: χ² below this in 99 %
    assert adjusted("right").status == "ok"
    known = {p.name: p.sigma for p in found.calibration.parameters()}
    assert known["cam0_rotation_x_rad"] < 0.002  # of the prior: 0.02
    assert known["time_offset_s"] < 0.001  # of the prior: 0.01


@pytest.mark.parametrize(
    ("change", "said"),
    [
        slow("turned", "cam0 is turned by"),
        slow("longer", "the focal lengths of cam0"),
        slow("bent", "the distortion of cam0"),
        ("late", "the time offset of the cameras is 6."),
    ],
)
def test_a_wrong_one_is_named_and_corrected(change: str, said: str) -> None:
    found = minimum(change)
    assert said in found.calibration_faults[0].what
    assert found.fitting is not None
    right, shown = flight().rig.cameras[0], found.fitting.cameras[0]
    turn = right.body_T_camera.rotation().between(shown.body_T_camera.rotation())
    assert np.rad2deg(np.linalg.norm(gtsam.Rot3.Logmap(turn))) < 0.1 * TURN_DEG
    assert shown.camera.intrinsics == pytest.approx(right.camera.intrinsics, abs=0.9)
    assert shown.camera.coefficients == pytest.approx(right.camera.coefficients, abs=0.001)
    assert error_m(change) < 1.3 * error_m("right")
    result = adjusted(change)
    assert result.status == "suspect"
    assert said in result.message
    assert "try --set backend.calibration." in result.message
    assert result.warnings["calibration_off"] == 1


def test_a_wrong_baseline_is_named_and_corrected(tmp_path: Path) -> None:
    """A few millimetres of a camera's place, which its distance from the other one shows."""
    sequence = simulate(trajectory="random", cameras=2, duration_s=14.0, rate_hz=10.0, seed=3)
    truth = sequence.groundtruth()
    result = run(WronglySetUp(sequence, baseline(1.05)))
    found = result.final_ba
    assert found is not None
    assert truth is not None
    assert "the calibrated baseline of cam1 is" in found.calibration_faults[0].what
    assert "too long" in found.calibration_faults[0].what
    result.save(tmp_path / "run")
    lengths = []
    for rig in (sequence.rig, read_kalibr(tmp_path / "run/calibration_adjusted.yaml")):
        one, two = (mounted.body_T_camera.translation() for mounted in rig.cameras)
        lengths.append(float(np.linalg.norm(two - one)))
    assert lengths[1] == pytest.approx(lengths[0], rel=0.015)
    causal, smoothed = (
        ape(truth, path, alignment="yaw").statistics.rmse
        for path in (result.trajectory, found.trajectory)
    )
    assert smoothed < 0.4 * causal
    assert result.status == "suspect"


def test_cameras_at_one_place_have_no_baseline() -> None:
    """Such as the faces of an omnidirectional one: nothing is said of it, and nothing fails."""
    right = flight().rig.cameras[0]
    moved = replace(right, body_T_camera=right.body_T_camera * gtsam.Pose3.Expmap([0.1] + [0] * 5))
    nominal, shown = Rig((right, right), flight().rig.imu), Rig((right, moved), flight().rig.imu)
    found = CalibrationEstimate(0, nominal, shown, {"e1": 1e-6 * np.eye(6)}, (1e-4,))
    (fault,) = calibration_faults(found)
    assert "cam1 is turned by 5.73°" in fault.what


@pytest.mark.slow
def test_a_small_offset_that_is_found_late_loses_nothing() -> None:
    result, truth = adjusted("late", rate_hz=20.0), flight(20.0).groundtruth()
    assert result.warnings["calibration_corrected"] == 1
    assert truth is not None
    assert result.trajectory.stamps_ns[0] - truth.stamps_ns[0] < 1_200_000_000
    assert ape(truth, result.trajectory, alignment="yaw").statistics.rmse < 0.03


@pytest.mark.slow
def test_beside_moving_objects_the_calibration_of_the_run_is_kept() -> None:
    found = adjusted("turned", "objects.enabled=true").final_ba
    assert found is not None
    assert found.calibration_faults
    assert found.summary.iterations < minimum("turned").summary.iterations
