# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A window as long as the sequence is batch Gauss-Newton: GTSAM's solution of all factors at once.

Noise is scaled down to where the problem is linear, since a filter linearises each feature once.
"""

import gtsam
import numpy as np
import pytest
from flight import Flight, rig
from gtsam.symbol_shorthand import B, V, X
from linear_flight import CONFIG, batch_problem, differences, given_start, recording, solved

from slam_graph.backend.estimator import Estimator
from slam_graph.backend.policies import AlgorithmConfig, CostPolicy, GaussNewtonPolicy

ONCE = CostPolicy(max_past_poses=1000, max_state_features=0, max_features_per_step=1000)
ALL_ALONG = ONCE.model_copy(update={"features": "every_step", "recent_frames": 1000})
LONG_WINDOWS = {
    "swf": AlgorithmConfig(name="swf", cost=ONCE),
    "msckf": AlgorithmConfig(
        name="msckf", cost=ONCE.model_copy(update={"past_poses": "evenly_spaced"})
    ),
    "several steps": AlgorithmConfig(
        name="smoother",
        cost=ALL_ALONG,
        gauss_newton=GaussNewtonPolicy(max_steps=10, tolerance=1e-12),
    ),
}
"""Policies under which no pose leaves: features are used once, or linearised anew in every step."""


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("name", LONG_WINDOWS)
def test_a_window_as_long_as_the_sequence_is_batch_gauss_newton(name: str, cameras: int) -> None:
    mounted = rig(cameras)
    flown, start = recording(mounted), given_start()
    estimator = Estimator(mounted, LONG_WINDOWS[name], CONFIG)
    estimator.start(start)
    for packet in flown:
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
    assert state is not None
    assert state.covariance is not None

    graph, values = batch_problem(start, flown, mounted)
    best, last = solved(graph, values), len(flown) - 1
    sigmas = np.sqrt(np.diag(state.covariance))
    moved = differences(Flight().nav_state(state.stamp_ns * 1e-9), best, last) / sigmas
    missed = differences(state, best, last) / sigmas
    assert np.linalg.norm(missed) < 2e-3 * np.linalg.norm(moved)
    marginals = gtsam.Marginals(graph, best)
    for key, rows in ((X(last), slice(0, 6)), (V(last), slice(6, 9)), (B(last), slice(9, 15))):
        expected = marginals.marginalCovariance(key)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(
            state.covariance[rows, rows] / scale, expected / scale, atol=1e-3
        )
