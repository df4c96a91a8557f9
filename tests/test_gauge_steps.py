# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes move the world of a running estimate, whatever kind of steps it takes."""

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED, fed_with, seen_from_the_body
from gtsam.symbol_shorthand import X

import slam_graph as sg
from slam_graph.backend import MovingObjects
from slam_graph.backend.aiding.aiding_factors import Aiding
from slam_graph.backend.aiding.regauging import left_of_gauge, moved_by_gauge
from slam_graph.backend.aiding.world_alignment import WorldAlignment
from slam_graph.backend.objects.object_frame import ObjectDirection
from slam_graph.backend.objects.object_history import ObjectHistory
from slam_graph.backend.objects.object_state import ObjectState
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.window import Window
from slam_graph.backend.world_gauge import in_moved_world, with_unknown_gauge
from slam_graph.geometry import NavState


@pytest.fixture(scope="module")
def window() -> Window:
    """With past poses and features of the state."""
    sequence = sg.simulate(duration_s=3.0, rate_hz=10, cameras=2, tracks={"features": 40}, seed=3)
    found = fed_with(sequence, "msckf").window
    assert found is not None
    return found


def posterior_of(window: Window) -> SquareRootInformation:
    """What the prior knows, over an increment of the estimates."""
    return window.prior.shifted(window.state.offset(window.prior.layout))


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
        for old, new in zip(*(seen_from_the_body(w, first) for w in (window, there)), strict=True):
            np.testing.assert_allclose(new, old, atol=1e-9)
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


@pytest.mark.parametrize("size", [4, 6])
def test_an_object_moves_with_the_platform_to_the_world_of_fixes(size: int) -> None:
    """One that is where the platform is becomes what the platform becomes; what was before stays.

    A direction stays where it is before the platform.
    """
    rng = np.random.default_rng(size)
    motion, spread = gtsam.Pose3.Expmap(rng.normal(size=6)), rng.normal(size=(size, size))
    if size == 4:
        motion = gtsam.Pose3(gtsam.Rot3.Rz(2.0), motion.translation())
    found = WorldAlignment(motion, spread @ spread.T, rng.normal(size=3), np.ones(0, np.bool_))
    pose, velocity, zero = gtsam.Pose3.Expmap(rng.normal(size=6)), rng.normal(size=3), np.zeros(3)
    P = np.diag(rng.uniform(0.1, 1.0, 15))
    state = NavState(5, pose, velocity, accel_bias=zero, gyro_bias=zero, covariance=P)
    known = pose, P[:6, :6], pose, None, velocity, P[6:9, 6:9], True, 20
    objects, sight = ObjectHistory({}), pose.rotation().rotate([1.0, 0.0, 0.0])
    objects.note([ObjectState(stamp_ns, 1, 0, *known) for stamp_ns in (4, 5)], ())
    objects.directions = [ObjectDirection(5, 2, sight, sight, 0.1, 0.1, 5)]
    objects.settle(found, 5)
    there = with_unknown_gauge(
        in_moved_world([state], found.motion)[0], found.covariance, found.centre
    )
    before, moved = objects.states(1)
    assert before.world_T_object.equals(pose, 0.0)
    assert moved.world_T_object.equals(there.world_T_body, 1e-9)
    assert moved.world_T_body.equals(there.world_T_body, 1e-9)
    assert there.covariance is not None
    np.testing.assert_allclose(moved.covariance, there.covariance[:6, :6], atol=1e-9)
    np.testing.assert_allclose(moved.velocity, there.velocity, atol=1e-9)
    (seen,) = objects.directions
    ahead = there.world_T_body.rotation().unrotate(seen.direction)
    np.testing.assert_allclose(ahead, [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(seen.rate, seen.direction, atol=1e-9)


def test_objects_and_map_of_a_run_are_in_the_world_of_its_fixes() -> None:
    """From the beginning: also what was seen before that world was known."""
    sequence = sg.simulate(
        duration_s=4.5,
        rate_hz=10.0,
        seed=0,
        tracks={"features": 60, "pixel_sigma": 0.5, "descriptors": True},
        objects={"count": 1},
        gnss={"sigma_m": 0.05, "rate_hz": 5.0},
    )
    wanted = ("objects.enabled=true", "map.enabled=true", "final_ba.enabled=false", BELIEVED)
    run = sg.run(sequence, overrides=[*wanted, "backend.noise.pixel_sigma=0.5"])
    assert run.georeferenced
    assert run.objects is not None
    assert run.slam_map is not None
    offset_ns, first_ns = round(sequence.rig.pose_offset_s * 1e9), run.trajectory.stamps_ns[0]
    states, keyframes = run.objects.all_states(), run.slam_map
    assert states[0].stamp_ns + offset_ns < first_ns + 1_000_000_000
    assert keyframes.stamps_ns[0] == first_ns
    seen = [(s.stamp_ns + offset_ns, s.world_T_body.translation()) for s in states]
    seen += list(zip(keyframes.stamps_ns.tolist(), keyframes.poses.translations, strict=True))
    at = dict(zip(run.trajectory.stamps_ns.tolist(), run.trajectory.positions, strict=True))
    np.testing.assert_allclose([p for _, p in seen], [at[stamp] for stamp, _ in seen], atol=1e-6)


def test_frames_of_the_platform_move_with_its_world() -> None:
    """Once, where fixes move it again: what is at rest is not seen to move by that."""
    rng, told = np.random.default_rng(1), sg.load_config()
    settings = told.object_policies, told.backend, told.objects
    objects = MovingObjects(sg.simulate(duration_s=1.0).rig, *settings, {})
    poses = {k: gtsam.Pose3.Expmap(rng.normal(size=6)) for k in range(3)}
    objects._window._poses = dict(poses)
    objects._window._velocities = {k: pose.rotation().matrix()[0] for k, pose in poses.items()}
    estimator = sg.Estimator(sg.simulate(duration_s=1.0).rig, told.algorithm, told.backend)
    estimator.aiding.moved = motion = gtsam.Pose3.Expmap(rng.normal(size=6))
    for _ in range(2):
        objects._move(estimator)
        for k, pose in objects._window._poses.items():
            assert pose.equals(motion.compose(poses[k]), 1e-9)
            turned = motion.rotation().rotate(poses[k].rotation().matrix()[0])
            np.testing.assert_allclose(objects._window._velocities[k], turned)


@pytest.mark.slow
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
    run = sg.run(sequence, algorithm="okvis", overrides=["final_ba.enabled=false", BELIEVED])
    assert run.status == "ok"
    assert len(run.segments) == 1
    assert moves
    assert run.groundtruth is not None
    errors = sg.ape(run.groundtruth, run.trajectory, alignment="none").values
    assert np.max(errors[-50:]) < 1.0
