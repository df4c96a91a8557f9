# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances of the smoothed trajectory: those the dense inverse, and honest."""

from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from gtsam.symbol_shorthand import B, V, X

from benchmarks.policy_product import FLIGHT
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.keyframe_states import in_unknown_world, states_at
from slam_graph.backend.smoothing.recording_cost import (
    EliminatedFeatures,
    LinearCost,
    LinearReprojection,
)
from slam_graph.backend.smoothing.recording_problem import BundleAdjustment
from slam_graph.backend.smoothing.recording_segment import read_segment
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.backend.smoothing.smoothing_task import SegmentStart, SmoothingTask
from slam_graph.backend.smoothing.state_covariances import (
    FrameInterpolation,
    KeyframeCovariances,
    aligned_covariances,
    frame_covariances,
    keyframe_covariances,
)
from slam_graph.backend.smoothing.state_elimination import (
    ChainEquations,
    EliminatedStates,
    StateColumns,
)
from slam_graph.backend.solve.stacked_values import stacked_poses
from slam_graph.backend.solve.state import dim
from slam_graph.backend.world_gauge import gauge_motion, with_unknown_gauge
from slam_graph.config import load_config
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.experiment.tasks import find_sources
from slam_graph.geometry import NavState, StateHistory
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.simulation.simulation_config import (
    FlightConfig,
    SimulatedImuConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

KEYFRAMES, FEATURES = 45, 60
FLIGHTS = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + 5)
DURATION_S = 5.0
FALSE_ALARMS = 1e-3
"""Probability that a mean leaves its band although all covariances are right."""


@dataclass(frozen=True)
class Problem:
    """A random linear problem with the structure of a bundle adjustment, and its dense inverse."""

    values: gtsam.Values
    chain: ChainEquations
    images: LinearReprojection
    gradient: FloatArray
    P: FloatArray

    @property
    def states(self) -> EliminatedStates:
        features = EliminatedFeatures(self.images, KEYFRAMES)
        return EliminatedStates(features.poses, self.chain)

    def joint(self, *keyframes: int) -> FloatArray:
        """The covariance of some states."""
        rows = np.concatenate([np.arange(15 * k, 15 * k + 15) for k in keyframes])
        return self.P[np.ix_(rows, rows)]


def random_values(rng: np.random.Generator) -> gtsam.Values:
    """Keyframe poses anywhere."""
    values = gtsam.Values()
    for k in range(KEYFRAMES):
        turn = gtsam.Rot3.Expmap(rng.normal(size=3))
        values.insert(X(k), gtsam.Pose3(turn, rng.normal(0.0, 3.0, 3)))
    return values


def random_chain(rng: np.random.Generator) -> gtsam.GaussianFactorGraph:
    """Factors between the variables of neighbouring states, and a prior on the first pose."""
    keys = [(X(k), V(k), B(k)) for k in range(KEYFRAMES)]
    pairs = {pair for a, b in pairwise(keys) for pair in combinations(a + b, 2)}
    graph, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(2)
    for a, b in sorted(pairs):
        A, C = rng.normal(size=(2, dim(a))), rng.normal(size=(2, dim(b)))
        graph.push_back(gtsam.JacobianFactor(a, A, b, C, rng.normal(size=2), unit))
    one = gtsam.noiseModel.Unit.Create(6)
    graph.push_back(gtsam.JacobianFactor(X(0), np.eye(6), np.zeros(6), one))
    return graph


