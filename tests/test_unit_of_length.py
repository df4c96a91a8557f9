# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Dynamics in the unit of what one camera sees: they measure no scale, and all else as before."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.regauging import gauge_directions
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.unit_of_length import scale_direction, unit_gradient, without_scale
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.geometry import NavState
from slam_graph.sensors import Rig
from slam_graph.simulation import simulate

ARM = np.array([0.3, -0.2, 0.1])
FEATURES = 7


@pytest.fixture(params=range(3))
def case(request: pytest.FixtureRequest) -> tuple[State, Layout, np.random.Generator]:
    """Two poses and some features, whose estimates have left their first estimates."""
    rng = np.random.default_rng(request.param)
    state = State()
    for k in range(2):
        pose = gtsam.Pose3.Expmap(rng.normal(size=6))
        zero = np.zeros(3)
        known = NavState(k, pose, rng.normal(size=3), accel_bias=zero, gyro_bias=rng.normal(size=3))
        state.insert_imu_state(k, known)
    state.insert_points(np.arange(FEATURES), rng.normal(0.0, 4.0, (FEATURES, 3)))
    features = [L(j) for j in range(FEATURES)]
    layout = Layout(dims_of([X(0), V(0), B(0), *features, X(1), V(1), B(1)]))
    state.update(layout, 0.01 * rng.normal(size=layout.size))
    return state, layout, rng


def test_the_gradient_is_one_along_a_scaling_and_zero_along_a_motion(
    case: tuple[State, Layout, np.random.Generator],
) -> None:
    state, layout, rng = case
    centre = rng.normal(size=3)
    gradient = unit_gradient(state, layout, ARM)
    scaling = scale_direction(state.first, layout, centre, ARM)
    motions = gauge_directions(state.first, layout, centre, level=False)
    assert gradient @ scaling == pytest.approx(1.0)
    np.testing.assert_allclose(gradient @ motions, 0.0, atol=1e-12)


def rows_of_dynamics(state: State, layout: Layout, rig: Rig) -> FloatArray:
    """Rows of constant velocity between the two poses, as the cost has them."""
    params = gtsam.PreintegrationCombinedParams(np.zeros(3))
    measured = gtsam.PreintegratedCombinedMeasurements(params)
    measured.integrateMeasurement(np.zeros(3), np.zeros(3), 0.05)
    factor = gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), measured)
    nothing = SquareRootInformation(Layout({}), np.zeros((1, 1)))
    return Cost(state, RigProjection(rig), BackendConfig(), nothing, [factor]).factor_rows(layout)


def test_dynamics_of_one_camera_say_nothing_of_the_scale_and_the_same_of_the_world(
    case: tuple[State, Layout, np.random.Generator],
) -> None:
    state, layout, _ = case
    one = simulate(cameras=1, with_imu=False).rig
    arm = one.cameras[0].body_T_camera.translation()
    before, after = (
        rows_of_dynamics(state, layout, rig) for rig in (replace(one, has_imu=True), one)
    )
    scaling = scale_direction(state.first, layout, np.zeros(3), arm)
    motions = gauge_directions(state.first, layout, np.zeros(3), level=False)
    size = np.abs(before[:, :-1] @ scaling).max()
    assert size > 1.0
    np.testing.assert_allclose(after[:, :-1] @ scaling, 0.0, atol=1e-9 * size)
    np.testing.assert_allclose(after[:, :-1] @ motions, before[:, :-1] @ motions, atol=1e-9 * size)
    np.testing.assert_array_equal(after[:, -1], before[:, -1])


def test_without_features_nothing_is_changed(
    case: tuple[State, Layout, np.random.Generator],
) -> None:
    state, layout, rng = case
    state.remove([L(j) for j in range(FEATURES)])
    layout = Layout(dims_of([X(0), V(0), B(0), X(1), V(1), B(1)]))
    rows = rng.normal(size=(4, layout.size + 1))
    np.testing.assert_array_equal(without_scale(rows.copy(), state, layout, ARM), rows)


def test_a_feature_at_the_camera_is_not_the_unit(
    case: tuple[State, Layout, np.random.Generator],
) -> None:
    state, layout, _ = case
    camera = state.first_frames.atPose3(X(1)).transformFrom(ARM)
    state.remove([L(0)])
    state.insert_points(np.zeros(1, np.int64), camera[None] + 1e-3)
    gradient = unit_gradient(state, layout, ARM)
    assert np.isfinite(gradient).all()
    assert gradient @ scale_direction(state.first, layout, np.zeros(3), ARM) == pytest.approx(1.0)
    others = layout.indices([L(j) for j in range(1, FEATURES)])
    away = state.positions_of(np.arange(1, FEATURES), first=True) - camera
    assert gradient[others] @ away.reshape(-1) > 0.2
