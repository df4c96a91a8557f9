# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The χ² gate: correct measurements are distributed as it assumes, wrong ones are rejected."""

from dataclasses import astuple, dataclass, replace

import gtsam
import numpy as np
import pytest
from flight import Flight, rig, room, scene
from gtsam.symbol_shorthand import L, X
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, GatingConfig, NoiseConfig
from slam_graph.backend.cost.consensus_gate import gate_by_consensus
from slam_graph.backend.cost.cost import Cost, Linearization, TrackFeatures
from slam_graph.backend.cost.feature_factors import WhitenedObservations
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.gating import (
    Innovations,
    distances_of_tracks,
    squared_mahalanobis,
    threshold,
)
from slam_graph.backend.cost.measurement_rows import gated_columns
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.cost.whitened_update import gate_root, gated_rows
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.geometry.trajectory import NavState

FRAMES = 5
SIGMA_PX = 0.8
CONFIG = BackendConfig(
    noise=NoiseConfig(pixel_sigma=SIGMA_PX), gating=GatingConfig(robust_loss="none")
)
CAMERAS = rig(2)
PROJECTION = RigProjection(CAMERAS)


@dataclass
class Trial:
    """Features seen from poses whose estimates are wrong by a draw from their covariance."""

    obs: Observations
    layout: Layout
    covariance: FloatArray
    state: State


def trial(rng: np.random.Generator) -> Trial:
    """A scene at a random time; errors are small, so that the problem is nearly linear."""
    start = rng.uniform(0.0, 20.0)
    times = np.array([start + 0.25 * k for k in range(FRAMES)])
    obs, truth = scene(Flight(), CAMERAS, room(20, rng), times, rng, SIGMA_PX, FRAMES)
    root = rng.normal(size=(6 * FRAMES, 6 * FRAMES)) / np.sqrt(6 * FRAMES)
    scale = np.tile(np.repeat([2e-3, 8e-3], 3), FRAMES)
    root = scale[:, None] * root
    error = (root @ rng.normal(size=6 * FRAMES)).reshape(FRAMES, 6)
    state = State()
    for i in range(FRAMES):
        pose = gtsam.Pose3(gtsam.Rot3(truth.rotations[i]), truth.positions[i])
        zeros = {name: np.zeros(3) for name in ("velocity", "accel_bias", "gyro_bias")}
        state.insert_imu_state(i, NavState(0, pose.retract(error[i]), **zeros))
    layout = Layout(dims_of(X(i) for i in range(FRAMES)))
    return Trial(obs, layout, root @ root.T, state)


def track_cost(case: Trial) -> tuple[Cost, Linearization]:
    """The features as new ones, triangulated from the wrong poses."""
    poses = [case.state.estimate.atPose3(X(i)).matrix() for i in range(FRAMES)]
    R, p = np.array(poses)[:, :3, :3], np.array(poses)[:, :3, 3]
    points = triangulate(case.obs, PROJECTION, R, p, CONFIG.triangulation).points
    cost = Cost(case.state, PROJECTION, CONFIG, SquareRootInformation.empty())
    cost.tracks = TrackFeatures(case.obs, points, np.zeros(len(points), np.bool_))
    return cost, cost.linearize()


def tracked_cost(
    case: Trial, rng: np.random.Generator
) -> tuple[Cost, Linearization, FloatArray, Layout]:
    """The features as variables of the state, with errors and covariance of their own."""
    truth = track_cost(case)[0].tracks
    assert truth is not None
    layout = case.layout.extended(dims_of(L(j) for j in case.obs.ids.tolist()))
    sigma = 0.01
    P = np.eye(layout.size) * sigma**2
    P[: case.layout.size, : case.layout.size] = case.covariance
    for j, point in zip(case.obs.ids.tolist(), truth.points, strict=True):
        case.state.insert_point(j, point + rng.normal(0.0, sigma, 3))
    cost = Cost(case.state, PROJECTION, CONFIG, SquareRootInformation.empty())
    cost.landmarks = case.obs
    return cost, cost.linearize(), P, layout


def known(covariance: FloatArray, layout: Layout) -> SquareRootInformation:
    """What is known before: a mean of zero with this covariance."""
    Rd = np.zeros((layout.size + 1, layout.size + 1), order="F")
    Rd[:-1, :-1] = np.linalg.cholesky(np.linalg.inv(covariance)).T
    return SquareRootInformation(layout, Rd)