def random_images(rng: np.random.Generator) -> LinearReprojection:
    """Linear errors of features in two cameras; some have gaps in their tracks."""
    starts = rng.integers(0, KEYFRAMES - 8, FEATURES)
    seen = [j + np.delete(np.arange(8), range(3, 3 + n % 3)) for n, j in enumerate(starts)]
    feature = np.repeat(np.arange(FEATURES), [2 * len(frames) for frames in seen])
    frame = np.repeat(np.concatenate(seen), 2)
    count = len(frame)
    camera, places = np.arange(count) % 2, np.zeros((count, 2))
    frames = tuple(range(KEYFRAMES))
    obs = Observations(np.arange(FEATURES), frames, feature, frame, camera, places, places)
    r, by_pose = rng.normal(size=(count, 2)), rng.normal(size=(count, 2, 6))
    by_point = rng.normal(size=(count, 2, 3))
    return LinearReprojection(obs, r, by_pose, by_point, np.ones(count), places)


@pytest.fixture
def problem() -> Problem:
    rng = np.random.default_rng(3)
    graph, images = random_chain(rng), random_images(rng)
    ordering = gtsam.Ordering()
    for k in range(KEYFRAMES):
        for key in (X(k), V(k), B(k)):
            ordering.push_back(key)
    A, b = graph.jacobian(ordering)
    H = np.zeros((2 * len(images.obs), A.shape[1] + 3 * FEATURES))
    for n, (k, j) in enumerate(zip(images.obs.frame, images.obs.feature, strict=True)):
        H[2 * n : 2 * n + 2, 15 * k : 15 * k + 6] = images.by_pose[n]
        first = A.shape[1] + 3 * j
        H[2 * n : 2 * n + 2, first : first + 3] = images.by_point[n]
    whole = np.concatenate([np.pad(A, ((0, 0), (0, 3 * FEATURES))), H])
    right = np.concatenate([b, images.r.ravel()])
    P = np.linalg.inv(whole.T @ whole)
    chain = ChainEquations.of(graph, KEYFRAMES)
    return Problem(random_values(rng), chain, images, whole.T @ right, P)


def test_a_step_is_that_of_the_dense_equations(problem: Problem) -> None:
    step = (
        LinearCost(problem.chain, problem.images)
        .factor(0.0)
        .step(LinearCost(problem.chain, problem.images))
    )
    found = np.concatenate([step.states.ravel(), step.points.ravel()])
    np.testing.assert_allclose(found, problem.P @ problem.gradient, rtol=1e-6, atol=1e-8)


def test_products_with_the_covariance_are_those_of_the_dense_inverse(problem: Problem) -> None:
    right = np.random.default_rng(0).normal(size=(KEYFRAMES, 15, 2))
    expected = problem.joint(*range(KEYFRAMES)) @ right.reshape(-1, 2)
    found = problem.states.times_covariance(right)
    np.testing.assert_allclose(found.reshape(-1, 2), expected, rtol=1e-6, atol=1e-8)


def test_a_difference_that_is_known_far_better_than_its_parts_is_not_lost() -> None:
    """Neighbouring states are equal to 1e-5, one of them is known to 1."""
    keyframes, close = 3, 1e10 * np.kron([[1.0, -1.0], [-1.0, 1.0]], np.eye(15))
    information = np.tile(close, (keyframes - 1, 1, 1))
    information[0, :15, :15] += np.eye(15)
    chain = ChainEquations(information, np.zeros((keyframes, 15)))
    none = np.zeros((StateColumns.of(keyframes).size,) * 2)
    apart = np.concatenate([np.eye(15), -np.eye(15)], axis=1)
    for P in EliminatedStates(none, chain).pair_covariances():
        np.testing.assert_allclose(apart @ P @ apart.T, 1e-10 * np.eye(15), atol=1e-14)
        np.testing.assert_allclose(P[:15, :15], np.eye(15), atol=1e-4)


def test_what_is_not_determined_is_refused() -> None:
    chain = ChainEquations(np.zeros((2, 30, 30)), np.zeros((3, 15)))
    with pytest.raises(np.linalg.LinAlgError):
        EliminatedStates(np.zeros((StateColumns.of(3).size,) * 2), chain)


