# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One camera without an IMU takes its unit of length from position fixes."""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from gtsam.symbol_shorthand import B, V, X
from scipy.stats import chi2

import slam_graph as sg
from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.fix_factors import PositionFix
from slam_graph.backend.aiding.path_of_fixes import PathFix
from slam_graph.backend.aiding.regauging import regauged
from slam_graph.backend.aiding.rescaling import rescaled, rescaled_states, tangents
from slam_graph.backend.aiding.world_alignment import WorldAlignment, align_world
from slam_graph.backend.posed_frame import PosedFrame
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dims_of, imu_state_keys
from slam_graph.backend.window import Window
from slam_graph.datasets.faults.injection import inject
from slam_graph.geometry import NavState
from slam_graph.loop_closure import Keyframe, KeyframeLog
from slam_graph.results import RunResult, SavedRun
from slam_graph.results.segments import Segments
from slam_graph.sensors import FeatureFrame
from slam_graph.simulation.simulated_sequence import SimulatedSequence

SCALE = 2.3
CAMERA = gtsam.Pose3(gtsam.Rot3.Expmap([0.2, -0.1, 0.3]), [0.3, -0.2, 0.1])
CAUSAL = ["final_ba.enabled=false", BELIEVED]


def flight(**settings: Any) -> SimulatedSequence:
    """Tracks of one camera without an IMU, with fixes of 3 cm."""
    asked = {
        "trajectory": "figure8", "with_imu": False, "cameras": 1, "duration_s": 6.0, "seed": 1,
        "rate_hz": 10.0, "tracks": {"features": 60}, "gnss": {"sigma_m": 0.03, "rate_hz": 5.0},
    }  # fmt: skip
    return sg.simulate(**(asked | settings))


# --- laws ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def window() -> Window:
    """With past poses and features of the state, whose estimates have left their first ones."""
    sequence, told = flight(duration_s=3.5), sg.load_config("msckf")
    estimator = sg.Estimator(sequence.rig, told.algorithm, told.backend)
    for packet in sequence.packets():
        estimator.add_frame(packet.frame)
    assert estimator.window is not None
    assert len(estimator.window.state_features) > 5
    return estimator.window


def seen_by_the_camera(window: Window, first: bool) -> FloatArray:
    """Directions (N, 3) of all features of the state from the camera in all frames."""
    frames = [*window.past, window.frame]
    R, p = window.state.poses(frames, first)
    points = window.state.positions_of(window.state_features, first)
    centres = p + R @ np.asarray(CAMERA.translation())
    rays = np.einsum("fji,fnj->fni", R, points[None] - centres[:, None]).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


def test_another_unit_changes_no_image_and_no_prior(window: Window) -> None:
    there = rescaled(window, SCALE, CAMERA)
    for first in (False, True):
        seen = [seen_by_the_camera(w, first) for w in (window, there)]
        np.testing.assert_allclose(*seen, atol=1e-9)
    misfits = [w.prior.R @ w.state.offset(w.prior.layout) - w.prior.d for w in (window, there)]
    old, new = (float(misfit @ misfit) for misfit in misfits)
    assert new == pytest.approx(old, rel=1e-6)
    assert there.state.frozen == window.state.frozen
    back = rescaled(there, 1.0 / SCALE, CAMERA)
    np.testing.assert_allclose(back.prior.covariance(), window.prior.covariance(), atol=1e-9)
    assert rescaled(window, SCALE, None) is window


def turning(rng: np.random.Generator) -> tuple[list[NavState], NavState]:
    """Three states of a body that turns evenly, and the second with its rate as a bias."""
    rate, zero = rng.normal(size=3), np.zeros(3)
    start, P = gtsam.Pose3.Expmap(rng.normal(size=6)), np.diag(rng.uniform(0.1, 1.0, 15))
    states = []
    for k in range(3):
        turn = start.rotation().compose(gtsam.Rot3.Expmap(0.1 * k * rate))
        pose = gtsam.Pose3(turn, rng.normal(size=3))
        biases = {"accel_bias": zero, "gyro_bias": zero}
        states.append(NavState(k * 10**8, pose, rng.normal(size=3), **biases, covariance=P))
    return states, replace(states[1], gyro_bias=-rate)


