# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The start from standing still, and what a start says of its own uncertainty."""

import gtsam
import numpy as np
import pytest
from flight import AT_REST, Flight, packets, rig, room
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.backend_config import BackendConfig, InitializationConfig, PriorConfig
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.initialization.first_state import (
    fix_gauge,
    level_rotation,
    prior_covariance,
    start_from,
    state_at_rest,
)
from slam_graph.backend.solve.state import imu_state_keys
from slam_graph.config import load_config
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.measurements import FeatureFrame, ImuData

PRIOR = PriorConfig()
GYRO_SIGMA = 2.4e-3
UP = np.array([0.0, 0.0, 1.0])
ATTITUDES = [(0.0, 0.0), (0.3, -0.2), (-1.2, 0.6), (2.9, 0.1), (0.1, 1.5), (0.0, -1.5)]


def at_rest(roll: float, pitch: float, gyro_bias: FloatArray) -> tuple[ImuData, FloatArray]:
    """A second of noisy samples at rest, and the true direction of up in the body."""
    rng = np.random.default_rng(1)
    up = Rotation.from_euler("ZYX", [0.0, pitch, roll]).inv().apply(UP)
    stamps = np.arange(200) * 5_000_000
    gyro = gyro_bias + rng.normal(0.0, GYRO_SIGMA, (200, 3))
    return ImuData(stamps, gyro, 9.81 * up + rng.normal(0.0, 0.03, (200, 3))), up


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
def test_tilt_and_gyro_bias_are_recovered(roll: float, pitch: float) -> None:
    bias = np.array([-0.002, 0.021, 0.078])
    samples, up = at_rest(roll, pitch, bias)
    state = state_at_rest(samples, 10**9, PRIOR)
    R = state.world_T_body.rotation().matrix()
    angle = np.arccos(np.clip(R[2] @ up, -1.0, 1.0))
    assert angle < 1e-3
    np.testing.assert_allclose(state.gyro_bias, bias, atol=5 * GYRO_SIGMA / np.sqrt(200))
    for zero in (state.world_T_body.translation(), state.velocity, state.accel_bias):
        np.testing.assert_array_equal(zero, 0.0)
    assert state.stamp_ns == 10**9


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
def test_tilt_and_accelerometer_bias_are_uncertain_together(roll: float, pitch: float) -> None:
    """NEES of tilt and bias over many biases, and of the velocity that is gained in a second."""
    rng = np.random.default_rng(2)
    samples, up = at_rest(roll, pitch, np.zeros(3))
    R = level_rotation(9.81 * up).matrix()
    across = null_space(up[None]).T
    squares, gained = [], []
    for _ in range(400):
        bias = rng.normal(0.0, PRIOR.accel_bias, 3)
        moved = 9.81 * rng.normal(0.0, PRIOR.attitude_rad, 3)
        force = samples.accel + bias + moved
        state = state_at_rest(ImuData(samples.stamps_ns, samples.gyro, force), 10**9, PRIOR)
        assert state.covariance is not None
        estimated = state.world_T_body.rotation().matrix()
        turn = gtsam.Rot3.Logmap(gtsam.Rot3(estimated.T @ R))
        error = np.concatenate([across @ turn, bias])
        rows = np.zeros((5, 15))
        rows[:2, :3], rows[2:, 9:12] = across, np.eye(3)
        squares.append(error @ np.linalg.solve(rows @ state.covariance @ rows.T, error))
        # what is taken for acceleration: R̂ (f - b̂) - g, with the error of a rest that goes on
        rows = np.concatenate([9.81 * skew(up), np.zeros((3, 6)), np.eye(3), np.zeros((3, 3))], 1)
        gained.append(np.trace(across @ rows @ state.covariance @ rows.T @ across.T))
    assert 4.5 < np.mean(squares) < 5.5
    assert np.sqrt(np.max(gained)) < 2.0 * 9.81 * PRIOR.attitude_rad


def test_vibration_at_rest_makes_the_tilt_uncertain() -> None:
    """NEES of the tilt under vibration of 1 m/s² that is correlated over 20 ms."""
    rng = np.random.default_rng(4)
    samples, up = at_rest(0.3, -0.2, np.zeros(3))
    R, across = level_rotation(9.81 * up).matrix(), null_space(up[None]).T
    memory = np.exp(-0.005 / 0.02)
    squares = []
    for _ in range(200):
        vibration = rng.normal(size=(len(samples.accel), 3))
        for k in range(1, len(vibration)):
            new = np.sqrt(1.0 - memory**2) * vibration[k]
            vibration[k] = memory * vibration[k - 1] + new
        moving = ImuData(samples.stamps_ns, samples.gyro, samples.accel + vibration)
        state = state_at_rest(moving, 10**9, PRIOR)
        assert state.covariance is not None
        estimated = state.world_T_body.rotation().matrix()
        turn = across @ gtsam.Rot3.Logmap(gtsam.Rot3(estimated.T @ R))
        P = across @ state.covariance[:3, :3] @ across.T
        squares.append(turn @ np.linalg.solve(P, turn))
    assert 1.2 < np.mean(squares) < 4.0  # 2 is ideal; nine degrees of freedom know the scatter


