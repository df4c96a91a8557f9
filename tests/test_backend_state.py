# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The variables: estimates, linearisation points, and which of them may move."""

import gtsam
import numpy as np
import pytest
from flight import Flight, rig, room, scene
from gtsam.symbol_shorthand import B, E, L, T, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.cost import Cost, TrackFeatures
from slam_graph.backend.cost.feature_factors import SummedFeatures
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import first_centres
from slam_graph.backend.marginalization.marginalize import marginalize
from slam_graph.backend.solve.layout_parts import LayoutParts
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.stacked_values import stacked_points, stacked_poses
from slam_graph.backend.solve.state import (
    State,
    dim,
    dims_of,
    distortion_key,
    imu_state_keys,
    letter_and_index,
)
from slam_graph.geometry.trajectory import NavState

KEYS = [L(5), X(0), X(1), V(1), B(1)]


@pytest.fixture
def state() -> State:
    """Two IMU states and a feature."""
    made = State()
    for frame in range(2):
        made.insert_imu_state(frame, Flight().nav_state(0.3 * frame))
    made.insert_point(5, np.array([1.0, 2.0, 3.0]))
    return made


def layout(keys: list[int]) -> Layout:
    return Layout(dims_of(keys))


def delta(keys: list[int], seed: int = 0) -> FloatArray:
    return 0.1 * np.random.default_rng(seed).normal(size=layout(keys).size)


def assert_same_values(a: gtsam.Values, b: gtsam.Values, atol: float = 1e-12) -> None:
    assert set(a.keys()) == set(b.keys())
    difference = a.localCoordinates(b)
    for key in a.keys():  # noqa: SIM118
        np.testing.assert_allclose(difference.at(key), 0.0, atol=atol)


def test_poses_are_those_of_the_values(state: State) -> None:
    """To the bit, also where a camera's pose is a variable, after a step and with a new frame."""
    mounting = gtsam.Values()
    mounting.insert(E(1), pose3=gtsam.Pose3())
    state.insert(mounting)
    keys = [E(1), *imu_state_keys(0), *imu_state_keys(1)]
    for _ in range(2):
        for first, values in ((False, state.frames), (True, state.first_frames)):
            for frames in ([0, 1], [1, 0], [1], []):
                found, expected = state.poses(frames, first), stacked_poses(values, frames)
                assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
        state.update(layout(keys), delta(keys))
        state.relinearize()
    state.poses([0]), state.poses([0], first=True)  # known when poses come and go
    state.insert_imu_state(2, Flight().nav_state(0.6))
    state.remove(imu_state_keys(0))
    for first, values in ((False, state.frames), (True, state.first_frames)):
        found, expected = state.poses([2, 1], first), stacked_poses(values, [2, 1])
        assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
    state.insert_imu_state(0, Flight().nav_state(0.0))  # not the last one
    assert np.array_equal(state.poses([0, 2])[1], stacked_poses(state.frames, [0, 2])[1])


def test_parts_of_a_layout() -> None:
    """Features and others are told apart, wherever they stand."""
    columns, some = layout([X(0), L(5), V(1), L(2)]), np.arange(15.0)
    parts = LayoutParts.of(columns)
    assert parts.keys == [X(0), V(1)]
    assert parts.features.tolist() == [5, 2]
    assert some[parts.of_points].tolist() == [[6.0, 7.0, 8.0], [12.0, 13.0, 14.0]]
    of_others = some[parts.of_others]
    tangents = {key: of_others[s] for key, s in zip(parts.keys, parts.slices, strict=True)}
    assert tangents[V(1)].tolist() == [9.0, 10.0, 11.0]
    assert np.array_equal(parts.stacked(tangents), of_others)