def test_tangents_and_covariances_of_another_unit_are_those_of_its_derivative() -> None:
    states, state = turning(np.random.default_rng(1))
    there = rescaled_states(states, SCALE, CAMERA)[1]
    keys, arm = imu_state_keys(0), np.asarray(CAMERA.translation())

    def scaled(delta: FloatArray) -> tuple[gtsam.Pose3, FloatArray]:
        """Pose and velocity in the other unit, after an increment in GTSAM's order."""
        pose = state.world_T_body.retract(delta[:6])
        rate = -(state.gyro_bias + delta[12:])
        c = SCALE * pose.transformFrom(arm) - pose.rotation().rotate(arm)
        v = state.velocity + delta[6:9]
        more = pose.rotation().rotate(np.cross(rate, arm))
        return gtsam.Pose3(pose.rotation(), c), SCALE * v + (SCALE - 1.0) * more

    pose, velocity = scaled(np.zeros(15))
    assert there.world_T_body.equals(pose, 1e-9)
    np.testing.assert_allclose(there.velocity, velocity, atol=1e-9)
    values = gtsam.Values()
    values.insert(X(0), state.world_T_body)
    values.insert(V(0), state.velocity)
    values.insert(B(0), gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias))
    layout = Layout(dims_of(keys))
    T, step = tangents(values, layout, SCALE, arm), 1e-6
    for k in range(15):
        moved, after = scaled(step * np.eye(15)[k])
        change = np.concatenate([pose.localCoordinates(moved), after - velocity])
        np.testing.assert_allclose(change / step, T[:9, k], atol=1e-5)
    assert state.covariance is not None
    np.testing.assert_allclose(there.covariance, T @ state.covariance @ T.T, atol=1e-9)


def found_among(rng: np.random.Generator, true: FloatArray) -> WorldAlignment | None:
    """The world of fixes of 1 m, a fifth of them 30 m off, along a path of unknown unit."""
    pairs = []
    for k, place in enumerate(true):
        pose = gtsam.Pose3(gtsam.Rot3.Expmap([0.1 * k, 0.05 * k, 0.0]), place)
        noise = rng.normal(size=3) + (30.0 * rng.normal(size=3) if k % 5 == 0 else 0.0)
        fix = PositionFix(k, place + noise, np.eye(3), np.zeros(3))
        own = PosedFrame.rescaled_pose(pose, 1.0 / SCALE, CAMERA)
        pairs.append(PathFix(fix, own))
    return align_world(pairs, pairs[-1].pose.translation(), False, scaled_camera=CAMERA)


def test_scale_and_world_are_found_among_multipath_as_well_as_they_say() -> None:
    """NEES of seven degrees of freedom over 10 draws within its 99.9 % bounds."""
    rng, squares = np.random.default_rng(6), []
    way = np.linspace(0.0, 2 * np.pi, 40)
    true = np.column_stack([60 * np.cos(way), 40 * np.sin(2 * way), 4 * np.sin(3 * way)])
    for _ in range(10):
        found = found_among(rng, true)
        assert found is not None
        turn = gtsam.Rot3.Logmap(found.motion.rotation())
        # what is left of the gauge, about the point that the covariance is of
        R, s = found.motion.rotation().matrix(), found.scale / SCALE
        own = (R.T @ (found.centre - found.motion.translation())) / found.scale
        error = np.concatenate([found.centre - SCALE * own, turn, [np.log(s)]])
        squares.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.0005, 0.9995], 7 * 10) / 10
    assert low < np.mean(squares) < high
    line = np.column_stack([np.linspace(0, 60, 40), np.zeros((40, 2))])
    assert found_among(rng, line) is None, "a straight road tells no roll"


def test_a_window_in_the_world_of_fixes_knows_its_scale_as_they_do(window: Window) -> None:
    """The variance of the distance to a pose grows by that of the scale."""
    covariance = np.diag([1e-12] * 6 + [0.02**2])
    at, motion = np.zeros(3), gtsam.Pose3.Expmap([0.3, 0.2, -0.5, 4.0, 5.0, 6.0])
    found = WorldAlignment(
        *(motion, covariance, motion.transformFrom(at), np.ones(0, np.bool_)),
        scale=SCALE,
        scaled_camera=gtsam.Pose3(),
    )
    there, key = regauged(window, found), X(window.frame)
    own = window.state.first.atPose3(key).translation()
    old, new = (w.prior.covariance_of([key])[3:, 3:] for w in (window, there))
    grown = float(np.trace(new) - SCALE**2 * np.trace(old))
    assert grown == pytest.approx((0.02 * SCALE) ** 2 * own @ own, rel=1e-3)
    (told,) = found.settled([window.current(window.prior)])
    assert told.covariance is not None
    assert np.trace(told.covariance[3:6, 3:6]) == pytest.approx(np.trace(new), rel=0.01)