@pytest.fixture(scope="module")
def solved() -> list[tuple[Trial, Cost, Linearization]]:
    """Many scenes, each with its new features linearised."""
    rng = np.random.default_rng(17)
    trials = [case for case in (trial(rng) for _ in range(300)) if len(case.obs.ids)]
    assert len(trials) > 200
    return [(case, *track_cost(case)) for case in trials]


def quantiles(solved: list[tuple[Trial, Cost, Linearization]], scale: float) -> list[float]:
    """Of one feature of each scene, because those of one scene share the errors of its poses."""
    found = []
    for case, _, linear in solved:
        assert isinstance(linear.tracks, WhitenedObservations)
        distances = distances_of_tracks(case.obs, linear.tracks, scale * case.covariance)
        found.append(float(chi2.cdf(distances[0], 2 * case.obs.counts[0] - 3)))
    return found


def test_distances_of_new_features_are_chi_squared(
    solved: list[tuple[Trial, Cost, Linearization]],
) -> None:
    assert kstest(quantiles(solved, 1.0), "uniform").pvalue > 0.01


@pytest.mark.parametrize("scale", [0.0, 0.25, 4.0])
def test_distances_under_a_wrong_covariance_are_not(
    solved: list[tuple[Trial, Cost, Linearization]], scale: float
) -> None:
    """The test above has the power to see a covariance that is too small or too large."""
    assert kstest(quantiles(solved, scale), "uniform").pvalue < 1e-4


def test_distances_of_tracked_observations_are_chi_squared() -> None:
    """The true points are drawn around, so that errors of pose and point are independent."""
    rng = np.random.default_rng(23)
    distances = []
    for _ in range(250):
        start = rng.uniform(0.0, 20.0)
        times = np.array([start + 0.25 * k for k in range(FRAMES)])
        obs, at = scene(Flight(), CAMERAS, room(8, rng), times, rng, SIGMA_PX)
        if len(obs) == 0:
            continue
        root = rng.normal(size=(9, 9)) * np.repeat([3e-4, 2e-3, 2e-3], 3)[:, None]
        error = root @ rng.normal(size=9)
        turns = np.broadcast_to(Rotation.from_rotvec(error[:3]).as_matrix(), (FRAMES, 3, 3))
        wrong = Geometry(
            at.rotations @ turns,
            at.positions + at.rotations @ error[3:6],
            at.points + error[6:],
        )
        row = np.arange(len(obs)) == rng.integers(len(obs))
        one = obs.rows(row)
        by_pose, by_point = PROJECTION.jacobians(one, wrong)
        H = np.concatenate([by_pose, by_point], axis=2) / SIGMA_PX
        r = PROJECTION.residuals(one, wrong)[0] / SIGMA_PX
        distances.append(float(squared_mahalanobis(r, H, root @ root.T)[0]))
    assert kstest(distances, chi2(2).cdf).pvalue > 0.01


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_the_gate_passes_its_share_of_correct_features(
    solved: list[tuple[Trial, Cost, Linearization]], confidence: float
) -> None:
    gating = GatingConfig(robust_loss="none", confidence=confidence)
    config = CONFIG.model_copy(update={"gating": gating})
    passed: list[bool] = []
    for case, cost, linear in solved:
        gate = replace(cost, config=config).gate(linear, known(case.covariance, case.layout))
        assert len(gate.landmarks) == 0
        passed += gate.tracks.tolist()
        assert gate.innovations.tested == len(gate.tracks)
        assert gate.innovations.rejected == np.sum(~gate.tracks)
    error = np.sqrt(confidence * (1 - confidence) / len(passed))
    assert abs(np.mean(passed) - confidence) < 4 * error + 0.01


