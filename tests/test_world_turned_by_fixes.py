# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A step by which fixes turn the world turns all of it as one body."""

from copy import deepcopy
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED, fed_with, seen_from_the_body
from gtsam.symbol_shorthand import X

import slam_graph as sg
from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.regauging import gauge_directions, moved_by_gauge
from slam_graph.backend.aiding.world_linearization import moved_with_world
from slam_graph.backend.cost.unit_of_length import scale_direction
from slam_graph.backend.engine import SquareRootEngine
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dims_of
from slam_graph.backend.window import Window
from slam_graph.evaluation.consistency import nees

G = np.array([0.05, -0.03, 0.02, 0.02, -0.015, 0.03])
"""Shift (m) and turn (rad) of a step."""


def estimator_after(
    algorithm: str, cameras: int, duration_s: float, with_imu: bool = False
) -> sg.Estimator:
    """One with a window."""
    sequence = sg.simulate(
        trajectory="figure8", with_imu=with_imu, cameras=cameras, duration_s=duration_s,
        rate_hz=10.0, seed=3, tracks={"features": 40},
    )  # fmt: skip
    return fed_with(sequence, algorithm)


def after(algorithm: str, cameras: int, duration_s: float, with_imu: bool = False) -> Window:
    """The window of an estimator."""
    window = estimator_after(algorithm, cameras, duration_s, with_imu).window
    assert window is not None
    return window


@pytest.fixture(scope="module")
def window() -> Window:
    """Of two cameras."""
    return after("msckf", 2, 3.0)


def stepped(window: Window, camera: gtsam.Pose3 | None = None, g: FloatArray = G) -> Window:
    """After a step that fixes alone ask for: along the straight tangents of the gauge."""
    layout = window.prior.layout
    first = window.state.first
    centre = window.state.first_frames.atPose3(X(window.frame)).translation()
    step = gauge_directions(first, layout, centre, level=len(g) == 4) @ g
    if camera is not None:
        step += 0.02 * scale_direction(first, layout, centre, np.asarray(camera.translation()))
    state = window.state.copy()
    state.update(layout, step)
    lost = deepcopy(window.lost_features)
    return replace(window, state=state, prior=window.prior.shifted(-step), lost_features=lost)


def known_of_gauge(window: Window) -> FloatArray:
    """(6, 6) information on the place of the world."""
    layout = Layout(dims_of(window.prior.layout.dims))
    centre = window.state.first_frames.atPose3(X(window.frame)).translation()
    rows = window.prior.R @ gauge_directions(window.state.first, layout, centre, level=False)
    return np.asarray(rows.T @ rows)


def test_a_step_of_the_world_keeps_all_that_is_relative(window: Window) -> None:
    after_step = stepped(window)
    there = moved_with_world(after_step, window.state, False, None, linear=True)
    for first in (True, False):
        for old, new in zip(*(seen_from_the_body(w, first) for w in (window, there)), strict=True):
            np.testing.assert_allclose(new, old, atol=1e-4)
    torn = seen_from_the_body(after_step, False)[1] - seen_from_the_body(window, False)[1]
    assert np.abs(torn).max() > 0.01, "the straight step moves features against the body"
    pose, told = (w.state.frames.atPose3(X(w.frame)) for w in (there, after_step))
    assert pose.equals(told, 2e-3)
    mean = there.prior.R @ there.state.offset(there.prior.layout) - there.prior.d
    np.testing.assert_allclose(mean, 0.0, atol=1e-6)
    scale = np.sqrt(np.outer(*[np.diag(known_of_gauge(window)) + 1e-6] * 2))
    apart = (known_of_gauge(there) - known_of_gauge(after_step)) / scale
    assert np.abs(apart).max() < 0.05, "what nothing measures stays unmeasured"


def test_with_an_imu_the_world_turns_about_the_vertical() -> None:
    window = after("msckf", 2, 3.0, with_imu=True)
    after_step = stepped(window, g=G[[0, 1, 2, 5]])
    there = moved_with_world(after_step, window.state, True, None, linear=True)
    for first in (True, False):
        for old, new in zip(*(seen_from_the_body(w, first) for w in (window, there)), strict=True):
            np.testing.assert_allclose(new, old, atol=1e-4)