def test_covariances_at_keyframes_and_after_alignment_are_those_of_the_dense_inverse(
    problem: Problem,
) -> None:
    weights = np.full(KEYFRAMES, 1.0 / KEYFRAMES)
    known = keyframe_covariances(problem.states, problem.values, weights)
    for k, pair in enumerate(known.pairs):
        np.testing.assert_allclose(pair, problem.joint(k, k + 1), rtol=1e-6, atol=1e-9)
    stamps = np.arange(KEYFRAMES) * 10**8
    frames = FrameInterpolation.of(stamps, np.arange(KEYFRAMES), np.zeros((KEYFRAMES - 1, 2)))
    rotations, positions = stacked_poses(problem.values, range(KEYFRAMES))
    states = frame_covariances(known, frames, rotations)
    for k in range(KEYFRAMES):
        np.testing.assert_allclose(states[k], problem.joint(k), rtol=1e-6, atol=1e-9)
    turn = np.zeros((6 * KEYFRAMES, 6 * KEYFRAMES))  # from the body frame into the world
    for k, R in enumerate(rotations):
        turn[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] = R
        turn[6 * k + 3 : 6 * k + 6, 6 * k + 3 : 6 * k + 6] = R
    N = gauge_motion(positions - positions.mean(axis=0)).reshape(-1, 4)
    W = np.where(np.arange(6 * KEYFRAMES)[:, None] % 6 < 3, 0.0, N)
    aligned = np.eye(6 * KEYFRAMES) - N @ np.linalg.solve(W.T @ W, W.T)
    poses = (15 * np.arange(KEYFRAMES)[:, None] + np.arange(6)).ravel()
    P = turn.T @ aligned @ turn @ problem.P[np.ix_(poses, poses)]
    P = P @ turn.T @ aligned.T @ turn
    found = aligned_covariances(known, frames, rotations, positions)
    assert found is not None
    for k in range(KEYFRAMES):
        own = slice(6 * k, 6 * k + 6)
        np.testing.assert_allclose(found[k], P[own, own], rtol=1e-6, atol=1e-9)


def test_between_keyframes_errors_are_interpolated_and_the_imu_adds_a_bridge() -> None:
    """Against samples of the errors: random walks of rotation and velocity, position from it."""
    rng, draws, steps = np.random.default_rng(0), 4000, 40
    interval_s, gyro, accel = 0.2, 0.3, 0.5
    dt = interval_s / steps
    white = rng.normal(0.0, np.sqrt(dt), (2, draws, steps))
    walk, speed = gyro * white[0].cumsum(axis=1), accel * white[1].cumsum(axis=1)
    place = (speed - 0.5 * accel * white[1]).cumsum(axis=1) * dt
    known = KeyframeCovariances(
        np.tile(np.eye(3), (2, 1, 1)), np.zeros((1, 30, 30)), None, np.zeros((4, 4)), np.zeros(3)
    )
    stamps = np.arange(steps + 1) * 10**6
    densities = np.array([[gyro, accel]])
    frames = FrameInterpolation.of(stamps * 5, np.array([0, steps]), densities)
    P = frame_covariances(known, frames, np.tile(np.eye(3), (steps + 1, 1, 1)))
    part = np.arange(1, steps + 1) / steps
    for row, errors in ((0, walk), (3, place), (6, speed)):
        sampled = np.var(errors - part * errors[:, -1:], axis=0)
        np.testing.assert_allclose(P[1:, row, row], sampled, rtol=0.15, atol=1e-5 * sampled.max())


def flown(seed: int) -> RunResult:
    """A run on a simulated flight with stereo cameras, and exactly the noise that is assumed."""
    (source,) = find_sources(["sim:figure8"], DURATION_S, FLIGHT)
    return run(
        source.open(seed, 2), load_config(algorithm="msckf", overrides=["cameras=2", BELIEVED])
    )


@pytest.fixture(scope="module")
def flights() -> list[RunResult]:
    return [flown(seed) for seed in FLIGHTS]