def test_wrong_features_are_rejected_and_right_ones_are_not() -> None:
    rng = np.random.default_rng(31)
    caught = spared = wrong = right = 0
    for _ in range(60):
        case = trial(rng)
        if len(case.obs.ids) < 2:
            continue
        bad = np.arange(len(case.obs.ids)) % 2 == 0
        rows = np.flatnonzero(bad[case.obs.feature] & (case.obs.slots == 3))
        case.obs.pixels[rows] += 15.0 * rng.choice([-1.0, 1.0], (len(rows), 2))
        cost, linear = track_cost(case)
        tracks = cost.gate(linear, known(case.covariance, case.layout)).tracks
        caught, wrong = caught + int((~tracks[bad]).sum()), wrong + int(bad.sum())
        spared, right = spared + int(tracks[~bad].sum()), right + int((~bad).sum())
    assert wrong > 50
    assert caught == wrong
    assert spared > 0.9 * right


def test_wrong_tracked_observations_are_rejected_one_by_one() -> None:
    rng = np.random.default_rng(37)
    case = trial(rng)
    while len(case.obs.ids) < 3:
        case = trial(rng)
    bad = np.arange(len(case.obs)) % 4 == 1
    cost, _, P, layout = tracked_cost(case, rng)
    assert cost.landmarks is not None
    case.obs.pixels[bad] += 60.0
    gate = cost.gate(cost.linearize(), known(P, layout))
    assert len(gate.tracks) == 0
    assert not gate.landmarks[bad].any()
    assert gate.landmarks[~bad].mean() > 0.8


@pytest.fixture(scope="module")
def mixed() -> tuple[Cost, Linearization, SquareRootInformation]:
    """A cost with four features of the state and as many new ones or more."""
    rng = np.random.default_rng(47)
    case = trial(rng)
    while len(case.obs.ids) < 8:
        case = trial(rng)
    held = np.arange(len(case.obs.ids)) < 4
    both = track_cost(case)[0].tracks
    assert both is not None
    cost, _, P, layout = tracked_cost(replace(case, obs=case.obs.subset(held)), rng)
    cost.tracks = both.subset(~held)
    return cost, cost.linearize(), known(P, layout)


@pytest.mark.parametrize("some", [False, True])
def test_the_gate_is_the_same_where_roots_and_rows_are_known_already(
    mixed: tuple[Cost, Linearization, SquareRootInformation], some: bool
) -> None:
    cost, linear, predicted = mixed
    assert cost.landmarks is not None
    assert cost.tracks is not None
    assert linear.landmarks is not None
    tested = np.arange(len(cost.tracks.obs.ids)) % 2 == 0 if some else None
    obs = cost.tracks.obs if tested is None else cost.tracks.obs.subset(tested)
    obs = obs.without_idle_frames()
    columns, poses = gated_columns(cost.landmarks, obs, cost.rig, predicted.layout)
    roots = (
        gate_root(predicted, columns, poses),
        gated_rows(predicted, columns, poses, linear.landmarks.H),
    )
    distances = [root.distances(linear.landmarks) for root in roots]
    np.testing.assert_allclose(distances[1], distances[0], rtol=1e-9)
    gate = cost.gate(linear, predicted, tested)
    assert gate.innovations.tested == len(cost.landmarks) + len(obs.ids)
    for root in roots:
        found = cost.gate(linear, predicted, tested, known=root)
        np.testing.assert_array_equal(found.landmarks, gate.landmarks)
        np.testing.assert_array_equal(found.tracks, gate.tracks)
        np.testing.assert_allclose(astuple(found.innovations), astuple(gate.innovations))


def test_what_is_too_near_does_not_pass(
    mixed: tuple[Cost, Linearization, SquareRootInformation],
) -> None:
    cost, linear, predicted = mixed
    assert linear.landmarks is not None
    passed = cost.gate(linear, predicted).landmarks
    nearest_m = float(np.median(linear.landmarks.depths))
    triangulation = cost.config.triangulation.model_copy(update={"min_depth_m": nearest_m})
    config = cost.config.model_copy(update={"triangulation": triangulation})
    far = linear.landmarks.depths >= nearest_m
    gate = replace(cost, config=config).gate(linear, predicted)
    np.testing.assert_array_equal(gate.landmarks, passed & far)
    assert passed[~far].any()


def test_new_features_none_of_which_is_tested_all_fail(
    mixed: tuple[Cost, Linearization, SquareRootInformation],
) -> None:
    cost, linear, predicted = mixed
    assert cost.landmarks is not None
    assert cost.tracks is not None
    none = np.zeros(len(cost.tracks.obs.ids), np.bool_)
    gate = cost.gate(linear, predicted, tested=none)
    np.testing.assert_array_equal(gate.tracks, none)
    assert gate.innovations.tested == len(cost.landmarks)