def test_a_world_that_is_moved_after_a_step_is_moved_once() -> None:
    """What a damped step has left is no part of the step."""
    estimator = estimator_after("msckf", 2, 3.0)
    window, engine = estimator.window, estimator._engine
    assert window is not None
    assert isinstance(engine, SquareRootEngine)
    known = window.prior.shifted(window.state.offset(window.prior.layout))
    there, engine._posterior, _ = moved_by_gauge(window, known, G)
    engine._before = there.state  # a step that did nothing
    back, motion = engine.regauged(there, level=False, measured=True)
    assert motion is not None
    for first in (True, False):
        for old, new in zip(*(seen_from_the_body(w, first) for w in (window, back)), strict=True):
            np.testing.assert_allclose(new, old, atol=1e-6)


def test_estimates_at_the_least_cost_stay(window: Window) -> None:
    """Only the points of linearisation move, and the prior has its mean where it was."""
    after_step = stepped(window)
    there = moved_with_world(after_step, window.state, False, None, linear=False)
    for old, new in zip(*(seen_from_the_body(w, False) for w in (after_step, there)), strict=True):
        np.testing.assert_allclose(new, old, atol=1e-9)
    old, new = (seen_from_the_body(w, True)[1] for w in (window, there))
    np.testing.assert_allclose(new, old, atol=1e-6)
    mean = there.prior.R @ there.state.offset(there.prior.layout) - there.prior.d
    np.testing.assert_allclose(mean, 0.0, atol=1e-6)


def test_a_step_in_scale_scales_all_of_the_window() -> None:
    window = after("msckf", 1, 3.0)
    camera = sg.simulate(with_imu=False, cameras=1, duration_s=1.0).rig.cameras[0].body_T_camera
    there = moved_with_world(stepped(window, camera), window.state, False, camera, linear=True)
    for first in (True, False):
        old, new = (camera.transformTo(seen_from_the_body(w, first)[1].T) for w in (window, there))
        scale = np.sum(new * old) / np.sum(old * old)
        assert scale == pytest.approx(np.exp(0.02), rel=1e-3)
        np.testing.assert_allclose(new, scale * old, atol=1e-3)


def test_features_that_are_not_tracked_move_with_the_world() -> None:
    """Recalled, they are before the camera where they were."""
    window = after("swf", 2, 4.0)
    ids = np.array(sorted(window.lost_features._places))[:10]
    assert len(ids) > 3
    there = window
    for _ in range(5):  # by 12 degrees in all
        there = moved_with_world(stepped(there), there.state, False, None, linear=True)
    seen = []
    for each in (window, there):
        state = each.state.copy()
        deepcopy(each.lost_features).recall(ids, each.prior, state)
        body = state.frames.atPose3(X(each.frame))
        both = state.positions_of(ids, first=True), state.positions_of(ids)
        seen += [body.transformTo(points.T).T for points in both]
    distances = np.linalg.norm(seen[0], axis=1, keepdims=True)
    for old, new in zip(seen[:2], seen[2:], strict=True):
        assert np.max(np.abs(new - old) / distances) < 2e-3


def test_the_orientation_is_as_sure_as_it_is_right() -> None:
    """With steps along straight tangents its NEES was 116 here, where 3 is ideal."""
    sequence = sg.simulate(
        trajectory="figure8", with_imu=False, duration_s=8.0, rate_hz=10.0, seed=4,
        tracks={"features": 60}, gnss={"sigma_m": 0.02, "rate_hz": 5.0},
    )  # fmt: skip
    run = sg.run(sequence, overrides=["final_ba.enabled=false", BELIEVED])
    assert run.georeferenced
    assert run.groundtruth is not None
    errors = nees(run.trajectory, run.history.pose_covariances(), run.groundtruth)
    assert np.mean(errors.orientation[-20:]) < 15.0