def test_keyframes_and_frames_see_the_same_in_another_unit() -> None:
    rng, motion = np.random.default_rng(2), gtsam.Pose3.Expmap([0.1, 0.2, 0.3, 4.0, 5.0, 6.0])
    sequence = flight(duration_s=1.0)
    log = KeyframeLog(sequence.rig, sg.load_config().loop_closure.keyframes)
    frame = next(iter(sequence.packets())).frame
    assert isinstance(frame, FeatureFrame)
    pose, points = gtsam.Pose3.Expmap(rng.normal(size=6)), rng.normal(size=(5, 3))
    nothing = np.zeros((5, 2)), np.zeros((5, 32), np.uint8)
    views = (PosedFrame.of(frame, [(0, pose)], sequence.rig),)
    log.keyframes = [Keyframe(k, pose, np.arange(5), *nothing, points, views) for k in range(2)]
    log.move(motion, 0, SCALE)
    stays, moved = log.keyframes
    assert stays.world_T_body.equals(pose, 0.0)
    camera = sequence.rig.cameras[0].body_T_camera
    (view,), at = moved.views, moved.world_T_body.compose(camera)
    np.testing.assert_allclose(view.position, moved.world_T_body.translation(), atol=1e-9)
    there = motion.transformFrom(SCALE * pose.compose(camera).translation())
    np.testing.assert_allclose(at.translation(), there, atol=1e-9)
    before, after = (np.asarray(camera.transformTo(p.T)).T for p in (points, moved.points))
    np.testing.assert_allclose(after, SCALE * before, atol=1e-9)


def test_lengths_are_in_metres_where_all_segments_are() -> None:
    segments = Segments()
    assert not segments.all_of_fixes
    segments.add(0, of_fixes=True)
    assert segments.all_of_fixes
    segments.end(5, "lost")
    segments.add(6, np.eye(6))
    assert not segments.all_of_fixes


# --- runs ----------------------------------------------------------------------------------------


def errors_m(result: RunResult) -> FloatArray:
    """Position errors of the causal estimate, nothing aligned."""
    assert result.groundtruth is not None
    return np.asarray(sg.ape(result.groundtruth, result.trajectory, alignment="none").values)


def test_a_run_with_fixes_is_in_metres_in_their_world(tmp_path: Any) -> None:
    result = sg.run(flight(), overrides=[BELIEVED])
    assert result.status == "ok"
    assert result.georeferenced
    assert result.history.has_scale
    assert "scale_unknown" not in result.warnings
    assert np.sqrt(np.mean(errors_m(result) ** 2)) < 0.08
    table = result.metrics
    assert table["world"]["of_fixes"]
    assert table["world"]["of_truth"]
    assert table["nees"]["alignment"] == "none"
    assert table["extent"]["scale"] == "metres"
    assert table["extent"]["alignment"] == "none"
    assert table["extent"]["unmeasured"] == "se3"
    assert table["accuracy"]["se3"]["ate"]["translation_m"]["rmse"] < 0.08
    assert result.final_ba is not None
    assert result.final_ba.history.has_scale
    assert result.smoothed is not None
    smoothed = sg.ape(result.groundtruth, result.smoothed, alignment="none")
    assert smoothed.statistics.rmse < 0.03
    result.save(tmp_path)
    assert SavedRun(tmp_path).scaled_camera is None


@pytest.mark.slow
def test_an_algorithm_of_several_steps_takes_the_scale_from_fixes() -> None:
    result = sg.run(flight(), algorithm="okvis", overrides=CAUSAL)
    assert result.history.has_scale
    assert np.sqrt(np.mean(errors_m(result) ** 2)) < 0.08


def test_what_was_lost_before_fixes_told_the_world_stays_apart() -> None:
    """Its unit of length is another one, and the rest has its fixes all the same."""
    lost = inject(flight(duration_s=10.0), ["all_missing:at_s=3.5,duration_s=1.5"])
    result = sg.run(lost, overrides=[BELIEVED, "min_coverage=0.1"])
    first, second = result.segments
    assert (first.of_fixes, second.of_fixes, second.joined_by) == (False, True, "none")
    assert not result.georeferenced
    assert not result.history.has_scale
    assert result.final_ba is not None
    smoothed = second.part_of(result.final_ba.trajectory)
    assert sg.ape(result.groundtruth, smoothed, alignment="none").statistics.rmse < 0.05


@pytest.mark.parametrize(("algorithm", "why"), [("msckf", "nothing told"), ("isam2", "smoothers")])
def test_where_fixes_do_not_tell_the_scale_the_run_says_so(
    algorithm: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence, told = flight(duration_s=3.0), list[str]()
    warn = sequence.diagnostics.warn

    def noted(kind: str, message: str) -> None:
        told.extend([message] if kind == "scale_unknown" else [])
        warn(kind, message)

    monkeypatch.setattr(sequence.diagnostics, "warn", noted)
    result = sg.run(sequence, algorithm=algorithm, overrides=CAUSAL)
    assert result.warnings["scale_unknown"] == len(told) == 1
    assert why in told[0]
    assert not result.history.has_scale
    assert result.metrics["extent"]["scale"] == "unknown"
