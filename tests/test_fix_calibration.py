# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Lever arm and clock of position fixes as variables: laws of the factors, and whole runs."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import V, X

from slam_graph import run
from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.fix_calibration import (
    ARM,
    CLOCK,
    FixVariables,
    SeenFixes,
    calibrated_factor,
)
from slam_graph.backend.aiding.fix_factors import PositionFix
from slam_graph.backend.aiding.path_of_fixes import PathFix
from slam_graph.backend.aiding.regauging import with_free_gauge
from slam_graph.backend.aiding.world_alignment import align_world
from slam_graph.backend.backend_config import GnssConfig
from slam_graph.backend.smoothing.calibrated_fixes import CalibratedFixes, EliminatedFixes
from slam_graph.backend.smoothing.state_elimination import (
    ChainEquations,
    EliminatedStates,
    StateColumns,
)
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import dims_of
from slam_graph.errors import ConfigError
from slam_graph.sensors import AidingData
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

BOTH = GnssConfig(lever_arm_sigma_m=0.2, time_offset_sigma_s=0.05)
ONES = [
    GnssConfig(lever_arm_sigma_m=0.2),
    GnssConfig(time_offset_sigma_s=0.05),
]
TRUE_ARM, LATE_S = np.array([0.3, -0.1, 0.2]), 0.05


def random_pose(rng: np.random.Generator) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), 5.0 * rng.normal(size=3))


def seen_fixes(rng: np.random.Generator, count: int) -> SeenFixes:
    """Fixes that were measured near poses, at moving antennas."""
    fixes = [PositionFix(0, rng.normal(size=3), np.eye(3), np.zeros(3)) for _ in range(count)]
    poses = [(random_pose(rng), random_pose(rng)) for _ in range(count)]
    return SeenFixes.of(fixes, poses, rng.normal(size=(count, 3)), 0.02)


# --- laws ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [BOTH, *ONES])
def test_jacobians_of_a_fix_are_the_numerical_ones(config: GnssConfig) -> None:
    rng, variables = np.random.default_rng(1), FixVariables(config)
    held = np.array([0.03, *rng.normal(size=3)])
    covariance = np.diag([1.0, 2.0, 4.0])
    factor = calibrated_factor(X(0), seen_fixes(rng, 1), covariance, variables, held)
    values = variables.values(held)
    values.insert(X(0), random_pose(rng))
    linear = gtsam.JacobianFactor(factor.linearize(values))
    A, _ = linear.jacobian()
    keys, step = list(linear.keys()), 1e-6
    layout = Layout(dims_of(keys))

    def error(delta: FloatArray) -> FloatArray:
        tangents = gtsam.VectorValues()
        for key in keys:
            tangents.insert(key, delta[layout.columns[key]])
        return np.asarray(factor.whitenedError(values.retract(tangents)))

    columns = [(error(step * e) - error(-step * e)) / (2 * step) for e in np.eye(layout.size)]
    assert np.abs(A - np.array(columns).T).max() < 1e-8


def test_a_fix_vanishes_at_the_true_lever_arm_and_time() -> None:
    """A body that turns and moves evenly, seen from a pose 0.04 s after the fix."""
    rng, arm, late = np.random.default_rng(2), np.array([0.3, -0.2, 0.5]), 1e-4
    now, twist = random_pose(rng), np.array([0.3, -0.5, 0.2, 1.0, 0.4, -0.7])

    def at(seconds: float) -> gtsam.Pose3:
        return now.compose(gtsam.Pose3.Expmap(seconds * twist))

    position = np.asarray(at(-0.04 + late).transformFrom(arm))
    fix = PositionFix(0, position, np.eye(3), arm)
    ends = [np.asarray(at(-0.04 + t).transformFrom(arm)) for t in (-1e-4, 1e-4)]
    seen = SeenFixes.of([fix], [(at(-0.04), now)], (ends[1] - ends[0]) / 2e-4, 0.02)
    R, p = now.rotation().matrix()[None], np.asarray(now.translation())[None]
    assert np.abs(seen.residuals(R, p, np.append(0.02 + late, arm))).max() < 1e-7
    assert np.abs(seen.residuals(R, p, np.append(0.02, arm))).max() > 5e-5