def test_an_accelerometer_that_measures_nothing_levels_nothing() -> None:
    none = ImuData(np.arange(200) * 5_000_000, np.zeros((200, 3)), np.zeros((200, 3)))
    covariance = state_at_rest(none, 10**9, PRIOR).covariance
    assert covariance is not None
    np.testing.assert_array_equal(covariance, prior_covariance(PRIOR))


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
def test_levelling_is_exact_and_has_no_yaw(roll: float, pitch: float) -> None:
    force = Rotation.from_euler("ZYX", [0.0, pitch, roll]).inv().apply(9.81 * UP)
    R = level_rotation(force).matrix()
    np.testing.assert_allclose(R @ force, 9.81 * UP, atol=1e-9)
    # the body's forward axis, seen from above, points along world x
    assert abs(R[1, 0]) < 1e-9
    assert R[0, 0] > 0 or abs(pitch) > np.pi / 2


def test_the_prior_covers_what_rest_does_not_show() -> None:
    sigmas = np.sqrt(np.diag(prior_covariance(PRIOR)))
    expected = [
        PRIOR.attitude_rad,
        PRIOR.position_m,
        PRIOR.velocity,
        PRIOR.accel_bias,
        PRIOR.gyro_bias,
    ]
    np.testing.assert_allclose(sigmas, np.repeat(expected, 3))


def random_state(seed: int) -> NavState:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(15, 30))
    R = Rotation.random(rng=rng).as_matrix()
    return NavState(
        0,
        gtsam.Pose3(gtsam.Rot3(R), rng.normal(size=3)),
        rng.normal(size=3),
        accel_bias=np.zeros(3),
        gyro_bias=np.zeros(3),
        covariance=0.1 * root @ root.T,
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_gauge_is_fixed_and_the_rest_is_left_alone(seed: int) -> None:
    """Yaw and position get the prior of a definition; tilt, velocity and biases stay."""
    given = random_state(seed)
    fixed = fix_gauge(given, PRIOR)
    before, after = given.covariance, fixed.covariance
    assert before is not None
    assert after is not None
    R = given.world_T_body.rotation().matrix()
    turn = np.zeros((15, 4))
    turn[:3, 0], turn[3:6, 1:] = R.T @ UP, np.eye(3)
    gauge = turn.T @ after @ turn
    expected = np.diag([PRIOR.yaw_rad**2, *[PRIOR.position_m**2] * 3])
    np.testing.assert_allclose(gauge, expected, atol=1e-12)
    # coordinates in which yaw is one axis: nothing else has changed or depends on it
    W = np.eye(15)
    W[:3, :3] = R
    others = np.delete(np.arange(15), [2, 3, 4, 5])
    turned_before, turned_after = W @ before @ W.T, W @ after @ W.T
    np.testing.assert_allclose(
        turned_after[np.ix_(others, others)], turned_before[np.ix_(others, others)], atol=1e-9
    )
    np.testing.assert_allclose(turned_after[2:6][:, others], 0.0, atol=1e-9)
    assert np.all(np.linalg.eigvalsh(after) > 0)
    assert fixed.world_T_body.equals(given.world_T_body, 0.0)


def test_a_given_start_has_the_given_covariance() -> None:
    config = BackendConfig(initialization=InitializationConfig(fix_gauge=False))
    given = random_state(9)
    assert given.covariance is not None
    window = start_from(given, config)
    np.testing.assert_allclose(
        window.prior.covariance_of(imu_state_keys(0)), given.covariance, atol=1e-9
    )
    current = window.current(window.prior)
    assert current.world_T_body.equals(given.world_T_body, 1e-12)
    np.testing.assert_array_equal(current.velocity, given.velocity)


def test_a_start_without_covariance_is_refused() -> None:
    estimator = Estimator(rig(), load_config().algorithm)
    with pytest.raises(EstimationError, match="covariance"):
        estimator.start(Flight().nav_state(0.0))


def test_a_platform_at_rest_starts_after_a_second() -> None:
    """And says until then what it waits for."""
    rng, mounted = np.random.default_rng(3), rig()
    bias = np.array([0.02, -0.03, 0.05])
    flight = Flight(AT_REST.position, AT_REST.position_rate, AT_REST.angles, np.zeros(3), bias)
    config = BackendConfig(initialization=InitializationConfig(mode="static"))
    estimator = Estimator(mounted, load_config().algorithm, config)
    for packet in packets(flight, mounted, room(150, rng), 3.0, rng, 20.0, 0.2):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
        if state is not None:
            break
        assert "still period" in estimator.waiting_for
    assert state is not None
    assert 0.9 < state.stamp_ns * 1e-9 < 1.6
    truth = flight.rotation(np.zeros(1)).as_matrix()[0]
    np.testing.assert_allclose(state.world_T_body.rotation().matrix()[2], truth[2], atol=2e-3)
    np.testing.assert_allclose(state.gyro_bias, bias, atol=1e-3)


def test_a_moving_platform_does_not_start_as_if_at_rest() -> None:
    rng, mounted = np.random.default_rng(3), rig()
    config = BackendConfig(initialization=InitializationConfig(mode="static"))
    estimator = Estimator(mounted, load_config().algorithm, config)
    for packet in packets(Flight(), mounted, room(150, rng), 3.0, rng):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        assert estimator.add_frame(packet.frame) is None
    assert not estimator.initialized
