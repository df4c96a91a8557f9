# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes move the world of a running estimate, whatever kind of steps it takes."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, V, X

import slam_graph as sg
from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.aiding_factors import Aiding
from slam_graph.backend.aiding.regauging import left_of_gauge, moved_by_gauge
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.window import Window
from slam_graph.backend.world_gauge import in_moved_world
from slam_graph.geometry import NavState


@pytest.fixture(scope="module")
def window() -> Window:
    """With past poses and features of the state."""
    sequence = sg.simulate(duration_s=3.0, rate_hz=10, cameras=2, tracks={"features": 40}, seed=3)
    told = sg.load_config("msckf")
    estimator = sg.Estimator(sequence.rig, told.algorithm, told.backend)
    for packet in sequence.packets():
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
    assert estimator.window is not None
    assert len(estimator.window.past) > 5
    assert len(estimator.window.state_features) > 5
    return estimator.window


def posterior_of(window: Window) -> SquareRootInformation:
    """What the prior knows, over an increment of the estimates."""
    return window.prior.shifted(window.state.offset(window.prior.layout))


def seen_from_the_body(window: Window, first: bool) -> FloatArray:
    """Poses, velocity and features relative to the last body, at estimates or first ones."""
    values = window.state.first if first else window.state.estimate
    last = values.atPose3(X(window.frame))
    poses = [last.between(values.atPose3(X(i))).matrix().ravel() for i in window.past]
    points = [last.transformTo(values.atPoint3(L(j))) for j in window.state_features.tolist()]
    velocity = last.rotation().unrotate(values.atVector(V(window.frame)))
    return np.concatenate([*poses, *points, velocity])


GAUGE = [[0.5, -0.3, 0.2, 0.06], [0.0, 0.0, 0.0, -1.0], [0.1, 0.2, -0.3, 0.1, -0.2, 0.3]]


@pytest.mark.parametrize("g", GAUGE)
def test_a_world_that_is_moved_keeps_all_that_is_relative(window: Window, g: list[float]) -> None:
    there, posterior, motion = moved_by_gauge(window, posterior_of(window), np.array(g))
    old, new = (w.state.frames.atPose3(X(w.frame)) for w in (window, there))
    assert new.equals(motion.compose(old), 1e-9)
    np.testing.assert_allclose(new.translation() - old.translation(), g[:3], atol=1e-9)
    turn = gtsam.Rot3.Logmap(new.rotation().compose(old.rotation().inverse()))
    np.testing.assert_allclose(turn, [0.0, 0.0, *g[3:]][-3:], atol=1e-9)
    for first in (True, False):
        relative = [seen_from_the_body(w, first) for w in (window, there)]
        np.testing.assert_allclose(*relative, atol=1e-9)
    state = in_moved_world([window.current(posterior_of(window))], motion)[0]
    reported = there.current(posterior)
    assert reported.covariance is not None
    np.testing.assert_allclose(reported.covariance, state.covariance, rtol=1e-6, atol=1e-12)
    assert there.lost_features.size == 0


def test_the_posterior_knows_that_the_world_was_moved(window: Window) -> None:
    """It was at its least; the way back is what is left of it, and nothing after that."""
    known, g = posterior_of(window), np.array([0.02, -0.01, 0.03, 0.002])
    assert left_of_gauge(window, known, level=True) is None
    there, moved, _ = moved_by_gauge(window, known, g)
    np.testing.assert_allclose(moved.d, posterior_of(there).d, atol=1e-6)
    back = left_of_gauge(there, moved, level=True)
    assert back is not None
    np.testing.assert_allclose(back, -g, rtol=0.02, atol=1e-5)
    again, rest, _ = moved_by_gauge(there, moved, back)
    assert left_of_gauge(again, rest, level=True) is None


def test_fixes_turn_the_world_of_an_algorithm_with_damped_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They found it 3 degrees off at first; a step along tangents is refused, as it stretches."""
    sequence = sg.simulate(
        trajectory="car",
        with_imu=True,
        seed=1,
        duration_s=25.0,
        tracks={"features": 60},
        gnss={"sigma_m": 1.0, "rate_hz": 2.0},
    )
    moves: list[NavState] = []
    moved = Aiding.in_moved_world

    def noted(aiding: Aiding, state: NavState, motion: gtsam.Pose3) -> NavState:
        moves.append(moved(aiding, state, motion))
        last = aiding._path.states[-1].world_T_body
        assert last.equals(moves[-1].world_T_body, 1e-9), "late fixes are taken along the path"
        assert aiding.was_revised(state.stamp_ns)
        return moves[-1]

    monkeypatch.setattr(Aiding, "in_moved_world", noted)
    run = sg.run(sequence, algorithm="okvis", overrides=["final_ba.enabled=false"])
    assert run.status == "ok"
    assert len(run.segments) == 1
    assert moves
    assert run.groundtruth is not None
    errors = sg.ape(run.groundtruth, run.trajectory, alignment="none").values
    assert np.max(errors[-50:]) < 1.0
