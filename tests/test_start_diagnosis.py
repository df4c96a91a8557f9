# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run that cannot start says the likeliest cause; and the fast parts of a start."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product

import gtsam
import numpy as np
import pytest
from flight import Flight, features, rig, room
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.initialization.gyroscope_bias import BearingPairs, _pairs, _Planes
from slam_graph.backend.initialization.inertial_motion import Intervals
from slam_graph.backend.initialization.visual_inertial_alignment import constrained_solution
from slam_graph.config import load_config
from slam_graph.datasets import dataset_from_arrays
from slam_graph.kernels.secular import constrained_solutions
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulator import simulate

Recorded = tuple[Rig, list[FeatureFrame], ImuData]


def recorded(duration_s: float = 4.0, rate_hz: float = 20.0) -> Recorded:
    """A flight that is in motion from its first frame on."""
    flight = simulate(
        trajectory="figure8",
        cameras=1,
        duration_s=duration_s,
        rate_hz=rate_hz,
        flight={"hover_s": 0.0},
        tracks={"features": 60},
    )
    frames = [frame for frame in flight.frames() if isinstance(frame, FeatureFrame)]
    return flight.rig, frames, flight.imu()


def result_of(recording: Recorded) -> RunResult:
    """What a run with one camera comes to."""
    mounted, frames, imu = recording
    sequence = dataset_from_arrays(
        mounted, imu_stamps_ns=imu.stamps_ns, gyro=imu.gyro, accel=imu.accel, features=frames
    )
    return run(sequence, load_config(overrides=["final_ba.enabled=false"], algorithm="msckf"))


def turned(recording: Recorded) -> Recorded:
    mounted, frames, imu = recording
    camera = mounted.cameras[0]
    turn = gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2), np.zeros(3))
    camera = replace(camera, body_T_camera=turn.compose(camera.body_T_camera))
    return Rig((camera,), mounted.imu), frames, imu


def in_degrees(recording: Recorded) -> Recorded:
    mounted, frames, imu = recording
    return mounted, frames, ImuData(imu.stamps_ns, np.rad2deg(imu.gyro), imu.accel)


def in_g(recording: Recorded) -> Recorded:
    mounted, frames, imu = recording
    return mounted, frames, ImuData(imu.stamps_ns, imu.gyro, imu.accel / 9.81)


def with_gaps(recording: Recorded) -> Recorded:
    mounted, frames, imu = recording
    there = np.arange(len(imu)) % 100 < 40
    return mounted, frames, ImuData(imu.stamps_ns[there], imu.gyro[there], imu.accel[there])


def on_another_clock(recording: Recorded) -> Recorded:
    mounted, frames, imu = recording
    return mounted, frames, ImuData(imu.stamps_ns + 10**12, imu.gyro, imu.accel)


def with_few_tracks(recording: Recorded) -> Recorded:
    mounted, frames, imu = recording
    few = [
        FeatureFrame(f.stamp_ns, tuple(c.select(np.arange(len(c)) < 8) for c in f.cameras))
        for f in frames
    ]
    return mounted, few, imu


@pytest.mark.parametrize(
    ("broken", "cause"),
    [
        (turned, "turned by some 90° against its calibrated mounting"),
        (in_degrees, "times as fast as the camera; check its unit"),
        (in_g, "the accelerometer measures 1.0"),
        (with_gaps, "IMU samples are missing"),
        (on_another_clock, "no IMU samples at the times of the frames"),
        (with_few_tracks, "too few tracks: 8 features"),
    ],
)
def test_a_run_without_a_start_says_the_likeliest_cause(
    broken: Callable[[Recorded], Recorded], cause: str
) -> None:
    result = result_of(broken(recorded()))
    assert result.status == "not_initialized"
    waits = result.ending.waiting_for
    assert "likeliest cause: " in waits
    assert cause in waits
    certain = broken is in_g  # the diagnosis of the whole run, which is the message then
    assert (waits in result.message) == (not certain)
    assert ("its unit is g;" in result.message) == certain
    assert "\n" not in result.message


def test_frames_far_apart_start_too() -> None:
    """Three frames a second, and five with times that are not exact: none is 1.5 s old."""
    rng = np.random.default_rng(0)
    for rate_hz, jitter_ns in ((3.0, 0), (5.0, 3_000_000)):
        mounted, frames, imu = recorded(5.0, rate_hz)
        late_ns = rng.uniform(0.0, jitter_ns, len(frames)).astype(np.int64)
        moved = [
            FeatureFrame(frame.stamp_ns + int(late), frame.cameras)
            for frame, late in zip(frames, late_ns, strict=True)
        ]
        result = result_of((mounted, moved, imu))
        assert result.status == "ok", result.message
        stamps = result.trajectory.stamps_ns
        assert stamps[0] - frames[0].stamp_ns < 2_500_000_000


