# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment: laws of the camera, the gauge and the elimination; known optima; outliers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.bal import SMALL, by_gtsam
from benchmarks.bal_problems import ring
from slam_graph.bundle_adjustment import bal_schur
from slam_graph.bundle_adjustment.bal_cost import BalCost, construct, reprojection_errors, retract
from slam_graph.bundle_adjustment.bal_file import read_bal
from slam_graph.bundle_adjustment.bal_policy import (
    BalCostPolicy,
    BalPolicy,
    BalStepsPolicy,
    Intrinsics,
)
from slam_graph.bundle_adjustment.bal_problem import (
    BalEstimates,
    BalProblem,
    linearize,
    project,
    usable,
)
from slam_graph.bundle_adjustment.bal_schur import (
    damped_step,
    gauge_directions,
    normal_equations,
    structure,
)
from slam_graph.bundle_adjustment.bal_solve import adjust_bundle
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError, EstimationError

TIGHT = BalStepsPolicy(tolerance=1e-12)


def similar(estimates: BalEstimates, scale: float, Q: np.ndarray, b: np.ndarray) -> BalEstimates:
    """The same pixels in another world: X becomes scale Q X + b."""
    rotations = estimates.rotations @ Q.T
    translations = scale * estimates.translations - rotations @ b
    points = scale * estimates.points @ Q.T + b
    return replace(estimates, rotations=rotations, translations=translations, points=points)


def small_cost(intrinsics: Intrinsics = "per_camera") -> BalCost:
    part = usable(ring(5, 40, seed=3).problem, Diagnostics())
    return construct(part, BalCostPolicy(intrinsics=intrinsics))


def derivative(problem: BalProblem, by_camera: np.ndarray, by_point: np.ndarray) -> np.ndarray:
    """(N, 2) how the pixels change along a tangent."""
    step = 1e-6
    there, back = (
        project(
            retract(problem.estimates, sign * step * by_camera, sign * step * by_point),
            problem.camera,
            problem.point,
        )[0]
        for sign in (1, -1)
    )
    return (there - back) / (2 * step)


def test_derivatives_are_those_of_the_projection() -> None:
    problem = ring(4, 30).problem
    linear = linearize(problem.estimates, problem.camera, problem.point, problem.pixels)
    still = np.zeros((problem.points, 3))
    for k in range(9):
        along = np.zeros((problem.cameras, 9))
        along[:, k] = 1.0
        expected = derivative(problem, along, still)
        np.testing.assert_allclose(linear.by_camera[:, :, k], expected, rtol=1e-6, atol=1e-5)
    for k in range(3):
        along = np.tile(np.eye(3)[k], (problem.points, 1))
        expected = derivative(problem, np.zeros((problem.cameras, 9)), along)
        np.testing.assert_allclose(linear.by_point[:, :, k], expected, rtol=1e-6, atol=1e-5)
    errors = reprojection_errors(problem, problem.estimates)
    np.testing.assert_allclose(np.linalg.norm(linear.r, axis=1), errors)


def test_no_pixel_moves_along_the_gauge() -> None:
    problem = ring(4, 30).problem
    linear = linearize(problem.estimates, problem.camera, problem.point, problem.pixels)
    directions = gauge_directions(problem.estimates, np.zeros(4, np.int64)).reshape(4, 9, 7)
    X = problem.estimates.points
    turned = -np.cross(X[:, :, None], np.eye(3)[None], axisa=1, axisb=1, axisc=1)
    of_points = np.concatenate([turned, np.tile(np.eye(3), (len(X), 1, 1)), X[:, :, None]], axis=2)
    change = linear.by_camera @ directions[problem.camera]
    change += linear.by_point @ of_points[problem.point]
    assert np.abs(change).max() < 1e-9 * np.abs(linear.by_camera).max()