def test_variables_enter_with_what_the_alignment_knows_of_them() -> None:
    """Their covariance, and that with the world, is the joint one."""
    rng = np.random.default_rng(3)
    layout = Layout(dims_of([X(0), V(0)]))
    prior = SquareRootInformation(layout, triangularize(rng.normal(size=(30, layout.size + 1))))
    N, root = rng.normal(size=(layout.size, 4)), rng.normal(size=(8, 8))
    joint = root @ root.T
    freed = with_free_gauge(prior, N, joint, (CLOCK, ARM))
    M = np.vstack([np.hstack([N, np.zeros((layout.size, 4))]), np.eye(8)[4:]])
    expected = M @ joint @ M.T
    expected[: layout.size, : layout.size] += prior.covariance()
    assert np.allclose(freed.covariance(), expected)
    assert np.allclose(freed.solution(), np.append(prior.solution(), np.zeros(4)))


def test_the_alignment_knows_the_lever_arm_as_well_as_it_says() -> None:
    """NEES of time offset and lever arm over 40 draws of a path that turns about all axes."""
    rng, squares = np.random.default_rng(4), []
    way = np.linspace(0.0, 4 * np.pi, 80)
    places = np.column_stack([6 * np.cos(way), 4 * np.sin(2 * way), np.sin(3 * way)])
    speeds = np.column_stack([-6 * np.sin(way), 8 * np.cos(2 * way), 3 * np.cos(3 * way)])
    turns = [gtsam.Rot3.RzRyRx(np.sin(2 * t), np.cos(t), 2 * np.sin(t)) for t in way]
    for _ in range(40):
        late, arm = 0.05 * rng.normal(), 0.2 * rng.normal(size=3)
        truth = gtsam.Pose3(gtsam.Rot3.Yaw(rng.normal()), 100.0 * rng.normal(size=3))
        pairs = []
        for place, speed, turn in zip(places, speeds, turns, strict=True):
            exact = truth.transformFrom(place + late * speed + turn.rotate(arm))
            fix = PositionFix(0, exact + 0.1 * rng.normal(size=3), 0.01 * np.eye(3), np.zeros(3))
            pairs.append(PathFix(fix, gtsam.Pose3(turn, place), velocity=speed))
        found = align_world(pairs, places[-1], True, (0.0, 0.05), (np.zeros(3), 0.2))
        assert found is not None
        off = np.append(found.offset_s - late, found.arm_m - arm)
        squares.append(off @ np.linalg.solve(found.joint_covariance[4:, 4:], off))
        assert np.abs(found.arm_m - arm).max() < 0.15
    assert np.mean(squares) == pytest.approx(4.0, abs=3.3 * np.sqrt(2 * 4 / 40))


@pytest.mark.parametrize("config", [BOTH, *ONES])
def test_elimination_gives_the_step_and_the_covariance_of_the_whole(config: GnssConfig) -> None:
    """Against the dense normal equations of all poses and variables."""
    rng, K, variables = np.random.default_rng(5), 4, FixVariables(config)
    keyframes = np.array([0, 1, 1, 2, 3, 3])
    roots = np.tile(np.diag([1.0, 2.0, 0.5]), (len(keyframes), 1, 1))
    start = rng.normal(size=4)
    fixes = CalibratedFixes(seen_fixes(rng, len(keyframes)), roots, keyframes, variables, start)
    states = gtsam.Values()
    for k in range(K):
        states.insert(X(k), random_pose(rng))
    linear = fixes.linearized(states, fixes.first())
    n, size = len(fixes.first()), 15 * K
    chain = ChainEquations(np.tile(np.eye(30), (K - 1, 1, 1)), np.zeros((K, 15)))
    whole = np.zeros((size + n, size + n))
    for k in range(K - 1):
        whole[15 * k : 15 * k + 30, 15 * k : 15 * k + 30] += np.eye(30)
    right = np.zeros(size + n)
    for row, k in enumerate(keyframes):
        J = np.zeros((3, size + n))
        J[:, 15 * k : 15 * k + 6], J[:, size:] = linear.by_pose[row], linear.by_calibration[row]
        whole, right = whole + J.T @ J, right + J.T @ linear.r[row]
    whole[size:, size:] += np.diag(linear.by_prior**2)
    right[size:] += linear.by_prior * linear.r_prior
    solution, covariance = np.linalg.solve(whole, right), np.linalg.inv(whole)
    eliminated = EliminatedFixes(linear, K)
    poses = np.zeros((StateColumns.of(K).size,) * 2)
    eliminated.add_to(poses)
    factor = EliminatedStates(poses, chain)
    by_pose, by_calibration = linear.gradient(K)
    gradient = np.zeros((K, 15, 1))
    gradient[:, :6, 0] = eliminated.reduced(by_pose, by_calibration)
    moved = factor.times_covariance(gradient)[:, :, 0]
    assert np.allclose(moved.ravel(), solution[:size])
    assert np.allclose(eliminated.step(by_calibration, moved[:, :6]), solution[size:])
    assert np.allclose(eliminated.covariance(factor), covariance[size:, size:])


