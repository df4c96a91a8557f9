# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What covariances after a start in motion are relative to: the first state that is reported."""

import numpy as np
from flight import Flight
from gtsam.symbol_shorthand import X

from slam_graph.backend.marginalization.marginalize import relative_to, unobservable_directions
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of

TIMES = np.array([0.0, 0.4, 0.9])


def test_a_start_defines_its_world_by_its_last_pose() -> None:
    """Covariances are those of what is left of an error less its part of position and yaw there."""
    rng = np.random.default_rng(6)
    state = State()
    for i, t_s in enumerate(TIMES.tolist()):
        state.insert_imu_state(i, Flight().nav_state(t_s))
    layout = Layout(dims_of(state.variables()))
    rows = rng.normal(size=(2 * layout.size, layout.size + 1))
    prior = SquareRootInformation.empty().extended(layout.dims).updated(rows)
    state.freeze(layout.dims)
    state.update(layout, 0.01 * rng.normal(size=layout.size))
    pose, sigmas = X(len(TIMES) - 1), (1e-3, 1e-4)
    moved = relative_to(prior, state, pose, sigmas)
    N = unobservable_directions(state.first, layout)
    W = np.zeros((layout.size, 4))
    columns = layout.indices([pose])
    W[columns[3:], :3] = np.eye(3)
    W[columns[:3], 3] = state.first.atPose3(pose).rotation().matrix().T[:, 2]
    # what remains when the four directions are free, and what they are from now on
    T = np.eye(layout.size) - N @ np.linalg.solve(W.T @ N, W.T)
    fixed = N @ np.linalg.solve(W.T @ N, np.diag([sigmas[0]] * 3 + [sigmas[1]]))
    expected = T @ prior.covariance() @ T.T + fixed @ fixed.T
    np.testing.assert_allclose(moved.covariance(), expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        W.T @ moved.solution(), W.T @ state.offset(layout), rtol=1e-6, atol=1e-9
    )
