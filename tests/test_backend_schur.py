# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The summed form of features says exactly what their null-space rows say."""

import numpy as np
import pytest
from flight import Flight, rig, room, scene

from slam_graph.backend.cost.feature_factors import (
    information_root,
    reduce_features,
    sum_features,
    whiten,
)
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("span_s", [0.05, 1.5])
def test_sum_of_features_equals_their_null_space_rows(cameras: int, span_s: float) -> None:
    rng = np.random.default_rng(3)
    mounted = rig(cameras)
    times = np.linspace(0.0, span_s, 6)
    obs, geometry = scene(Flight(), mounted, room(400, rng), times, rng)
    linear = whiten(obs, RigProjection(mounted), geometry, geometry, 1.0, RobustLoss())
    apart, together = reduce_features(obs, linear), sum_features(obs, linear)

    rows, compact = apart.null_space_rows(), together.null_space_rows()
    scale = np.abs(rows.T @ rows).max()
    assert len(compact) <= rows.shape[1]
    np.testing.assert_allclose(compact.T @ compact, rows.T @ rows, rtol=0.0, atol=1e-13 * scale)
    delta = rng.normal(0.0, 0.01, 6 * len(obs.frames))
    np.testing.assert_allclose(
        together.point_increments(delta), apart.point_increments(delta), rtol=1e-6, atol=1e-9
    )


def test_root_of_a_singular_information_gives_it_back() -> None:
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(9, 13))  # twelve variables, nine rows
    root = information_root(rows.T @ rows)
    np.testing.assert_allclose(root.T @ root, rows.T @ rows, atol=1e-12)
