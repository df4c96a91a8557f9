# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances of the smoothed trajectory: those the dense inverse, and honest."""

from itertools import combinations, pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X

from benchmarks.policy_product import FLIGHT
from benchmarks.recordings import FIRST_HELD_OUT_SEED
from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.smoothing.bayes_tree import (
    Clique,
    cliques_of,
    joint_root_covariances,
    solved,
)
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.keyframe_states import states_at
from slam_graph.backend.smoothing.recording_problem import (
    BundleAdjustment,
    SegmentStart,
    SmoothingTask,
)
from slam_graph.backend.smoothing.recording_segment import read_segment
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.backend.smoothing.state_covariances import (
    FrameInterpolation,
    KeyframeCovariances,
    aligned_covariances,
    frame_covariances,
    gauge_motion,
    keyframe_covariances,
)
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dim, stacked_poses
from slam_graph.config import load_config
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.experiment.tasks import find_sources
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.simulation.simulation_config import (
    FlightConfig,
    SimulatedImuConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

KEYFRAMES, FEATURES = 6, 8
FLIGHTS = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + 5)
DURATION_S = 5.0
FALSE_ALARMS = 1e-3
"""Probability that a mean leaves its band although all covariances are right."""


def random_values(rng: np.random.Generator) -> gtsam.Values:
    """Keyframe states and features anywhere."""
    values = gtsam.Values()
    for k in range(KEYFRAMES):
        turn = gtsam.Rot3.Expmap(rng.normal(size=3))
        values.insert(X(k), gtsam.Pose3(turn, rng.normal(0.0, 3.0, 3)))
        values.insert(V(k), rng.normal(size=3))
        values.insert(B(k), gtsam.imuBias.ConstantBias(rng.normal(size=3), rng.normal(size=3)))
    for j in range(FEATURES):
        values.insert(L(j), rng.normal(size=3))
    return values


def random_graph(rng: np.random.Generator, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """Linear factors between the pairs of variables that a bundle adjustment connects."""
    states = [(X(k), V(k), B(k)) for k in range(KEYFRAMES)]
    pairs = {pair for a, b in pairwise(states) for pair in combinations(a + b, 2)}
    for j in range(FEATURES):
        pairs |= {(X(k), L(j)) for k in range(j % 3, min(j % 3 + 3 + j % 2, KEYFRAMES))}
    graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(2)
    for a, b in sorted(pairs):
        A, C = rng.normal(size=(2, dim(a))), rng.normal(size=(2, dim(b)))
        factor = gtsam.JacobianFactor(a, A, b, C, np.zeros(2), unit)
        graph.push_back(gtsam.LinearContainerFactor(factor, values))
    graph.push_back(
        gtsam.PriorFactorPose3(X(0), values.atPose3(X(0)), gtsam.noiseModel.Unit.Create(6))
    )
    return graph


class Dense:
    """The dense inverse of the information of a graph."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        keys = list(values.keys())
        ordering = gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        information, _ = graph.linearize(values).hessian(ordering)
        self.P = np.linalg.inv(information)
        ends = np.cumsum([dim(key) for key in keys]).tolist()
        self.rows = {k: np.arange(a, b) for k, a, b in zip(keys, [0, *ends], ends, strict=False)}

    def joint(self, keys: list[int]) -> FloatArray:
        rows = np.concatenate([self.rows[key] for key in keys])
        return np.asarray(self.P[np.ix_(rows, rows)])


@pytest.fixture
def problem() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, Dense]:
    rng = np.random.default_rng(3)
    values = random_values(rng)
    graph = random_graph(rng, values)
    return graph, values, Dense(graph, values)


Problem = tuple[gtsam.NonlinearFactorGraph, gtsam.Values, Dense]


def test_covariances_of_cliques_are_those_of_the_dense_inverse(problem: Problem) -> None:
    graph, values, dense = problem
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    wanted = {key for key in values.keys() if dim(key) != 3 or key >= V(0)}  # noqa: SIM118
    cliques = cliques_of(graph.linearize(values).eliminateMultifrontal(ordering), wanted)
    covered = set()
    for clique, U in joint_root_covariances(cliques):
        assert not np.tril(U, -1).any()
        expected = dense.joint(list(clique.layout.dims))
        np.testing.assert_allclose(U @ U.T, expected, rtol=1e-6, atol=1e-9)
        covered |= set(clique.frontals)
    assert covered >= wanted
    right = {X(k): np.random.default_rng(k).normal(size=(6, 2)) for k in range(KEYFRAMES)}
    found = solved(cliques, right)
    keys = list(right)
    expected = dense.joint(keys) @ np.concatenate(list(right.values()))
    np.testing.assert_allclose(np.concatenate([found[k] for k in keys]), expected, rtol=1e-6)


def test_a_difference_that_is_known_far_better_than_its_parts_is_not_lost() -> None:
    """A parent knows x - y to 1e-7 and x + y to 1; its child is 1e7 (x - y) with an error of 1."""
    rows = np.array([[1e7, -1e7, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    lever = np.zeros((3, 3))
    lever[0, :2] = -1e7, 1e7
    above, both = Layout({V(0): 3}), Layout({V(1): 3, V(0): 3})
    parent = Clique(above, [V(0)], np.linalg.qr(rows)[1], np.zeros((3, 0)), -1, np.r_[:0])
    child = Clique(both, [V(1)], np.eye(3), lever, 0, np.arange(3))
    _, (_, U) = joint_root_covariances([parent, child])
    np.testing.assert_allclose((U @ U.T)[:3, :3], np.diag([2.0, 1.0, 1.0]), atol=1e-6)


def test_covariances_at_keyframes_and_after_alignment_are_those_of_the_dense_inverse(
    problem: Problem,
) -> None:
    graph, values, dense = problem
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    weights = np.full(KEYFRAMES, 1.0 / KEYFRAMES)
    tree = graph.linearize(values).eliminateMultifrontal(ordering)
    wanted = {key(k) for key in (X, V, B) for k in range(KEYFRAMES)}
    known = keyframe_covariances(cliques_of(tree, wanted), values, weights)
    stamps = np.arange(KEYFRAMES) * 10**8
    frames = FrameInterpolation.of(stamps, np.arange(KEYFRAMES), np.zeros((KEYFRAMES - 1, 2)))
    rotations, positions = stacked_poses(values, range(KEYFRAMES))
    states = frame_covariances(known, frames, rotations)
    for k in range(KEYFRAMES):
        np.testing.assert_allclose(states[k], dense.joint([X(k), V(k), B(k)]), rtol=1e-6, atol=1e-9)
    turn = np.zeros((6 * KEYFRAMES, 6 * KEYFRAMES))  # from the body frame into the world
    for k, R in enumerate(rotations):
        turn[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] = R
        turn[6 * k + 3 : 6 * k + 6, 6 * k + 3 : 6 * k + 6] = R
    N = gauge_motion(positions - positions.mean(axis=0)).reshape(-1, 4)
    W = np.where(np.arange(6 * KEYFRAMES)[:, None] % 6 < 3, 0.0, N)
    aligned = np.eye(6 * KEYFRAMES) - N @ np.linalg.solve(W.T @ W, W.T)
    P = turn.T @ aligned @ turn @ dense.joint([X(k) for k in range(KEYFRAMES)])
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
    return run(source.open(seed, 2), load_config(algorithm="msckf", overrides=["cameras=2"]))


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
