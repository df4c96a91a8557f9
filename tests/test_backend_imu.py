# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The dynamics: preintegration against motions in closed form, its covariance, and the buffer."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from flight import GRAVITY, Flight
from gtsam.symbol_shorthand import B, V, X
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import ImuData
from slam_graph.sensors.rig import ImuNoise

NOISE = ImuNoise(1e-3, 2e-4, 2e-2, 5e-3, 200.0)
PARAMS = NOISE.preintegration_params(9.81)
NO_BIAS = gtsam.imuBias.ConstantBias()


def error_of(predicted: NavState, truth: NavState) -> tuple[float, float, float]:
    """Errors of rotation (rad), position (m) and velocity (m/s)."""
    between = truth.world_T_body.between(predicted.world_T_body)
    return (
        float(np.linalg.norm(gtsam.Rot3.Logmap(between.rotation()))),
        float(np.linalg.norm(between.translation())),
        float(np.linalg.norm(predicted.velocity - truth.velocity)),
    )


def test_constant_rate_and_acceleration_at_once() -> None:
    """Rotation about a fixed axis while the world acceleration is constant."""
    rate, acceleration = np.array([0.3, -0.8, 0.5]), np.array([0.7, -0.2, 0.4])
    start = NavState(
        0,
        gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.7), np.array([1.0, 2.0, 3.0])),
        np.array([0.5, -1.0, 0.2]),
        accel_bias=np.array([0.1, 0.2, -0.1]),
        gyro_bias=np.array([0.01, -0.02, 0.03]),
    )
    length_s = 1.0
    R_0 = Rotation.from_matrix(start.world_T_body.rotation().matrix())
    errors = []
    for rate_hz in (50, 100, 200, 400):
        t = np.linspace(0.0, length_s, round(length_s * rate_hz) + 1)
        force = (R_0 * Rotation.from_rotvec(np.outer(t, rate))).inv().apply(acceleration - GRAVITY)
        samples = ImuData(
            np.round(t * 1e9).astype(np.int64),
            np.tile(rate + start.gyro_bias, (len(t), 1)),
            force + start.accel_bias,
        )
        bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
        pim = samples.preintegrated(bias, PARAMS)
        assert pim.deltaTij() == pytest.approx(length_s, abs=1e-9)
        R_1 = R_0 * Rotation.from_rotvec(rate * length_s)
        truth = NavState(
            10**9,
            gtsam.Pose3(
                gtsam.Rot3(R_1.as_matrix()),
                start.world_T_body.translation()
                + start.velocity * length_s
                + 0.5 * acceleration * length_s**2,
            ),
            start.velocity + acceleration * length_s,
            accel_bias=start.accel_bias,
            gyro_bias=start.gyro_bias,
        )
        predicted = start.predicted(pim, 10**9)
        assert predicted.stamp_ns == 10**9
        np.testing.assert_array_equal(predicted.gyro_bias, start.gyro_bias)
        errors.append(error_of(predicted, truth))
    table = np.array(errors)
    assert table[:, 0].max() < 1e-9  # a constant rate is integrated exactly
    assert np.all(table[:-1, 1:] / table[1:, 1:] > 1.9)  # at least proportional to the period
    assert table[-1, 1:].max() < 0.012


def test_a_sinusoid_converges_with_the_sample_rate() -> None:
    flight = Flight(gyro_bias=np.array([0.02, -0.01, 0.03]), accel_bias=np.array([0.1, -0.05, 0.2]))
    start, truth = flight.nav_state(0.4), flight.nav_state(1.4)
    bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
    errors = []
    for rate_hz in (50, 100, 200, 400):
        pim = flight.imu(0.4, 1.4, rate_hz).preintegrated(bias, PARAMS)
        errors.append(error_of(start.predicted(pim, truth.stamp_ns), truth))
    table = np.array(errors)
    assert np.all(table[:-1] / table[1:] > 1.9)  # at least proportional to the period
    assert np.all(table[-1] < (1e-5, 1e-3, 1.5e-3))


def test_a_change_of_bias_is_corrected_to_first_order() -> None:
    """The prediction at another bias than that of the integration."""
    flight = Flight()
    start = flight.nav_state(0.0)
    samples = flight.imu(0.0, 0.5)
    small = np.array([2e-3, -1e-3, 1e-3])
    other = replace(start, accel_bias=10 * small, gyro_bias=small)
    corrected = other.predicted(samples.preintegrated(NO_BIAS, PARAMS), 5 * 10**8)
    bias = gtsam.imuBias.ConstantBias(other.accel_bias, other.gyro_bias)
    anew = other.predicted(samples.preintegrated(bias, PARAMS), 5 * 10**8)
    plain = start.predicted(samples.preintegrated(NO_BIAS, PARAMS), 5 * 10**8)
    assert all(
        c < 0.02 * p for c, p in zip(error_of(corrected, anew), error_of(plain, anew), strict=True)
    )


