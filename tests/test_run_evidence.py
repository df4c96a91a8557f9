# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run shows of its own consistency: ratios that are one where the assumptions hold."""

import gtsam
import numpy as np
import pytest

from slam_graph.diagnosis.run_evidence import MOST_SHIFT, Evidence
from slam_graph.geometry import NavState, StateHistory
from slam_graph.pipeline.run_recording import run
from slam_graph.simulation.simulator import simulate

SIGMAS = np.repeat([0.01, 0.05, 0.1, 0.1, 0.1], 3)
"""Of rotation, position, velocity and biases."""


def flight(rng: np.random.Generator, errors: float, sigma: float = 1.0) -> StateHistory:
    """Standing still with errors of so many standard deviations, which are `sigma` times usual."""
    history, zero = StateHistory(), np.zeros(3)
    biases = {"accel_bias": zero, "gyro_bias": zero}
    for k in range(400):
        off = errors * SIGMAS[:6] * rng.normal(size=6)
        pose = gtsam.Pose3.Expmap(off)
        covariance = np.diag((sigma * SIGMAS) ** 2)
        history.append(NavState(k * 50_000_000, pose, zero, **biases, covariance=covariance))
    return history


def innovations(growth: float = 1.0) -> dict[str, np.ndarray]:
    """Those of 100 frames, in the second half larger than expected."""
    expected = np.full(100, 20.0)
    return {
        "passed_distance": expected * np.where(np.arange(100) < 50, 1.0, growth),
        "expected": expected,
    }


def test_shifts_are_in_standard_deviations_of_both() -> None:
    rng = np.random.default_rng(1)
    evidence = Evidence.of(innovations(), 0.0, flight(rng, 2.0), flight(rng, 0.0, sigma=0.5))
    both = np.hypot(1.0, 0.5)
    assert evidence.position_shift == pytest.approx(2.0 / both, rel=0.1)
    assert evidence.rotation_shift == pytest.approx(2.0 / both, rel=0.1)
    assert evidence.smoothed_sigma == pytest.approx(0.5)
    assert not evidence.contradicts
    assert evidence.causes == []


def test_what_no_good_run_shows_is_said_in_words() -> None:
    rng = np.random.default_rng(2)
    far = 3.0 * MOST_SHIFT
    evidence = Evidence.of(innovations(), 0.9, flight(rng, far), flight(rng, 0.0))
    assert evidence.contradicts
    assert not Evidence.of(innovations(), 0.1, flight(rng, far), flight(rng, 0.0)).contradicts
    assert not Evidence.of(innovations(), 0.9, flight(rng, 0.0), flight(rng, 0.0)).contradicts
    limit, shift = evidence.causes
    assert "90% of the frames" in limit
    assert "smoothed" in shift


def test_innovations_that_grow_have_a_trend() -> None:
    evidence = Evidence.of(innovations(growth=3.0), None, StateHistory(), None)
    assert evidence.nis == pytest.approx(2.0)
    assert evidence.nis_trend == pytest.approx(3.0)
    assert not evidence.is_unusual


def test_nothing_is_said_of_nothing() -> None:
    none = {"passed_distance": np.zeros(0), "expected": np.zeros(0)}
    evidence = Evidence.of(none, None, StateHistory(), StateHistory())
    assert evidence == Evidence()
    assert not evidence.is_unusual


def test_a_good_run_is_consistent_by_itself() -> None:
    result = run(simulate(cameras=2, duration_s=8.0, seed=1), algorithm="msckf")
    assert result.status == "ok"
    table = result.metrics["evidence"]
    assert table["noise_at_limit"] == 0.0
    assert 0.8 < table["nis"] < 1.2
    assert max(table["position_shift"], table["rotation_shift"]) < 2.5