# --- runs ----------------------------------------------------------------------------------------


def flight(seed: int, duration_s: float) -> SimulatedSequence:
    """With fixes whose antenna is not where it is said to be, and whose clock is late."""
    return simulate(
        trajectory="random",
        duration_s=duration_s,
        rate_hz=10.0,
        seed=seed,
        tracks={"features": 60},
        gnss={
            "sigma_m": 0.03,
            "rate_hz": 5.0,
            "late_s": LATE_S,
            "lever_arm_m": tuple(TRUE_ARM.tolist()),
        },
    )


def squared_distance(found: AidingData.Calibration) -> float:
    """Of time offset and lever arm from the true ones, by their covariance."""
    off = found.values - np.append(-LATE_S, TRUE_ARM)
    return float(off @ np.linalg.solve(found.covariance, off))


def settings(**given: object) -> dict[str, object]:
    """An arm that is off by 0.2 m, and a clock by 50 ms."""
    wrong = TRUE_ARM + 0.2 * np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0)
    return {"gnss": {"lever_arm_m": tuple(wrong.tolist()), **given}}


ESTIMATED = {"lever_arm_sigma_m": 0.12, "time_offset_sigma_s": 0.05}


@pytest.mark.slow
def test_lever_arm_and_clock_are_found_as_well_as_they_say() -> None:
    """While the run goes on, and by the final adjustment; NEES over two flights."""
    causal, smoothed = [], []
    for seed in range(2):
        sequence = flight(seed, 16.0)
        short = {"enabled": seed == 0}
        result = run(
            sequence, algorithm="msckf", backend=settings(**ESTIMATED), seed=seed, final_ba=short
        )
        found = result.fix_calibration
        assert result.status == "ok"
        assert found is not None
        assert len(result.segments) == 1
        causal.append(squared_distance(found))
        # x of the body is up, which is seen only where the body rolls or pitches
        assert np.abs(found.lever_arm_m - TRUE_ARM)[1:].max() < 0.05
        assert found.time_offset_s == pytest.approx(-LATE_S, abs=0.03)
        table = result.metrics["world"]
        assert table["lever_arm_m"] == found.lever_arm_m.tolist()
        assert table["fix_offset_s"] == found.time_offset_s
        if result.final_ba is not None:
            assert result.final_ba.fixes is not None
            smoothed.append(squared_distance(result.final_ba.fixes))
    assert np.mean(causal) < 4.0 + 3.3 * np.sqrt(2 * 4 / 2)
    assert np.mean(smoothed) < 4.0 + 3.3 * np.sqrt(2 * 4)


def test_gtsam_s_smoothers_refuse_what_they_do_not_estimate() -> None:
    with pytest.raises(ConfigError, match="lever_arm_sigma_m is not for 'fixed_lag_isam2'"):
        run(flight(0, 3.0), algorithm="fixed_lag_isam2", backend=settings(lever_arm_sigma_m=0.1))


@pytest.mark.parametrize("sigma", [1e-3, 1e-8])
def test_a_clock_and_a_lever_arm_that_are_known_well_do_not_hide_the_world(sigma: float) -> None:
    """Whatever the units of the unknowns are, only what the fixes tell decides."""
    rng = np.random.default_rng(2)
    pairs = []
    for k in range(40):
        R = gtsam.Rot3.Ypr(0.1 * k, 0.05 * np.sin(k), 0.05 * np.cos(k))
        pose = gtsam.Pose3(R, [40.0 * np.cos(0.2 * k), 60.0 * np.sin(0.1 * k), 0.1 * k])
        position = pose.translation() + rng.normal(0.0, 1.0, 3)
        fix = PositionFix(k * 10**9, position, np.eye(3), np.zeros(3))
        pairs.append(PathFix(fix, pose, velocity=np.array([1.0, 0.3 * k, 0.0])))
    found = align_world(pairs, np.zeros(3), True, (0.0, sigma), (np.zeros(3), sigma))
    assert found is not None
    assert found.offset_sigma_s == pytest.approx(sigma, rel=0.05)