@pytest.mark.parametrize("part", ["orientation", "position"])
def test_errors_are_as_large_as_the_covariances_say(flights: list[RunResult], part: str) -> None:
    """Frames of one flight are correlated, so the flights are the samples."""
    low, high = mean_bounds(3, len(FLIGHTS), 1.0 - FALSE_ALARMS)
    means = [flight.metrics["final_ba"]["nees"][part]["mean"] for flight in flights]
    assert low < np.mean(means) < high, means


def test_the_whole_recording_leaves_no_more_uncertain_than_its_past(
    flights: list[RunResult],
) -> None:
    """Relative to the first state, from a second on, as the smoothed one is exact at a keyframe.

    Biases are left out: the adjustment does not know those of the given start.
    """
    ratios = []
    for flight in flights:
        smoothed, sigmas = flight.smoothed, flight.smoothed_sigmas
        assert smoothed is not None
        assert sigmas is not None
        late = flight.trajectory.stamps_ns > flight.trajectory.stamps_ns[0] + 10**9
        causal = flight.sigmas[late]
        rows = np.isin(smoothed.stamps_ns, flight.trajectory.stamps_ns[late])
        for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
            before = np.linalg.norm(causal[:, part], axis=1)
            ratios.append(np.linalg.norm(sigmas[rows][:, part], axis=1) / before)
    assert np.max(ratios) < 1.1


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_the_noise_of_the_imu_is_found_from_the_residuals(scale: float, tmp_path: Path) -> None:
    """With noise as assumed and four times as large; walks are held by the prior redundancy."""
    tracks = TrackConfig(features=100, pixel_sigma=0.3)
    imu = SimulatedImuConfig(noise_scale=scale)
    flight = SimulationConfig(
        cameras=2,
        duration_s=20.0,
        rate_hz=10.0,
        tracks=tracks,
        imu=imu,
        flight=FlightConfig(hover_s=0.0),
    )
    sequence, config = simulate(flight), FinalBaConfig()
    backend = BackendConfig()
    with FrameLog.recording(sequence.rig, config, tmp_path) as log:
        for packet in sequence.packets():
            log.add(packet.imu, packet.frame, (1.0, 1.0))
    segment = read_segment(log, log.keyframes, sequence.rig, backend.zero_velocity)
    task = SmoothingTask(sequence.rig, backend, config)
    truth = sequence.groundtruth()
    stamps_ns = segment.keyframe_stamps_ns
    states = states_at(truth, stamps_ns, segment.imu, task.preintegration)
    problem = BundleAdjustment(SegmentStart(segment, states, 0), task, lambda *_: None)
    problem.solve()
    found = problem.imu_noise
    np.testing.assert_allclose([found.gyro, found.accel], scale, rtol=0.25)


@pytest.mark.parametrize("gauge", [4, 6])
def test_states_of_a_world_that_nothing_joins_are_as_unknown_as_it(gauge: int) -> None:
    """The covariances of a history are those that each state has with it."""
    rng, unknown = np.random.default_rng(gauge), np.diag([1e6] * 3 + [np.pi**2] * (gauge - 3))
    history, expected = StateHistory(), StateHistory()
    first = rng.normal(size=3)
    for k in range(4):
        place = first if k == 0 else rng.normal(size=3)
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), place)
        v, accel, gyro = rng.normal(size=(3, 3))
        covariance = np.diag(rng.uniform(1e-10, 1e-6, 15))
        state = NavState(k, pose, v, accel_bias=accel, gyro_bias=gyro, covariance=covariance)
        history.append(state)
        expected.append(with_unknown_gauge(state, unknown, first))
    found = in_unknown_world(history, unknown)
    np.testing.assert_allclose(found.sigmas(), expected.sigmas(), rtol=1e-9)
    np.testing.assert_allclose(found.pose_covariances(), expected.pose_covariances(), 1e-9, 1e-6)
    assert in_unknown_world(history, np.zeros((4, 4))) is history