def test_an_extended_layout_is_that_of_all_its_variables() -> None:
    """Columns and parts, also where it was extended twice."""
    whole = layout([*KEYS, X(2), L(3), T(0), L(9)])
    extended = layout(KEYS).extended(dims_of([X(2), L(3)])).extended(dims_of([T(0), L(9)]))
    assert extended.begins_with(layout(KEYS))
    assert not extended.begins_with(layout([X(0)]))
    assert extended.dims == whole.dims
    assert extended.starts == whole.starts
    found, expected = LayoutParts.of(extended), LayoutParts.of(whole)
    assert (found.keys, found.slices) == (expected.keys, expected.slices)
    for name in ("of_others", "features", "of_points"):
        assert np.array_equal(getattr(found, name), getattr(expected, name))


def test_columns_are_in_the_order_of_the_keys() -> None:
    """Of variables of one size and of several, of few and of many."""
    columns = layout([*KEYS, *(L(k) for k in range(20, 30))])
    many = [L(k) for k in range(29, 19, -1)]
    for keys in ([X(1), X(0)], [B(1), L(5), X(0)], [V(1)], [], [X(1), *many, V(1)]):
        expected = [c for key in keys for c in range(*columns.columns[key].indices(columns.size))]
        assert columns.indices(keys).tolist() == expected


def test_dimensions() -> None:
    assert [dim(key) for key in KEYS] == [3, 6, 6, 3, 6]
    assert imu_state_keys(3) == (X(3), V(3), B(3))


@pytest.mark.parametrize("coefficients", [1, 2, 4, 5, 12])
def test_the_key_of_distortion_coefficients_holds_their_number(coefficients: int) -> None:
    keys = [distortion_key(camera, coefficients) for camera in range(3)]
    assert len(set(keys)) == 3
    assert [dim(key) for key in keys] == [coefficients] * 3
    assert [letter_and_index(key) for key in keys] == [("d", camera) for camera in range(3)]
    for key in (*KEYS, L(2**40), E(2), T(0)):
        symbol = gtsam.Symbol(key)
        assert letter_and_index(key) == (chr(symbol.chr()), symbol.index())
    made = State()
    values = gtsam.Values()
    values.insert(keys[1], np.arange(float(coefficients)))
    made.insert(values)
    made.update(Layout(dims_of(keys[1:2])), np.ones(coefficients))
    made.relinearize()
    np.testing.assert_array_equal(made.first.atVector(keys[1]), 1.0 + np.arange(coefficients))


def test_a_state_goes_in_and_comes_out() -> None:
    given = Flight(gyro_bias=np.arange(3.0), accel_bias=-np.arange(3.0)).nav_state(0.7)
    made = State()
    made.insert_imu_state(4, given)
    out = made.nav_state(4, given.stamp_ns, np.eye(15))
    assert isinstance(out, NavState)
    np.testing.assert_array_equal(out.world_T_body.matrix(), given.world_T_body.matrix())
    for name in ("velocity", "gyro_bias", "accel_bias"):
        np.testing.assert_array_equal(getattr(out, name), getattr(given, name))


def test_an_update_is_a_retraction_at_the_linearisation_point(state: State) -> None:
    first = gtsam.Values(state.first)
    step = delta(KEYS)
    state.update(layout(KEYS), step)
    columns = layout(KEYS).columns
    pose = first.atPose3(X(1)).retract(step[columns[X(1)]])
    np.testing.assert_allclose(state.estimate.atPose3(X(1)).matrix(), pose.matrix())
    for key, values in ((V(1), first.atVector(V(1))), (L(5), first.atPoint3(L(5)))):
        moved = state.estimate.atPoint3(key) if key == L(5) else state.estimate.atVector(key)
        np.testing.assert_allclose(moved, values + step[columns[key]])
    bias = first.atConstantBias(B(1)).vector() + step[columns[B(1)]]
    np.testing.assert_allclose(state.estimate.atConstantBias(B(1)).vector(), bias)
    np.testing.assert_array_equal(state.estimate.atVector(V(0)), first.atVector(V(0)))
    assert_same_values(state.first, first)


