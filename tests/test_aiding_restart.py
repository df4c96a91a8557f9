# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes where the estimate has just begun, or begins anew with frames that were taken before."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from flight import Flight, rig
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.aiding_factors import Aiding
from slam_graph.backend.aiding.world_alignment import WorldAlignment
from slam_graph.backend.backend_config import BackendConfig, GnssConfig
from slam_graph.backend.cost.imu_factor import Propagation
from slam_graph.backend.initialization.first_state import start_from
from slam_graph.backend.solve.state import State
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.sensors import AidingData, ImuBuffer

STEP_NS, CONFIG = 10**8, BackendConfig()
WORLD = gtsam.Pose3(gtsam.Rot3.Yaw(0.7), np.array([30.0, -20.0, 5.0]))
"""Where the world of a flight is in that of its fixes."""


def states(first: int, end: int) -> list[NavState]:
    """Of a flight, every tenth of a second from 1 s on."""
    found = [Flight().nav_state(1.0 + k * STEP_NS * 1e-9) for k in range(first, end)]
    return [replace(state, covariance=1e-4 * np.eye(15)) for state in found]


def fixes_at(found: Sequence[NavState], off_m: float = 0.0, sigma_m: float = 0.1) -> AidingData:
    """Fixes just before some states, where the body is but for an error along x."""
    places = [WORLD.transformFrom(state.world_T_body.translation()) for state in found]
    stamps_ns = np.array([state.stamp_ns for state in found])
    covariances = np.tile(sigma_m**2 * np.eye(3), (len(found), 1, 1))
    return AidingData.of_fixes(stamps_ns, places + np.array([off_m, 0.0, 0.0]), covariances)


def aligned(aiding: Aiding, path: Sequence[NavState]) -> WorldAlignment | None:
    """The first alignment that the states of a path give."""
    return next(filter(None, map(aiding.alignment, path)), None)


# --- the first fix after a beginning -------------------------------------------------------------


def begun(propagation: Propagation, off_m: float) -> tuple[Window, Aiding]:
    """A window that has begun 0.1 s ago, with its first fix off by so much, σ 0.1 m."""
    start, end = states(0, 2)
    aiding = propagation.aiding = Aiding(CONFIG, level=True)
    aiding.aligned = True
    place = end.world_T_body.translation()[None] + np.array([off_m, 0.0, 0.0])
    aiding.add(AidingData.of_fixes(np.array([end.stamp_ns]), place, 0.01 * np.eye(3)[None]))
    imu = ImuBuffer()
    imu.add(Flight().imu(0.9, 1.2))
    window = start_from(start, CONFIG)
    propagation.append_frame(window, imu, end.stamp_ns, None)
    return window, aiding


def of_fixes(window: Window) -> list[gtsam.NonlinearFactor]:
    """The factors of fixes in a window."""
    return [factor for factor in window.factors if isinstance(factor, gtsam.GPSFactorArm)]


@pytest.mark.parametrize(("off_m", "rejected"), [(0.0, 0), (50.0, 1)])
def test_the_first_fix_after_a_beginning_is_gated(off_m: float, rejected: int) -> None:
    propagation = Propagation(rig().imu, CONFIG, Diagnostics())
    window, aiding = begun(propagation, off_m)
    gate = aiding.gates["gnss"]
    assert (gate.tested, gate.rejected) == (1, rejected)
    assert len(of_fixes(window)) == 1 - rejected


def test_the_first_fix_after_a_beginning_counts_less_where_it_is_off() -> None:
    """By Huber's weight under what is known of the state, of its prediction and of the fix."""
    off_m = 0.32
    propagation = Propagation(rig().imu, CONFIG, Diagnostics())
    window, _ = begun(propagation, off_m)
    (factor,) = of_fixes(window)
    imu = ImuBuffer()
    imu.add(Flight().imu(0.9, 1.2))
    start = start_from(states(0, 1)[0], CONFIG)
    known = propagation.predict(start.current(start.prior), imu, window.stamp_ns).covariance
    assert known is not None
    R = window.state.frames.atPose3(X(window.frame)).rotation().matrix()
    S = R @ known[3:6, 3:6] @ R.T + 0.01 * np.eye(3)
    e = factor.unwhitenedError(window.state.frames)  # type: ignore[attr-defined]
    distance = np.sqrt(e @ np.linalg.solve(S, e))
    assert 2.8 < distance < 4.0
    weight = 2.7955 / distance  # the 95 % sphere
    assert factor.error(window.state.frames) == pytest.approx(50.0 * weight * e @ e, rel=1e-3)