def test_many_constrained_problems_are_solved_as_one_is() -> None:
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(50, 30, 7)) * [1.0, 1.0, 1.0, 0.5, 0.5, 0.3, 10.0]
    rows[:25, :, 6] = rows[:25, :, :6] @ [1.0, -2.0, 0.5, 0.0, 0.0, -9.81]
    rows[:25, :, 6] += 0.1 * rng.normal(size=(25, 30))
    many = np.empty((50, 6))
    constrained_solutions(rows.transpose(0, 2, 1) @ rows, 9.81, 1e-13, 12, many)
    for problem, found in zip(rows, many, strict=True):
        one = constrained_solution(problem[:, :6], problem[:, 6], 9.81)
        np.testing.assert_allclose(found, [*one.velocity, *one.gravity], atol=1e-5)


def test_the_derivative_by_the_gyroscope_bias() -> None:
    rng, flight, mounted = np.random.default_rng(2), Flight(), rig(2)
    times_s = np.linspace(0.0, 1.5, 11)
    points = room(300, rng)
    frames = [features(flight, mounted, points, t_s, rng) for t_s in times_s]
    samples = [flight.imu(a, b) for a, b in pairwise(times_s)]
    common = BearingPairs.between(frames, RigProjection(mounted))
    pairs = _pairs(common, Intervals(samples), np.full(3, 0.02))
    assert pairs is not None
    step, axes = 1e-4, np.eye(3)
    weights = rng.uniform(0.5, 1.0, len(pairs.interval))

    def half_squares(change: FloatArray) -> FloatArray:
        return 0.5 * _Planes(change, pairs).squares

    gradients, hessian, _ = _Planes(np.zeros(3), pairs).derivatives(weights)
    slopes = [(half_squares(step * e) - half_squares(-step * e)) / (2.0 * step) for e in axes]
    scale = np.abs(slopes).max()
    np.testing.assert_allclose(
        gradients, weights[:, None] * np.column_stack(slopes), atol=1e-5 * scale
    )

    def total(i: int, j: int) -> float:
        return float(weights @ half_squares(step * (i * axes[a] + j * axes[b])))

    for a, b in product(range(3), repeat=2):
        bend = (total(1, 1) - total(1, -1) - total(-1, 1) + total(-1, -1)) / (4.0 * step**2)
        np.testing.assert_allclose(hessian[a, b], bend, atol=1e-4 * np.abs(hessian).max())


def test_the_inertial_motion_is_that_of_the_preintegration() -> None:
    """To the first order in which GTSAM adds rotation vectors."""
    flight, times_s = Flight(), np.linspace(0.0, 1.5, 11)
    samples = [flight.imu(a, b) for a, b in pairwise(times_s)]
    gyro_bias, intervals = np.array([0.02, -0.05, 0.03]), Intervals(samples)
    motion = intervals.motion(gyro_bias)
    R, p, v = np.eye(3), np.zeros(3), np.zeros(3)
    for k, block in enumerate(samples, 1):
        bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias)
        pim = block.preintegrated(bias, rig().imu.preintegration_params(9.81))
        p, v = p + v * pim.deltaTij() + R @ pim.deltaPij(), v + R @ pim.deltaVij()
        R = R @ pim.deltaRij().matrix()
        for found, expected in ((motion.rotations, R), (motion.displacements, p)):
            np.testing.assert_allclose(found[k], expected, atol=1e-5)
        np.testing.assert_allclose(motion.velocities[k], v, atol=1e-5)
    np.testing.assert_allclose(motion.times_s, times_s, atol=1e-9)


def test_the_derivative_of_rotations_by_the_gyroscope_bias() -> None:
    flight, bias = Flight(), np.array([0.02, -0.05, 0.03])
    intervals = Intervals([flight.imu(0.0, 0.15), flight.imu(0.15, 0.28)])
    by_bias = intervals.rotations(bias)[1]
    for axis, step in enumerate(1e-5 * np.eye(3)):
        turned = [intervals.rotations(bias + sign * step)[0] for sign in (-1, 1)]
        change = Rotation.from_matrix(turned[0].transpose(0, 2, 1) @ turned[1]).as_rotvec()
        np.testing.assert_allclose(by_bias[:, :, axis], change / 2e-5, atol=1e-6)
