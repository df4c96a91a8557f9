# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels of the adjustment of a recording: equal to their NumPy forms, and to GTSAM."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.backend.smoothing.keyframe_states import fill_in
from slam_graph.geometry import NavState
from slam_graph.kernels.feature_matches import (
    drift_consensus,
    drift_consensus_numpy,
    mixture_probabilities,
    mixture_probabilities_numpy,
)
from slam_graph.kernels.imu_prediction import predict_motion, predict_motion_numpy
from slam_graph.kernels.near_pairs import near_pairs, near_pairs_numpy
from slam_graph.kernels.projection import points_ahead, points_ahead_numpy
from slam_graph.sensors import ImuBuffer, ImuData, ImuNoise

MEDIAN = 0.6745


@pytest.mark.parametrize("count", [0, 1, 60])
def test_mixture_probabilities(count: int) -> None:
    rng = np.random.default_rng(count)
    squares, chances = rng.chisquare(2, count) * 9.0, rng.uniform(1e-3, 0.2, count)
    depths = np.sort(np.abs(rng.normal(0.0, 5.0, count)))
    squares[: count // 2], depths[: count // 3] = 0.5, 0.2
    given = squares, depths, chances, MEDIAN, 30
    found, expected = mixture_probabilities(*given), mixture_probabilities_numpy(*given)
    assert found.shape == (count,)
    assert np.allclose(found, expected, rtol=0.0, atol=1e-12)
    if count > 1:
        assert found.min() < 0.1
        assert found.max() > 0.9


@pytest.mark.parametrize("width", [2, 3])
def test_drift_consensus(width: int) -> None:
    rng = np.random.default_rng(width)
    J, drift = rng.normal(0.0, 50.0, (40, width, 4)), np.array([0.1, -0.05, 0.02, 0.01])
    offsets = J @ drift + rng.normal(0.0, 1.0, (40, width))
    offsets[25:] = rng.uniform(-50.0, 50.0, (15, width))
    pairs = np.stack([np.arange(24), np.arange(1, 25)], axis=1)
    weights = np.array([0.1, 0.1, 0.1, 0.02]) ** -2.0
    left, expected = np.empty(offsets.shape), np.empty(offsets.shape)
    chosen = drift_consensus(J, offsets, pairs, weights, 3.5, 3, left)
    assert np.array_equal(
        chosen, drift_consensus_numpy(J, offsets, pairs, weights, 3.5, 3, expected)
    )
    assert np.allclose(left, expected, rtol=0.0, atol=1e-9)  # J is some 50, its inverse 1e4
    assert np.count_nonzero(chosen[:25]) > 20
    assert np.count_nonzero(chosen[25:]) < 4


def ahead(kernel: Callable[..., int], *given: object) -> tuple[np.ndarray, np.ndarray]:
    rows, normalized = np.full(50, -1), np.zeros((50, 2))
    count = kernel(*given, rows, normalized)
    return rows[:count], normalized[:count]


def test_points_ahead() -> None:
    rng = np.random.default_rng(3)
    points, used = rng.normal(0.0, 3.0, (50, 3)), rng.random(50) < 0.8
    points[4] = np.nan  # as of a feature without a point
    turn, centre = Rotation.random(random_state=3).as_matrix(), rng.normal(size=3)
    bounds = np.array([[-0.9, -1.2], [1.2, 0.5]])
    found, expected = (
        ahead(kernel, points, used, turn, centre, 0.1, 2.0, bounds)
        for kernel in (points_ahead, points_ahead_numpy)
    )
    assert np.array_equal(found[0], expected[0])
    assert np.allclose(found[1], expected[1], rtol=0.0, atol=1e-12)
    assert 3 < len(found[0]) < np.count_nonzero(used)


@pytest.mark.parametrize("spread", [1e-3, 30.0, 1e5])
def test_near_pairs_of_any_spread(spread: float) -> None:
    rng = np.random.default_rng(4)
    one, other = rng.normal(0.0, spread, (70, 2)), rng.normal(0.0, spread, (90, 2))
    one[3], one[9], other[0] = np.nan, np.inf, 1e300
    other[5], other[7] = np.nan, -np.inf
    other[20:30] = one[20:30] + 1e-3
    found = near_pairs(one, other, 2.0)
    with np.errstate(invalid="ignore", over="ignore"):
        assert np.array_equal(found, near_pairs_numpy(one, other, 2.0))
    assert len(found) >= 10
    assert len(near_pairs(one, np.zeros((0, 2)), 2.0)) == 0


def samples() -> ImuBuffer:
    rng, count = np.random.default_rng(5), 300
    stamps_ns = np.arange(count) * 5_000_000
    stamps_ns[200:] += 60_000_000  # samples that are missing are bridged in short steps
    gyro, accel = (
        np.cumsum(rng.normal(0.0, size, (count, 3)), axis=0) + offset
        for size, offset in ((0.05, 0.0), (0.3, [0.0, 0.0, 9.81]))
    )
    imu = ImuBuffer()
    imu.add(ImuData(stamps_ns, gyro, accel))
    return imu


def test_predict_motion() -> None:
    rng, times_ns = np.random.default_rng(6), np.arange(3, 1500, 47) * 1_000_000
    steps, first = samples().steps_at(times_ns)
    assert np.isclose(steps.durations_s.sum(), (times_ns[-1] - times_ns[0]) * 1e-9)
    known = np.array([0, 1, 7, 20, len(times_ns) - 1])
    start = Rotation.random(len(times_ns), random_state=6).as_matrix()
    places, speeds = rng.normal(size=(2, len(times_ns), 3))
    biases = rng.normal(0.0, 0.1, (2, len(known), 3))
    results = []
    for kernel in (predict_motion, predict_motion_numpy):
        motion = start.copy(), places.copy(), speeds.copy()
        kernel(*steps_of(steps), first, known, *motion, *biases, np.array([0.0, 0.0, -9.81]))
        results.append(motion)
    for found, expected in zip(*results, strict=True):
        assert np.allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())
    assert np.array_equal(results[0][0][0], start[0])
    assert not np.isclose(results[0][1][1], places[1]).any()


