# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of simulated motions and IMU streams."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from simulated_tracks import SHAPES, tracks

from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.sensors.measurements import ImuData
from slam_graph.sensors.rig import ImuNoise
from slam_graph.simulation.imu_simulation import SimulatedImu
from slam_graph.simulation.motion import GRAVITY, SplineMotion
from slam_graph.simulation.simulated_sequence import SimulatedTracks
from slam_graph.simulation.simulation_config import (
    SimulatedImuConfig,
)
from slam_graph.simulation.trajectories import continuous, fit, stamps_between, through_waypoints

PERFECT = {"noise_scale": 0.0, "gyro_bias_sigma": 0.0, "accel_bias_sigma": 0.0}


def spline_of(sequence: SimulatedTracks) -> SplineMotion:
    motion = sequence.flight.motion
    assert isinstance(motion, SplineMotion)
    return motion


def check_derivatives(motion: SplineMotion) -> None:
    """Velocity, acceleration and angular rate against central differences."""
    step_ns = 100_000
    stamps = np.arange(motion.start_ns + 10**7, motion.end_ns - 10**7, 37_000_003)
    before, after, width_s = stamps - step_ns, stamps + step_ns, 2e-9 * step_ns
    slope = (motion.positions(after) - motion.positions(before)) / width_s
    np.testing.assert_allclose(motion.velocities(stamps), slope, atol=1e-6)
    slope = (motion.velocities(after) - motion.velocities(before)) / width_s
    np.testing.assert_allclose(motion.accelerations(stamps), slope, atol=1e-3)
    turn = (motion.rotations(before).inv() * motion.rotations(after)).as_rotvec() / width_s
    np.testing.assert_allclose(motion.angular_rates(stamps), turn, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_derivatives_are_those_of_the_poses(shape: str) -> None:
    motion = spline_of(tracks(trajectory=shape, duration_s=40.0))
    check_derivatives(motion)
    stamps = np.arange(motion.start_ns, motion.end_ns, 10**6)
    jumps = np.linalg.norm(np.diff(motion.accelerations(stamps), axis=0), axis=1)
    assert np.max(jumps) < 0.1  # continuous: 100 m/s³ at most
    assert np.max(np.linalg.norm(motion.accelerations(stamps), axis=1)) < 15.0
    assert np.max(np.linalg.norm(motion.angular_rates(stamps), axis=1)) < 5.0


def test_a_hovering_platform_does_not_move_at_all() -> None:
    motion = spline_of(tracks(flight={"hover_s": 2.0, "hover_every_s": 10.0}, duration_s=25.0))
    stamps = np.arange(motion.start_ns, motion.start_ns + 2 * 10**9, 10**7)
    for begin_s in (0.0, 12.0):
        at = stamps + round(begin_s * 1e9)
        assert np.ptp(motion.positions(at), axis=0).max() < 1e-12
        assert np.abs(motion.velocities(at)).max() < 1e-12
        assert np.abs(motion.angular_rates(at)).max() < 1e-12
        force = motion.specific_forces(at)
        np.testing.assert_allclose(np.linalg.norm(force, axis=1), 9.81, atol=1e-9)
    moving = np.array([motion.start_ns + 6 * 10**9])
    assert np.linalg.norm(motion.velocities(moving)) > 0.3


def test_a_spline_goes_through_its_waypoints() -> None:
    rng = np.random.default_rng(5)
    times_s = np.cumsum(rng.uniform(0.3, 0.8, 20))
    quaternions = continuous(np.cumsum(rng.normal(size=(20, 4)), axis=0) + np.array([0, 0, 0, 9.0]))
    poses = np.column_stack([rng.normal(size=(20, 3)), quaternions])
    poses[8:11] = poses[8]
    spline = through_waypoints(times_s, poses)
    np.testing.assert_allclose(spline(times_s), poses, atol=1e-12)
    rest = np.linspace(times_s[8], times_s[10], 50)
    assert np.ptp(spline(rest), axis=0).max() < 1e-12
    for order, tolerance in ((1, 1e-3), (2, 0.1)):
        sides = spline(times_s[1:-1] - 1e-6, order), spline(times_s[1:-1] + 1e-6, order)
        np.testing.assert_allclose(*sides, atol=tolerance)


def test_a_fitted_spline_follows_a_recording_and_its_derivatives() -> None:
    truth = spline_of(tracks(trajectory="random", duration_s=20.0))
    stamps = stamps_between(truth.start_ns, truth.end_ns, 200.0)
    signs = np.where(np.arange(len(stamps)) % 7 == 0, -1.0, 1.0)  # q and -q are one rotation
    quaternions = truth.rotations(stamps).as_quat() * signs[:, None]
    motion = fit(Trajectory(stamps, truth.positions(stamps), quaternions))
    check_derivatives(motion)
    np.testing.assert_allclose(motion.positions(stamps), truth.positions(stamps), atol=1e-3)
    error = (motion.rotations(stamps).inv() * truth.rotations(stamps)).magnitude()
    assert np.max(error) < 1e-3
    np.testing.assert_allclose(motion.velocities(stamps), truth.velocities(stamps), atol=0.05)


def test_a_recording_with_a_gap_is_refused() -> None:
    truth = spline_of(tracks())
    stamps = np.delete(stamps_between(truth.start_ns, truth.end_ns, 100.0), slice(200, 300))
    with pytest.raises(DataError, match=r"gap of 1\.01 s"):
        fit(Trajectory(stamps, truth.positions(stamps), truth.rotations(stamps).as_quat()))


def integrate(imu: ImuData, motion: SplineMotion) -> tuple[NDArray[Any], NDArray[Any], Rotation]:
    """Position, velocity and attitude at the last sample, by the midpoint rule."""
    steps_s = np.diff(imu.stamps_ns) * 1e-9
    turns = 0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * steps_s[:, None]
    forces = 0.5 * (imu.accel[1:] + imu.accel[:-1])
    forces = Rotation.from_rotvec(0.5 * turns).apply(forces)  # felt halfway through the step
    first = imu.stamps_ns[:1]
    p, v, R = motion.positions(first)[0], motion.velocities(first)[0], motion.rotations(first)[0]
    for turn, force, dt in zip(Rotation.from_rotvec(turns), forces, steps_s, strict=True):
        acceleration = R.apply(force) + GRAVITY
        p = p + v * dt + 0.5 * acceleration * dt**2
        v = v + acceleration * dt
        R = R * turn
    return p, v, R


@pytest.mark.parametrize("shape", SHAPES)
def test_a_perfect_imu_integrates_to_the_trajectory(shape: str) -> None:
    errors = []
    for rate_hz in (200.0, 400.0):
        imu = PERFECT | {"rate_hz": rate_hz}
        sequence = tracks(trajectory=shape, duration_s=11.0, imu=imu)
        motion, data = spline_of(sequence), sequence.imu()[: round(10 * rate_hz) + 1]
        p, v, R = integrate(data, motion)
        end = data.stamps_ns[-1:]
        assert end[0] - motion.start_ns == 10 * 10**9
        np.testing.assert_allclose(v, motion.velocities(end)[0], atol=1e-3)
        assert (R.inv() * motion.rotations(end)[0]).magnitude() < 2e-5
        errors.append(float(np.linalg.norm(p - motion.positions(end)[0])))
    assert errors[0] < 4e-3
    assert errors[1] == pytest.approx(errors[0] / 4, rel=0.1)  # what is left is the rule's


@pytest.fixture(scope="module")
def noisy_imu() -> SimulatedImu:
    """Ten minutes at rest, sampled at 200 Hz."""
    pose = np.array([0.0, 0, 0, 0, 0, 0, 1])
    spline = through_waypoints(np.array([0.0, 600.0]), np.stack([pose, pose]))
    motion = SplineMotion(10**9, 601 * 10**9, spline)
    return SimulatedImu(motion, ImuNoise(), SimulatedImuConfig(), 3)


def test_noise_has_the_densities_of_the_calibration(noisy_imu: SimulatedImu) -> None:
    data = ImuData.concatenate(list(noisy_imu.blocks()))
    gyro_bias, accel_bias = noisy_imu.biases(data.stamps_ns)
    noise, rate = noisy_imu.noise, noisy_imu.rate_hz
    assert len(data) == noisy_imu.samples == 120_001
    white = data.gyro - gyro_bias
    np.testing.assert_allclose(white.std(axis=0), noise.gyro_noise_density * rate**0.5, rtol=0.01)
    white = data.accel - accel_bias - [0, 0, 9.81]
    np.testing.assert_allclose(white.std(axis=0), noise.accel_noise_density * rate**0.5, rtol=0.01)
    assert np.abs(np.corrcoef(white[1:, 0], white[:-1, 0])[0, 1]) < 0.01
    for bias, density in (
        (gyro_bias, noise.gyro_random_walk),
        (accel_bias, noise.accel_random_walk),
    ):
        for lag_s in (0.005, 0.1, 1.0):  # the spread of a random walk grows with the root of time
            way = bias[round(lag_s * rate) :] - bias[: -round(lag_s * rate)]
            assert np.sqrt(np.mean(way**2)) == pytest.approx(density * lag_s**0.5, rel=0.15)


def test_the_imu_is_the_same_wherever_reading_begins(noisy_imu: SimulatedImu) -> None:
    whole = ImuData.concatenate(list(noisy_imu.blocks()))
    later = ImuData.concatenate(list(noisy_imu.blocks(after_ns=123_456_789_012)))
    first = int(np.searchsorted(whole.stamps_ns, 123_456_789_012))
    np.testing.assert_array_equal(later.stamps_ns, whole.stamps_ns[first:])
    np.testing.assert_array_equal(later.accel, whole.accel[first:])
    some = whole.stamps_ns[1::1999]
    gyro_bias, _ = noisy_imu.biases(some)
    np.testing.assert_allclose(gyro_bias, noisy_imu.biases(whole.stamps_ns)[0][1::1999])
