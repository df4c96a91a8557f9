# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes move the world of a running estimate, whatever kind of steps it takes."""

from itertools import pairwise

import numpy as np
import pytest
from gtsam.symbol_shorthand import X

import slam_graph as sg
from slam_graph.backend.aiding.regauging import (
    gauge_directions,
    left_of_gauge,
    moved_by_gauge,
)
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState


def flown(cameras: int = 2) -> tuple[Window, NavState]:
    """A window with past poses and features, and its last state."""
    sequence = sg.simulate(
        duration_s=3.0, rate_hz=10, cameras=cameras, tracks={"features": 40}, seed=3
    )
    told, state = sg.load_config("msckf"), None
    estimator = sg.Estimator(sequence.rig, told.algorithm, told.backend)
    for packet in sequence.packets():
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame) or state
    assert estimator.window is not None
    assert state is not None
    assert len(estimator.window.past) > 5
    assert len(estimator.window.state_features) > 5
    return estimator.window, state


@pytest.mark.parametrize("g", [[0.5, -0.3, 0.2, 0.06], [0.0, 0.0, 0.0, -1.0]])
def test_a_world_that_is_moved_keeps_all_that_is_relative(g: list[float]) -> None:
    window, state = flown()
    there, after = moved_by_gauge(window, state, np.array(g))
    shift = after.world_T_body.translation() - state.world_T_body.translation()
    np.testing.assert_allclose(shift, g[:3], atol=1e-12)
    turned = state.world_T_body.rotation().compose(after.world_T_body.rotation().inverse())
    assert turned.yaw() == pytest.approx(-g[3])
    np.testing.assert_allclose(np.hypot(turned.roll(), turned.pitch()), 0.0, atol=1e-9)
    for old, new in ((window.state.frames, there.state.frames),):
        for i, j in pairwise([*window.past, window.frame]):
            before, now = (v.atPose3(X(i)).between(v.atPose3(X(j))) for v in (old, new))
            assert before.equals(now, 1e-9)
    pose, moved = (w.state.frames.atPose3(X(w.frame)) for w in (window, there))
    seen, still = (
        p.transformTo(w.state.positions_of(w.state_features).T)
        for p, w in ((pose, window), (moved, there))
    )
    np.testing.assert_allclose(seen, still, atol=1e-9)


def test_the_prior_knows_that_it_was_moved() -> None:
    """It is what it was, but for a shift along the gauge: the way back is what is left of it."""
    window, state = flown()
    g = np.array([0.02, -0.01, 0.03, 0.002])
    there, _ = moved_by_gauge(window, state, g)
    prior = there.prior
    assert (
        left_of_gauge(window, window.prior.shifted(window.state.offset(prior.layout)), True) is None
    )
    posterior = prior.shifted(there.state.offset(prior.layout))
    N = gauge_directions(
        there.state.first, prior.layout, state.world_T_body.translation() + g[:3], level=True
    )
    before = window.prior.shifted(window.state.offset(prior.layout)).d
    change = np.sum(posterior.d**2) - np.sum((posterior.d + posterior.R @ N @ g) ** 2)
    assert change > 1.0
    assert np.sum((posterior.d + posterior.R @ N @ g) ** 2) == pytest.approx(
        before @ before, abs=1e-6
    )
    back = left_of_gauge(there, posterior, True)
    assert back is not None
    np.testing.assert_allclose(back, -g, rtol=0.02, atol=1e-5)


def test_fixes_turn_the_world_of_an_algorithm_with_damped_steps() -> None:
    """They found it 3 degrees off at first; a step along tangents is refused, as it stretches."""
    sequence = sg.simulate(
        trajectory="car",
        with_imu=True,
        seed=1,
        duration_s=25.0,
        tracks={"features": 60},
        gnss={"sigma_m": 1.0, "rate_hz": 2.0},
    )
    run = sg.run(sequence, algorithm="okvis", overrides=["final_ba.enabled=false"])
    assert run.status == "ok"
    assert len(run.segments) == 1
    assert run.groundtruth is not None
    errors = sg.ape(run.groundtruth, run.trajectory, alignment="none").values
    assert np.max(errors[-50:]) < 1.0