@pytest.mark.parametrize("intrinsics", ["per_camera", "shared", "fixed"])
def test_elimination_solves_the_whole_equations(intrinsics: Intrinsics) -> None:
    cost, damping = small_cost(intrinsics), 1e-3
    problem, E = cost.part.problem, cost.variables.toarray()
    equations = normal_equations(cost, problem.estimates)
    step = damped_step(cost, structure(cost), equations, damping)
    linear = cost.linearized(problem.estimates)
    N, n = len(problem.camera), E.shape[1]
    by_cameras = np.zeros((N, 2, problem.cameras, 9))
    by_cameras[np.arange(N), :, problem.camera] = linear.by_camera
    by_points = np.zeros((N, 2, problem.points, 3))
    by_points[np.arange(N), :, problem.point] = linear.by_point
    J = np.hstack([by_cameras.reshape(2 * N, -1) @ E, by_points.reshape(2 * N, -1)])
    r, diagonal = linear.r.ravel(), np.sum(J**2, axis=0)
    # the scale of intrinsics that are shared is that of all cameras alone
    diagonal[:n] = E.T @ np.sum(by_cameras.reshape(2 * N, -1) ** 2, axis=0)
    H = J.T @ J + damping * np.diag(diagonal)
    root = np.sqrt(diagonal[:n])
    gauge, _ = np.linalg.qr(root[:, None] * (E.T @ equations.gauge))
    H[:n, :n] += root[:, None] * (gauge @ gauge.T) * root
    expected = -np.linalg.solve(H, J.T @ r)
    np.testing.assert_allclose(step.by_camera.ravel(), E @ expected[:n], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(step.by_point.ravel(), expected[n:], rtol=1e-6, atol=1e-9)
    fallen = 0.5 * (r @ r - np.sum((r + J @ expected) ** 2))
    assert step.predicted == pytest.approx(fallen, rel=1e-6)


def test_without_noise_the_truth_is_found() -> None:
    made = ring(12, 300, noise_px=0.0)
    solution = adjust_bundle(made.problem, BalPolicy(gauss_newton=TIGHT))
    assert solution.minimum.start_cost > 1e5
    assert solution.minimum.cost < 1e-9
    cameras = solution.part.cameras
    np.testing.assert_allclose(
        solution.estimates.intrinsics[cameras], made.truth.intrinsics[cameras], rtol=1e-5, atol=1e-6
    )


def test_no_similarity_of_the_world_changes_what_is_found() -> None:
    problem = ring(8, 150).problem
    Q, b = Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix(), np.array([300.0, -20.0, 7.0])
    elsewhere = replace(problem, estimates=similar(problem.estimates, 50.0, Q, b))
    here, there = (adjust_bundle(p, BalPolicy(gauss_newton=TIGHT)) for p in (problem, elsewhere))
    assert there.minimum.start_cost == pytest.approx(here.minimum.start_cost, rel=1e-9)
    assert there.minimum.cost == pytest.approx(here.minimum.cost, rel=1e-9)
    expected = similar(here.estimates, 50.0, Q, b)
    np.testing.assert_allclose(there.estimates.points, expected.points, atol=1e-2)
    np.testing.assert_allclose(there.estimates.rotations, expected.rotations, atol=1e-4)


def test_the_gauge_of_the_start_is_kept_by_each_group() -> None:
    one, other = ring(6, 100, seed=1).problem, ring(5, 80, seed=2).problem
    both = [
        np.concatenate([getattr(p.estimates, name) for p in (one, other)])
        for name in ("rotations", "translations", "intrinsics", "points")
    ]
    problem = BalProblem(
        BalEstimates(*both),
        np.concatenate([one.camera, other.camera + 6]),
        np.concatenate([one.point, other.point + 100]),
        np.concatenate([one.pixels, other.pixels]),
    )
    diagnostics = Diagnostics()
    solution = adjust_bundle(problem, None, diagnostics)
    assert diagnostics.counts["bal_not_connected"] == 1
    apart = sum(adjust_bundle(p).minimum.cost for p in (one, other))
    assert solution.minimum.cost == pytest.approx(apart, rel=1e-6)
    for first, points in ((0, slice(0, 100)), (6, slice(100, 180))):
        used = np.isin(np.arange(180)[points], solution.part.points)
        medians = []
        for estimates in (problem.estimates, solution.estimates):
            away = estimates.points[points][used] - estimates.centres()[first]
            medians.append(np.median(np.linalg.norm(away, axis=1)))
        np.testing.assert_allclose(*medians, rtol=1e-9)
        np.testing.assert_allclose(
            solution.estimates.translations[first], problem.estimates.translations[first], atol=1e-9
        )


def test_the_optimum_is_that_of_gtsam(gtsam_data) -> None:
    problem = usable(ring(10, 200).problem, Diagnostics()).problem
    expected = by_gtsam(problem, "schur", priors=False)
    assert adjust_bundle(problem).minimum.cost == pytest.approx(expected, rel=1e-6)
    diagnostics = Diagnostics()
    assert adjust_bundle(read_bal(gtsam_data / SMALL), None, diagnostics).minimum.cost < 1e-6
    assert diagnostics.counts == {"bal_underdetermined": 1}


def test_intrinsics_are_estimated_as_asked_for() -> None:
    made = ring(10, 200, noise_px=0.0)
    same = replace(made.truth, intrinsics=np.tile(made.truth.intrinsics[0], (10, 1)))
    pixels, _ = project(same, made.problem.camera, made.problem.point)
    problem = replace(made.problem, pixels=pixels)
    shared = adjust_bundle(
        problem, BalPolicy(cost=BalCostPolicy(intrinsics="shared"), gauss_newton=TIGHT)
    )
    assert shared.minimum.cost < 1e-9
    np.testing.assert_allclose(shared.estimates.intrinsics, same.intrinsics, rtol=1e-5, atol=1e-6)
    fixed = adjust_bundle(problem, BalPolicy(cost=BalCostPolicy(intrinsics="fixed")))
    np.testing.assert_array_equal(fixed.estimates.intrinsics, problem.estimates.intrinsics)
    assert fixed.minimum.converged
    assert fixed.minimum.cost > 1.0


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_a_robust_loss_holds_outliers_back(robust: str) -> None:
    made, rng = ring(10, 200), np.random.default_rng(5)
    pixels = made.problem.pixels.copy()
    false = rng.random(len(pixels)) < 0.1
    pixels[false] += rng.uniform(-60.0, 60.0, (np.count_nonzero(false), 2))
    errors = {}
    for loss in ("none", robust):
        policy = BalPolicy(cost=BalCostPolicy(robust=loss))
        solution = adjust_bundle(replace(made.problem, pixels=pixels), policy)
        assert solution.minimum.converged
        clean, _ = project(made.truth, made.problem.camera, made.problem.point)
        truth = replace(made.problem, pixels=clean)
        used = np.isin(truth.point, solution.part.points) & ~false
        errors[loss] = np.median(reprojection_errors(truth.keep(used), solution.estimates))
    assert errors[robust] < 0.5 * errors["none"]


def test_a_problem_of_nothing_says_so() -> None:
    some = ring(3, 20).problem
    none = np.zeros(0, np.int64)
    for cameras, points in ((none, np.arange(20)), (np.arange(3), none), (none, none)):
        nothing = replace(some.keep(none), estimates=some.estimates.select(cameras, points))
        with pytest.raises(DataError, match="no point is in front of two cameras"):
            adjust_bundle(nothing)


def test_what_cannot_be_estimated_stays_and_is_counted() -> None:
    problem = ring(8, 100, seed=4).problem
    estimates = problem.estimates
    estimates.points[3] = estimates.centres()[problem.camera[problem.point == 3]].mean(axis=0) * 2
    once = problem.keep((problem.point != 5) & (problem.camera != 7))
    camera, point = (
        np.append(once.camera, [0, once.camera[0]]),
        np.append(once.point, [5, once.point[0]]),
    )
    once = replace(
        once, camera=camera, point=point, pixels=np.vstack([once.pixels, [[0, 0], [9, 9]]])
    )
    diagnostics = Diagnostics()
    solution = adjust_bundle(once, None, diagnostics)
    counts = diagnostics.counts
    assert counts["bal_repeated_observation"] == 1
    assert counts["bal_camera_without_observations"] == 1
    assert counts["bal_point_seen_once"] >= 2
    assert counts["bal_point_behind_camera"] >= 1
    assert solution.minimum.converged
    left = np.setdiff1d(np.arange(100), solution.part.points)
    assert {3, 5} <= set(left.tolist())
    np.testing.assert_array_equal(solution.estimates.points[left], estimates.points[left])
    np.testing.assert_array_equal(solution.estimates.rotations[7], estimates.rotations[7])
    assert np.sqrt(2 * solution.minimum.cost / len(solution.part.problem.camera)) < 2.0


def test_what_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bal_schur, "_MAX_CAMERAS", 4)
    with pytest.raises(EstimationError, match="too large: 5 cameras"):
        adjust_bundle(ring(5, 40).problem)
