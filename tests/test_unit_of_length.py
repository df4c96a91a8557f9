# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Dynamics in the unit of what one camera sees: they measure no scale, and all else as before."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph.backend.aiding.regauging import gauge_directions
from slam_graph.backend.cost.unit_of_length import in_the_unit, unit_gradient
from slam_graph.backend.initialization.monocular_start import scale_direction
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.geometry import NavState

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


def test_rows_whose_residual_grows_with_the_scale_say_nothing_of_it(
    case: tuple[State, Layout, np.random.Generator],
) -> None:
    """As those of constant velocity: J N = r before."""
    state, layout, rng = case
    scaling = scale_direction(state.first, layout, rng.normal(size=3), ARM)
    J = rng.normal(size=(5, layout.size))
    rows = np.column_stack([J, -J @ scaling])
    changed = in_the_unit(rows.copy(), state, layout, ARM)
    np.testing.assert_allclose(changed[:, :-1] @ scaling, 0.0, atol=1e-10)
    np.testing.assert_array_equal(changed[:, -1], rows[:, -1])


def test_without_features_nothing_is_changed() -> None:
    state = State()
    none = np.zeros(3)
    state.insert_imu_state(0, NavState(0, gtsam.Pose3(), none, accel_bias=none, gyro_bias=none))
    layout = Layout(dims_of([X(0), V(0), B(0)]))
    assert not unit_gradient(state, layout, ARM).any()
