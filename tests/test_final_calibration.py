# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The final adjustment says how far the calibration is off, and goes on with the right one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from slam_graph import run
from slam_graph.backend import FinalBa
from slam_graph.datasets import RecordedSequence, dataset_from_arrays
from slam_graph.evaluation import ape
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, ImuData, Rig
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
    return replace(rig, cameras=(mounted,))


@cache
def flight() -> RecordedSequence:
    return simulate(trajectory="figure8", cameras=1, duration_s=14.0, seed=4)


@cache
def adjusted(change: str) -> RunResult:
    """The run of a flight with one camera, whose calibration has a fault."""
    sequence = flight()
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
    return run(recording)


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
    assert len(off) == 11
    assert np.max(np.abs(off)) < 3.5
    assert np.mean(np.square(off)) < 2.2  # of 11: χ² below this in 99 %
    assert adjusted("right").status == "ok"


@pytest.mark.parametrize(
    ("change", "said"),
    [("turned", "cam0 is turned by"), ("longer", "the focal lengths of cam0")],
)
def test_a_wrong_one_is_named_and_corrected(change: str, said: str) -> None:
    found = minimum(change)
    assert said in found.calibration_faults[0].what
    assert found.calibration is not None
    right, shown = flight().rig.cameras[0], found.calibration.rig.cameras[0]
    turn = right.body_T_camera.rotation().between(shown.body_T_camera.rotation())
    assert np.rad2deg(np.linalg.norm(gtsam.Rot3.Logmap(turn))) < 0.1 * TURN_DEG
    assert shown.camera.intrinsics == pytest.approx(right.camera.intrinsics, abs=0.9)
    assert error_m(change) < 2.0 * error_m("right")


def test_a_small_offset_that_is_found_late_loses_nothing() -> None:
    late, right = (adjusted(change).trajectory for change in ("late", "right"))
    assert abs(int(late.stamps_ns[0]) - int(right.stamps_ns[0])) < 10_000_000
    assert adjusted("late").status == "ok"
    truth = flight().groundtruth()
    assert truth is not None
    assert ape(truth, late, alignment="yaw").statistics.rmse < 0.03