def test_thresholds_are_quantiles() -> None:
    dof = np.array([2, 1, 27, 3])
    np.testing.assert_allclose(threshold(dof, 0.95), chi2.ppf(0.95, dof))
    assert len(threshold(np.zeros(0, np.int64), 0.95)) == 0


@pytest.mark.parametrize("dof", [2, 5, 40])
def test_what_the_gate_cuts_off_is_known(dof: int) -> None:
    """Of correct measurements, those that pass have the mean distance that is expected of them."""
    distances = np.random.default_rng(41).chisquare(dof, 20_000)
    k = np.full(len(distances), dof)
    largest = threshold(k, 0.9)
    sums = Innovations.of(distances, k, largest, distances < largest)
    assert sums.rejected == pytest.approx(0.1 * sums.tested, rel=0.1)
    assert sums.distance == pytest.approx(sums.dof, rel=0.02)
    assert sums.passed_distance == pytest.approx(sums.expected, rel=0.02)
    assert sums.expected < sums.passed_dof
    assert astuple(sums + sums) == pytest.approx([2 * value for value in astuple(sums)])


def test_the_joint_distance_is_what_measurements_add_to_the_least_cost() -> None:
    rng = np.random.default_rng(43)
    A, b = rng.normal(size=(7, 4)), rng.normal(size=7)
    triangle = np.triu(rng.normal(size=(5, 5))) + 2.0 * np.eye(5)
    predicted = SquareRootInformation(Layout({1: 4}), np.asfortranarray(triangle))
    posterior = predicted.updated(np.column_stack([A, b]))
    r = b - A @ predicted.solution()
    expected = r @ np.linalg.solve(A @ predicted.covariance() @ A.T + np.eye(7), r)
    assert posterior.residual - predicted.residual == pytest.approx(expected)


def seen_by_a_lost_camera(
    rng: np.random.Generator, shift_px: float
) -> tuple[Cost, SquareRootInformation, np.ndarray]:
    """Features of the state in one frame whose pose is hardly known, every seventh of them moved.

    Returns:
        The cost, what is known before, and which observations (N,) are of features that moved.
    """
    times = np.array([rng.uniform(0.0, 20.0)])
    obs, truth = scene(Flight(), CAMERAS, room(300, rng), times, rng, SIGMA_PX, 1)
    both = obs.subset(obs.counts == 2)
    moved = both.feature % 7 == 0
    both.pixels[moved, 0] += shift_px
    state = State()
    pose = gtsam.Pose3(gtsam.Rot3(truth.rotations[0]), truth.positions[0])
    zeros = {name: np.zeros(3) for name in ("velocity", "accel_bias", "gyro_bias")}
    state.insert_imu_state(0, NavState(0, pose, **zeros))
    sigma_m = 0.005
    for j, point in zip(both.ids.tolist(), truth.points[obs.counts == 2], strict=True):
        state.insert_point(j, point + rng.normal(0.0, sigma_m, 3))
    layout = Layout(dims_of([X(0), *(L(j) for j in both.ids.tolist())]))
    sigmas = np.full(layout.size, sigma_m)
    sigmas[:6] = np.repeat([0.2, 0.5], 3)
    cost = Cost(state, PROJECTION, CONFIG, SquareRootInformation.empty())
    cost.landmarks = both
    return cost, known(np.diag(sigmas**2), layout), moved


def test_what_moves_passes_a_vague_prediction_but_not_the_consensus() -> None:
    rng = np.random.default_rng(23)
    for _ in range(5):
        cost, predicted, moved = seen_by_a_lost_camera(rng, 8.0 * SIGMA_PX)
        linear = cost.linearize()
        plain, found = (f(cost, linear, predicted) for f in (Cost.gate, gate_by_consensus))
        assert np.sum(moved) >= 6
        assert plain.landmarks.all()
        assert np.mean(found.landmarks[moved]) < 0.1
        assert np.mean(found.landmarks[~moved]) > 0.97
        assert found.innovations.passed_dof == 2 * np.sum(found.landmarks)
        assert found.innovations.rejected == np.sum(~found.landmarks)