# --- what is left of a lost estimate -------------------------------------------------------------


def offered(aiding: Aiding, known: FloatArray, off_m: float, frame: int) -> int:
    """Number of factors of a fix that is off by so much, between two frames at rest."""
    state, pose = State(), Flight().nav_state(0.0)
    for k in (0, 1):
        state.insert_imu_state(k, pose)
    place = pose.world_T_body.translation()[None] + np.array([off_m, 0.0, 0.0])
    stamps_ns = frame * STEP_NS, (frame + 1) * STEP_NS
    aiding.add(AidingData.of_fixes(np.array([stamps_ns[1]]), place, np.eye(3)[None]))
    return len(aiding.factors(state, (0, 1), stamps_ns, known))


def test_the_gate_of_a_new_estimate_does_not_give_in_for_the_old_one() -> None:
    aiding, known = Aiding(CONFIG, level=True), 0.01 * np.eye(6)
    aiding.aligned = True
    passed = [offered(aiding, known, 50.0, frame) for frame in range(10)]
    assert (passed[0], passed[-1]) == (0, 1)  # most are off: it is the estimate that is wrong
    tested, rejected = aiding.gates["gnss"].tested, aiding.gates["gnss"].rejected
    aiding.restart()
    aiding.aligned = True
    assert offered(aiding, known, 50.0, 20) == 0
    assert aiding.gates["gnss"].tested == tested + 1
    assert aiding.gates["gnss"].rejected == rejected + 1


# --- frames that are taken again -----------------------------------------------------------------


@pytest.mark.parametrize("offset_s", [0.0, 0.05])
def test_fixes_of_frames_that_are_taken_again_are_used_again(offset_s: float) -> None:
    """Where the fixes are on a clock of their own, too, once that is known."""
    gnss = GnssConfig(time_offset_sigma_s=0.1 if offset_s else 0.0)
    aiding, path = Aiding(BackendConfig(gnss=gnss), level=True, calibrates=False), states(0, 50)
    data = fixes_at(path[1:-1], sigma_m=0.01)
    aiding.add(data.shifted(-round(offset_s * 1e9)))
    for again in (False, True):
        found = aligned(aiding, path[20:] if again else path)
        assert found is not None
        assert found.motion.equals(WORLD, 0.02)
        aiding.settle(found)
        assert aiding.offset_s == pytest.approx(offset_s, abs=5e-3)
        aiding.restart()


def test_fixes_before_the_first_state_are_not_used() -> None:
    aiding, path = Aiding(CONFIG, level=True), states(0, 60)
    aiding.add(fixes_at(path[:30]))
    assert aligned(aiding, path) is not None
    aiding.restart()
    assert aligned(aiding, path[30:]) is None


@pytest.mark.parametrize("started", [False, True])
def test_what_is_received_is_not_kept_for_ever(started: bool) -> None:
    """Neither before there is a state nor afterwards."""
    aiding, path = Aiding(CONFIG, level=True), states(0, 260)
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (1, 1))
    for number, (before, state) in enumerate(pairwise(path)):
        stamps_ns = np.array([state.stamp_ns])
        place = np.asarray(state.world_T_body.translation())[None]
        fixes = AidingData.empty() if number % 4 else fixes_at([state])
        aiding.add(fixes.with_odometry(stamps_ns, place, turns))
        if started:
            both = State()
            both.insert_imu_state(0, before)
            both.insert_imu_state(1, state)
            aiding.factors(both, (0, 1), (before.stamp_ns, state.stamp_ns), None)
            aiding.alignment(state)
    aiding.restart()
    assert aiding.by_odometry(path[-70], path[-60]) is not None
    assert aiding.by_odometry(path[-170], path[-160]) is None
    assert aligned(aiding, path[:120]) is None
    aiding.restart()
    assert aligned(aiding, path[-70:]) is not None
