# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features eliminated by QR against a dense projection and a dense solution."""

import numpy as np
import pytest
from flight import Flight, rig, room, scene
from scipy.linalg import null_space

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_factors import (
    ReducedFeatures,
    WhitenedObservations,
    reduce_features,
    whiten,
)
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import LossName, RobustLoss

FRAMES = 8
SIGMA_PX = 1.5
Case = tuple[Observations, WhitenedObservations, ReducedFeatures]


@pytest.fixture(scope="module", params=[1, 2], ids=["mono", "stereo"])
def case(request: pytest.FixtureRequest) -> Case:
    """Tracks of different lengths, linearised a little beside the truth."""
    rng = np.random.default_rng(11)
    cameras = rig(request.param)
    times = np.linspace(0.0, 2.0, FRAMES)
    obs, truth = scene(Flight(), cameras, room(250, rng), times, rng, SIGMA_PX)
    points = truth.points + rng.normal(0.0, 0.1, truth.points.shape)
    at = Geometry(truth.rotations, truth.positions, points)
    projection = RigProjection(cameras)
    linear = whiten(obs, projection, at, at, SIGMA_PX, RobustLoss())
    return obs, linear, reduce_features(obs, linear)


def dense_rows(
    obs: Observations, linear: WhitenedObservations, feature: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """H_x (m, 6 F), H_f (m, 3) and r (m,) of one feature."""
    rows = np.flatnonzero(obs.feature == feature)
    H_x = np.zeros((len(rows), 2, 6 * len(obs.frames)))
    for k, row in enumerate(rows):
        start = 6 * int(obs.frame[row])
        H_x[k, :, start : start + 6] = linear.by_pose[row]
    size = 2 * len(rows)
    H_f, r = linear.by_point[rows].reshape(size, 3), linear.r[rows].reshape(size)
    return H_x.reshape(size, -1), H_f, r


def test_rows_say_as_much_as_the_projection_on_the_null_space(case: Case) -> None:
    obs, linear, reduced = case
    assert len(obs.ids) > 20
    assert len(set(obs.counts.tolist())) > 2
    for j in range(len(obs.ids)):
        H_x, H_f, r = dense_rows(obs, linear, j)
        U = null_space(H_f.T)
        assert U.shape[1] == reduced.dof[j] == 2 * obs.counts[j] - 3
        projected = np.column_stack([U.T @ H_x, U.T @ r])
        ours = np.column_stack([reduced.N[j], reduced.r_2[j]])
        expected = projected.T @ projected
        scale = float(np.max(np.abs(expected)))
        np.testing.assert_allclose(ours.T @ ours, expected, atol=1e-8 * max(scale, 1.0))
        assert np.all(ours[reduced.dof[j] :] == 0.0)


def test_no_information_is_lost_by_the_rotation(case: Case) -> None:
    """With the three rows that determine the feature the normal equations are complete."""
    obs, linear, reduced = case
    for j in range(len(obs.ids)):
        H_x, H_f, r = dense_rows(obs, linear, j)
        whole = np.column_stack([H_f, H_x, r])
        top = np.column_stack([reduced.R_f[j], reduced.T[j], reduced.r_1[j]])
        rest = np.column_stack([np.zeros((len(reduced.N[j]), 3)), reduced.N[j], reduced.r_2[j]])
        ours = np.concatenate([top, rest])
        expected = whole.T @ whole
        np.testing.assert_allclose(ours.T @ ours, expected, atol=1e-9 * np.max(np.abs(expected)))
        np.testing.assert_array_equal(np.tril(reduced.R_f[j], -1), 0.0)


def test_increments_of_points_are_those_of_the_dense_solution(case: Case) -> None:
    """Poses and points solved for together: δx from the null space, then δf by substitution."""
    obs, linear, reduced = case
    n, J = 6 * len(obs.frames), len(obs.ids)
    prior = 10.0 * np.eye(n)
    blocks = [np.column_stack([prior, np.zeros((n, 3 * J + 1))])]
    for j in range(J):
        H_x, H_f, r = dense_rows(obs, linear, j)
        wide = np.zeros((len(r), n + 3 * J + 1))
        wide[:, :n], wide[:, n + 3 * j : n + 3 * j + 3], wide[:, -1] = H_x, H_f, r
        blocks.append(wide)
    rows = np.concatenate(blocks)
    dense = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
    compact = reduced.null_space_rows()
    assert len(compact) == reduced.dof.sum()
    stacked = np.concatenate([np.column_stack([prior, np.zeros(n)]), compact])
    poses = np.linalg.lstsq(stacked[:, :-1], stacked[:, -1], rcond=None)[0]
    np.testing.assert_allclose(poses, dense[:n], atol=1e-9)
    points = reduced.point_increments(poses)
    np.testing.assert_allclose(points.ravel(), dense[n:], atol=1e-7)


def test_a_subset_is_the_reduction_of_fewer_features(case: Case) -> None:
    obs, linear, reduced = case
    keep = np.arange(len(obs.ids)) % 3 == 1
    fewer = reduced.subset(keep)
    alone = reduce_features(obs.subset(keep), linear.subset(keep[obs.feature]))
    a, b = fewer.null_space_rows(), alone.null_space_rows()
    np.testing.assert_allclose(a.T @ a, b.T @ b, rtol=1e-9, atol=1e-6)


def test_jacobians_are_taken_at_the_first_estimates() -> None:
    """Residuals at the current values, derivatives at the first ones."""
    rng = np.random.default_rng(3)
    cameras = rig(1)
    obs, first = scene(Flight(), cameras, room(50, rng), np.linspace(0.0, 1.0, 4), rng)
    current = Geometry(first.rotations, first.positions + 0.05, first.points)
    projection = RigProjection(cameras)
    linear = whiten(obs, projection, first, current, 2.0, RobustLoss("none"))
    np.testing.assert_allclose(linear.r * 2.0, projection.residuals(obs, current)[0])
    by_pose, by_point = projection.jacobians(obs, first)
    np.testing.assert_allclose(linear.by_pose * 2.0, by_pose)
    np.testing.assert_allclose(linear.by_point * 2.0, by_point)


ERRORS = np.linspace(0.0, 20.0, 401)


@pytest.mark.parametrize("width", [1.0, 2.45])
def test_weights_are_the_slope_of_the_loss(width: float) -> None:
    """A weight is ρ'(e) / e: Huber is quadratic, then linear; Cauchy is logarithmic."""
    e = ERRORS[1:]
    huber = RobustLoss("huber", width).weights(e)
    np.testing.assert_allclose(huber * e, np.minimum(e, width))
    cauchy = RobustLoss("cauchy", width).weights(e)
    loss = 0.5 * width**2 * np.log1p((e / width) ** 2)
    np.testing.assert_allclose((cauchy * e)[1:-1], np.gradient(loss, e)[1:-1], rtol=2e-2, atol=2e-3)
    np.testing.assert_array_equal(RobustLoss("none").weights(e), 1.0)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "none"])
