# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What covariances after a start in motion are relative to: the first state that is reported."""

import numpy as np
from estimating import BELIEVED
from flight import Flight
from gtsam.symbol_shorthand import X

from slam_graph.backend.marginalization.marginalize import relative_to, unobservable_directions
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.config import load_config
from slam_graph.evaluation.consistency import mean_bounds
from slam_graph.pipeline.run_recording import run
from slam_graph.simulation.simulator import simulate

TIMES = np.array([0.0, 0.4, 0.9])
FLIGHTS = range(3)


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


def test_after_a_start_in_motion_errors_are_relative_to_the_first_state() -> None:
    """One camera, with the noise that is assumed: the start is least certain of the scale."""
    config = load_config(
        algorithm="msckf",
        overrides=[
            "cameras=1",
            "final_ba.enabled=false",
            "backend.initialization.mode=motion",
            BELIEVED,
        ],
    )
    means = []
    for seed in FLIGHTS:
        sequence = simulate(
            trajectory="figure8",
            cameras=1,
            duration_s=6.0,
            rate_hz=10.0,
            flight={"hover_s": 0.0},
            seed=seed,
        )
        metrics = run(sequence, config).metrics
        assert metrics["nees"]["alignment"] == "first_pose"
        means.append([metrics["nees"][part]["mean"] for part in ("orientation", "position")])
    low, high = mean_bounds(3, len(FLIGHTS), 0.999)
    assert np.all((np.mean(means, axis=0) > low) & (np.mean(means, axis=0) < high)), means
