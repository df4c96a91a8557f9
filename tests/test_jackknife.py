# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The jackknife over blocks of time: errors that are alike within a block do not count as many."""

import numpy as np
import pytest

from slam_graph.diagnosis.jackknife import jackknife_covariance

BLOCKS, SAMPLES, TRIALS = 20, 10, 300


def variance(errors: np.ndarray) -> float:
    """Of the mean of unit-weight samples (B, S), as the jackknife has it."""
    information = np.full((BLOCKS, 1, 1), float(SAMPLES))
    scores = np.sum(errors.mean() - errors, axis=1)[:, None]
    return float(jackknife_covariance(information, scores, np.zeros((1, 1)))[0, 0])


def test_errors_of_blocks_are_found_out() -> None:
    rng = np.random.default_rng(0)
    alike = [np.repeat(rng.normal(size=(BLOCKS, 1)), SAMPLES, axis=1) for _ in range(TRIALS)]
    assert np.mean([variance(errors) for errors in alike]) == pytest.approx(1 / BLOCKS, rel=0.15)


def test_it_is_not_below_that_of_independent_errors() -> None:
    independent, rng = 1.0 / (BLOCKS * SAMPLES), np.random.default_rng(1)
    found = [variance(rng.normal(size=(BLOCKS, SAMPLES))) for _ in range(TRIALS)]
    assert min(found) >= independent * (1 - 1e-9)
    assert variance(np.zeros((BLOCKS, SAMPLES))) == pytest.approx(independent)