def noisy(samples: ImuData, rng: np.random.Generator) -> tuple[ImuData, FloatArray]:
    """Samples with white noise and walking biases, and the change of (accel, gyro) bias."""
    period = float(np.diff(samples.stamps_ns).mean() * 1e-9)
    shape = samples.gyro.shape
    walks = [
        np.cumsum(rng.normal(0.0, density * np.sqrt(period), shape), axis=0)
        for density in (NOISE.accel_random_walk, NOISE.gyro_random_walk)
    ]
    walks = [walk - walk[0] for walk in walks]
    white = 1.0 / np.sqrt(period)
    return (
        ImuData(
            samples.stamps_ns,
            samples.gyro + walks[1] + rng.normal(0.0, NOISE.gyro_noise_density * white, shape),
            samples.accel + walks[0] + rng.normal(0.0, NOISE.accel_noise_density * white, shape),
        ),
        np.concatenate([walks[0][-1], walks[1][-1]]),
    )


@pytest.fixture(scope="module")
def draws() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (N, 15) of noisy preintegrations, their covariance, and the factors' χ² (N,)."""
    rng, flight = np.random.default_rng(5), Flight()
    samples = flight.imu(0.3, 0.8)
    clean = samples.preintegrated(NO_BIAS, PARAMS)
    start = flight.nav_state(0.3)
    ideal = start.predicted(clean, 8 * 10**8)
    values = gtsam.Values()
    for frame, state in ((0, start), (1, ideal)):
        values.insert(X(frame), state.world_T_body)
        values.insert(V(frame), state.velocity)
    values.insert(B(0), NO_BIAS)
    values.insert(B(1), NO_BIAS)
    errors, squares = [], []
    for _ in range(300):
        samples_k, walked = noisy(samples, rng)
        pim = samples_k.preintegrated(NO_BIAS, PARAMS)
        turn = gtsam.Rot3.Logmap(clean.deltaRij().between(pim.deltaRij()))
        errors.append(
            np.concatenate(
                [
                    turn,
                    clean.deltaRij().unrotate(pim.deltaPij() - clean.deltaPij()),
                    clean.deltaRij().unrotate(pim.deltaVij() - clean.deltaVij()),
                    walked,
                ]
            )
        )
        values.update(B(1), gtsam.imuBias.ConstantBias(walked[:3], walked[3:]))
        squares.append(2.0 * imu_factor(0, 1, pim).error(values))
    return np.array(errors), np.asarray(clean.preintMeasCov()), np.array(squares)