def test_weights_start_at_one_and_never_grow(loss: LossName) -> None:
    weights = RobustLoss(loss).weights(ERRORS)
    assert weights[0] == 1.0
    assert np.all(np.diff(weights) <= 0.0)
    assert np.all(weights > 0.0)


def test_an_outlier_weighs_less() -> None:
    rng = np.random.default_rng(5)
    cameras = rig(1)
    obs, at = scene(Flight(), cameras, room(50, rng), np.linspace(0.0, 1.0, 4))
    obs.pixels[0] += 50.0
    plain = whiten(obs, RigProjection(cameras), at, at, 1.0, RobustLoss("none"))
    robust = whiten(obs, RigProjection(cameras), at, at, 1.0, RobustLoss(width=2.45))
    root = np.sqrt(2.45 / np.hypot(50.0, 50.0))
    np.testing.assert_allclose(robust.r[0], plain.r[0] * root, rtol=1e-9)
    np.testing.assert_allclose(robust.by_pose[0], plain.by_pose[0] * root)
    np.testing.assert_allclose(robust.by_point[0], plain.by_point[0] * root)
    np.testing.assert_array_equal(robust.by_pose[1:], plain.by_pose[1:])


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_without_its_weights_a_loss_changes_nothing(loss: LossName) -> None:
    rng = np.random.default_rng(6)
    cameras = rig(1)
    obs, at = scene(Flight(), cameras, room(50, rng), np.linspace(0.0, 1.0, 4))
    obs.pixels[:20] += rng.normal(0.0, 20.0, (20, 2))
    plain = whiten(obs, RigProjection(cameras), at, at, 1.0, RobustLoss("none"))
    robust = RobustLoss(loss)
    again = whiten(obs, RigProjection(cameras), at, at, 1.0, robust).unweighted(robust)
    np.testing.assert_allclose(again.r, plain.r, rtol=1e-9)
    np.testing.assert_allclose(again.H, plain.H, rtol=1e-9)