def test_updates_of_a_frozen_variable_add_up_in_one_tangent(state: State) -> None:
    """Not first ⊕ a ⊕ b but first ⊕ (a + b): the prior is a function of that sum."""
    state.freeze(KEYS)
    a, b = delta(KEYS, 1), delta(KEYS, 2)
    for step in (a, b):
        state.relinearize()
        state.update(layout(KEYS), step)
    np.testing.assert_allclose(state.offset(layout(KEYS)), a + b)
    columns = layout(KEYS).columns[X(0)]
    expected = state.first.atPose3(X(0)).retract((a + b)[columns])
    np.testing.assert_allclose(state.estimate.atPose3(X(0)).matrix(), expected.matrix())
    steps = state.first.atPose3(X(0)).retract(a[columns]).retract(b[columns])
    assert np.abs(steps.matrix() - expected.matrix()).max() > 1e-4


def test_relinearisation_moves_all_but_the_frozen(state: State) -> None:
    state.freeze([X(0)])
    state.update(layout(KEYS), delta(KEYS))
    first, estimate = gtsam.Values(state.first), gtsam.Values(state.estimate)
    state.relinearize()
    assert_same_values(state.estimate, estimate)
    np.testing.assert_array_equal(state.first.atPose3(X(0)).matrix(), first.atPose3(X(0)).matrix())
    assert state.offsets[X(0)].any()
    for key in (X(1), V(1), B(1), L(5)):
        assert not state.offsets[key].any()
    np.testing.assert_allclose(
        state.first.atPose3(X(1)).matrix(), estimate.atPose3(X(1)).matrix(), atol=1e-12
    )


def test_rebasing_moves_the_frozen_too(state: State) -> None:
    state.freeze(KEYS)
    state.update(layout(KEYS), delta(KEYS))
    estimate = gtsam.Values(state.estimate)
    state.rebase()
    assert not state.frozen
    assert not state.offset(layout(KEYS)).any()
    assert_same_values(state.estimate, estimate)
    assert_same_values(state.first, estimate)


def test_a_copy_is_independent(state: State) -> None:
    state.freeze([V(1)])
    before = state.copy()
    values = gtsam.Values(state.estimate)
    state.update(layout(KEYS), delta(KEYS))
    state.freeze([X(0)])
    state.remove([L(5)])
    assert_same_values(before.estimate, values)
    assert before.frozen == {V(1)}
    assert not before.offset(layout(KEYS)).any()
    state.assign(before)
    assert_same_values(state.estimate, values)
    assert state.offsets.keys() == before.offsets.keys()
    state.update(layout(KEYS), delta(KEYS))
    assert not before.offset(layout(KEYS)).any()


def test_removal_forgets_everything_of_a_variable(state: State) -> None:
    state.freeze([L(5), X(0)])
    state.remove([L(5), V(0)])
    assert not state.estimate.exists(L(5))
    assert not state.first.exists(V(0))
    assert L(5) not in state.offsets
    assert state.frozen == {X(0)}
    state.insert_point(5, np.zeros(3))
    assert L(5) not in state.frozen


def test_a_cost_is_restored_with_its_features() -> None:
    """A rejected step of Levenberg-Marquardt leaves no trace."""
    rng = np.random.default_rng(0)
    cameras = rig()
    obs, truth = scene(Flight(), cameras, room(60, rng), np.linspace(0.0, 1.0, 4), rng)
    state = State()
    for frame, t_s in enumerate(np.linspace(0.0, 1.0, 4)):
        state.insert_imu_state(frame, Flight().nav_state(float(t_s)))
    cost = Cost(state, RigProjection(cameras), BackendConfig(), SquareRootInformation.empty())
    cost.prior = cost.prior.extended(dims_of(X(i) for i in range(4)))
    cost.tracks = TrackFeatures(obs, truth.points, np.zeros(len(obs.ids), np.bool_))
    linear = cost.linearize(summed=True)
    error = cost.value()
    before, estimate = cost.snapshot(), gtsam.Values(state.estimate)
    cost.apply(delta([X(i) for i in range(4)]), linear, cost.layout())
    assert cost.value() != error
    assert np.abs(cost.tracks.points - truth.points).max() > 1e-3
    cost.restore(before)
    assert cost.state is state
    assert_same_values(state.estimate, estimate)
    np.testing.assert_array_equal(cost.tracks.points, truth.points)
    assert cost.value() == pytest.approx(error, rel=1e-12)