def test_the_covariance_is_that_of_monte_carlo(
    draws: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Standard deviations of rotation, position, velocity and both biases within 20 %."""
    errors, covariance, _ = draws
    ratio = np.sqrt(np.diag(covariance)) / errors.std(axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)


def test_the_residual_of_the_truth_is_chi_squared(
    draws: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """All 15 components together, with their correlations."""
    squares = draws[2]
    np.testing.assert_allclose(squares.mean(), 15.0, rtol=0.1)
    assert kstest(squares, chi2(15).cdf).pvalue > 0.01


def test_a_gap_has_the_noise_of_the_samples_that_are_missing() -> None:
    """Of a constant signal: also where the position lies once the velocity is known."""
    ends, all_of_it = ([0, 5 * 10**7], list(range(0, 5 * 10**7 + 1, 5 * 10**6)))
    covariances = []
    for stamps in (ends, all_of_it):
        constant = np.tile([0.3, -0.2, 9.0], (len(stamps), 1))
        samples = ImuData(np.array(stamps, dtype=np.int64), 0.1 * constant, constant)
        covariances.append(samples.preintegrated(NO_BIAS, PARAMS).preintMeasCov())
    gap, sampled = covariances
    np.testing.assert_allclose(np.diag(gap)[:9], np.diag(sampled)[:9], rtol=0.15)
    for P in covariances:  # of the position, given rotation and velocity
        known = np.r_[0:3, 6:9]
        P[3:6, 3:6] -= P[3:6][:, known] @ np.linalg.solve(P[np.ix_(known, known)], P[known, 3:6])
    np.testing.assert_allclose(np.diag(gap)[3:6], np.diag(sampled)[3:6], rtol=0.2)


def test_the_scale_multiplies_all_densities() -> None:
    samples = Flight().imu(0.0, 0.2)
    single = samples.preintegrated(NO_BIAS, NOISE.preintegration_params(9.81)).preintMeasCov()
    triple = samples.preintegrated(NO_BIAS, NOISE.preintegration_params(9.81, 3.0)).preintMeasCov()
    ratio = np.diag(triple) / np.diag(single)
    np.testing.assert_allclose(np.delete(ratio, [3, 4, 5]), 9.0, rtol=1e-2)
    assert np.all((ratio[3:6] > 1.0) & (ratio[3:6] <= 9.0))  # the integration's own error is fixed


# --- the buffer -----------------------------------------------------------------------------------


def ramp(stamps_ns: list[int]) -> ImuData:
    """Samples of a signal that is linear in time."""
    t = np.array(stamps_ns, dtype=np.int64)
    slope = np.array([1.0, -2.0, 0.5])
    return ImuData(t, np.outer(t, slope) * 1e-9, np.outer(t, -slope) * 1e-9 + 3.0)


def check_linear(block: ImuData) -> None:
    expected = ramp(block.stamps_ns.tolist())
    np.testing.assert_allclose(block.gyro, expected.gyro, atol=1e-12)
    np.testing.assert_allclose(block.accel, expected.accel, atol=1e-12)


def filled(stamps_ns: list[int]) -> ImuBuffer:
    buffer = ImuBuffer()
    for stamp in stamps_ns:
        buffer.add(ramp([stamp]))
    return buffer


STAMPS = [0, 100, 200, 300, 400, 500]


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        (100, 300, [100, 200, 300]),  # frames on samples
        (130, 370, [130, 200, 300, 370]),  # frames between samples
        (100, 350, [100, 200, 300, 350]),
        (150, 300, [150, 200, 300]),
        (110, 190, [110, 190]),  # no sample inside
        (100, 200, [100, 200]),
        (0, 500, STAMPS),
        (199, 201, [199, 200, 201]),
    ],
)
def test_between_interpolates_both_ends(start: int, end: int, expected: list[int]) -> None:
    block = filled(STAMPS).between(start, end)
    assert block.stamps_ns.tolist() == expected
    check_linear(block)


def test_between_holds_the_nearest_sample_beyond_the_ends() -> None:
    block = filled([100, 200]).between(50, 260)
    assert block.stamps_ns.tolist() == [50, 100, 200, 260]
    np.testing.assert_array_equal(block.gyro[0], block.gyro[1])
    np.testing.assert_array_equal(block.gyro[3], block.gyro[2])


def test_neighbouring_intervals_partition_the_time() -> None:
    """The integral over a whole is the sum over its parts, wherever the cuts are."""
    buffer = ImuBuffer()
    buffer.add(Flight().imu(0.0, 1.0))
    cuts = [0, 50_000_000, 123_456_789, 123_456_790, 400_000_000, 402_000_000, 1_000_000_000]
    blocks = [buffer.between(a, b) for a, b in pairwise(cuts)]
    whole = buffer.between(cuts[0], cuts[-1])
    for name in ("gyro", "accel"):
        parts = [np.trapezoid(getattr(b, name), b.stamps_ns * 1e-9, axis=0) for b in blocks]
        total = np.trapezoid(getattr(whole, name), whole.stamps_ns * 1e-9, axis=0)
        np.testing.assert_allclose(np.sum(parts, axis=0), total, atol=1e-12)
    for block in blocks:
        assert np.all(np.diff(block.stamps_ns) > 0)


def test_forgetting_keeps_what_the_next_interval_needs() -> None:
    buffer = filled(STAMPS)
    expected = buffer.between(250, 420)
    buffer.forget_before(250)
    assert buffer.data.stamps_ns.tolist() == [200, 300, 400, 500]
    kept = buffer.between(250, 420)
    np.testing.assert_array_equal(kept.gyro, expected.gyro)
    buffer.forget_before(300)
    assert buffer.data.stamps_ns[0] == 300
    buffer.forget_before(10_000)
    assert buffer.data.stamps_ns.tolist() == [500]


def test_coverage_begins_with_the_first_sample() -> None:
    buffer = ImuBuffer()
    assert not buffer.covers(100)
    buffer.add(ImuData.empty())
    buffer.add(ramp([100, 200]))
    assert not buffer.covers(99)
    assert buffer.covers(100)
    assert buffer.covers(1000)


def test_bad_samples_are_left_out_and_counted() -> None:
    buffer = ImuBuffer()
    assert buffer.add(ramp([100, 200])) == 0
    assert buffer.add(ramp([150, 200, 300, 250, 400])) == 3  # late, repeated, out of order
    broken = ramp([500, 600, 700])
    broken.gyro[0, 1], broken.accel[2, 0] = np.nan, np.inf
    assert buffer.add(broken) == 2
    assert buffer.add(ImuData.empty()) == 0
    assert buffer.data.stamps_ns.tolist() == [100, 200, 300, 400, 600]
    check_linear(buffer.data)


def test_the_largest_gap_is_seen_inside_and_at_both_ends() -> None:
    buffer = filled([0, 100, 200, 700, 800])
    for (start, end), gap_ns in (
        ((0, 200), 100),
        ((0, 800), 500),
        ((750, 1900), 1100),  # the stream has ended
        ((-400, 100), 400),  # it has not begun
    ):
        assert buffer.largest_gap_s(start, end) == pytest.approx(gap_ns * 1e-9)
    assert ImuBuffer().largest_gap_s(0, 1) == float("inf")


def test_without_any_sample_an_interval_is_empty_of_motion() -> None:
    block = ImuBuffer().between(5, 9)
    assert block.stamps_ns.tolist() == [5, 9]
    assert not block.gyro.any()