def steps_of(steps: object) -> tuple[np.ndarray, ...]:
    return tuple(getattr(steps, name) for name in ("durations_s", "gyro", "accel"))


def test_states_between_keyframes_are_what_gtsam_predicts() -> None:
    imu, params = samples(), ImuNoise().preintegration_params(9.81)
    biases = {"accel_bias": np.array([0.1, -0.2, 0.05]), "gyro_bias": np.array([0.02, 0.01, 0.0])}
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.5), np.array([1.0, 2.0, 3.0]))
    start = NavState(0, pose, np.array([0.3, -0.1, 0.2]), **biases)
    times_ns = np.arange(0, 376_000_001, 47_000_000)  # which divide steps of the IMU
    bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
    predicted = [
        start.predicted(imu.between(0, t).preintegrated(bias, params), t)
        for t in times_ns[1:].tolist()
    ]
    states = fill_in([start, predicted[-1]], times_ns, imu, params)
    for found, expected in zip(states, [start, *predicted], strict=True):
        error = found.world_T_body.localCoordinates(expected.world_T_body)
        assert np.abs(error).max() < 5e-6
        assert np.allclose(found.velocity, expected.velocity, rtol=0.0, atol=1e-5)
    moved = gtsam.Pose3(gtsam.Rot3.Yaw(0.02), np.array([0.1, 0.0, -0.1]))
    there = predicted[-1].world_T_body.compose(moved)
    end = NavState(int(times_ns[-1]), there, predicted[-1].velocity + 0.2, **biases)
    states = fill_in([start, end], times_ns, imu, params)
    halfway = predicted[3].world_T_body.between(states[4].world_T_body)
    assert states[0] is start
    assert states[-1] is end
    # half of the difference at the end is made up for at half of the time
    assert np.allclose(gtsam.Pose3.Logmap(halfway), 0.5 * gtsam.Pose3.Logmap(moved), atol=1e-3)
    assert np.allclose(states[4].velocity, predicted[3].velocity + 0.1, atol=1e-3)