def test_a_feature_that_is_nearer_than_it_was_taken_for_stays_before_the_camera() -> None:
    """In metres the same increments lead behind it, and the step that is right is refused."""
    times_s = np.linspace(0.0, 1.0, 6)
    cameras = rig(1)
    obs, truth = scene(Flight(), cameras, room(200, np.random.default_rng(0)), times_s)
    state = State()
    for frame, t_s in enumerate(times_s):
        state.insert_imu_state(frame, Flight().nav_state(float(t_s)))
    cost = Cost(state, RigProjection(cameras), BackendConfig(), SquareRootInformation.empty())
    cost.prior = cost.prior.extended(dims_of(X(i) for i in range(len(times_s))))
    centres = first_centres(obs, cost.rig, state)
    too_far = centres + 4.0 * (truth.points - centres)
    cost.tracks = TrackFeatures(obs, too_far, np.zeros(len(obs.ids), np.bool_))
    linear, layout = cost.linearize(summed=True), cost.layout()
    assert isinstance(linear.tracks, SummedFeatures)
    increments = linear.tracks.point_increments(np.zeros(layout.size))
    rays = truth.points - centres
    assert np.mean(np.sum((too_far + increments - centres) * rays, axis=1) < 0.0) > 0.5
    before = cost.value()
    cost.apply(np.zeros(layout.size), linear, layout)
    assert cost.value() < 0.1 * before
    assert cost.tracks is not None
    assert np.all(np.sum((cost.tracks.points - centres) * rays, axis=1) > 0.0)


@pytest.mark.parametrize("first_estimates", [True, False])
def test_the_prior_is_a_function_of_the_offsets(state: State, first_estimates: bool) -> None:
    """At the estimate it is the marginal of the posterior, wherever it is based."""
    rng = np.random.default_rng(3)
    wide = layout(KEYS)
    posterior = SquareRootInformation(wide, triangularize(rng.normal(size=(40, wide.size + 1))))
    state.freeze([X(0)])
    state.update(wide, delta(KEYS))
    keep = [X(1), L(5)]
    expected = posterior.marginal(keep)
    prior = marginalize(posterior, state, keep, "first" if first_estimates else "current")
    assert not state.estimate.exists(X(0))
    assert state.estimate.exists(X(1))
    offset = state.offset(prior.layout)
    assert bool(offset.any()) is first_estimates
    assert state.frozen == set(keep)  # until the next marginalization
    np.testing.assert_allclose(prior.shifted(offset).Rd, expected.Rd, atol=1e-12)


def test_points_are_those_of_their_keys() -> None:
    rng = np.random.default_rng(3)
    values = gtsam.Values()
    points = {int(j): rng.normal(size=3) for j in rng.permutation(1000)[:40]}
    for feature, point in points.items():
        values.insert(L(feature), point)
    # others of three numbers, with keys before and after those of features, and some of none
    values.insert(distortion_key(0, 3), rng.normal(size=3))
    values.insert(V(7), rng.normal(size=3))
    values.insert(T(0), np.zeros(1))
    values.insert(B(7), gtsam.imuBias.ConstantBias())
    values.insert(X(7), gtsam.Pose3())
    wanted = np.array([*points])[:15]
    for at in (values, values.retract(values.zeroVectors())):
        found = stacked_points(at, wanted)
        np.testing.assert_array_equal(found, [points[j] for j in wanted.tolist()])
    assert stacked_points(values, np.zeros(0, np.int64)).shape == (0, 3)
    with pytest.raises(KeyError, match="not all of the features"):
        stacked_points(values, np.array([wanted[0], 1000]))
