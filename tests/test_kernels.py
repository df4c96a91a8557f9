# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Every compiled kernel does what its NumPy form does."""

import numpy as np

from slam_graph.kernels.null_space import triangularize_features, triangularize_features_numpy

EQUAL = 1e-12
"""Largest difference, relative to the largest value."""


def same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max(initial=0.0) <= EQUAL * max(1.0, np.abs(b).max(initial=0.0)))


def test_triangularize_features() -> None:
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(12, 10, 3)), rng.normal(size=(12, 10, 17))
    A[3, 4:] = B[3, 4:] = 0.0  # a feature with fewer observations
    A[5] = 0.0  # one that does not depend on its position
    expected = A.copy(), B.copy()
    triangularize_features_numpy(*expected)
    triangularize_features(A, B)
    assert same(A, expected[0])
    assert same(B, expected[1])
