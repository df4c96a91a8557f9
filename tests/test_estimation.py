# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The back end's part of a run: what it notes at a frame, at a loss and at the end."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from map_flights import World

import slam_graph as sg
from slam_graph.arrays import FloatArray
from slam_graph.backend import Estimator, MovingObjects
from slam_graph.backend.aiding.world_alignment import WorldAlignment
from slam_graph.backend.initialization.clock_change import ClockChange
from slam_graph.backend.objects.object_frame import ObjectDirection
from slam_graph.backend.objects.object_state import ObjectState
from slam_graph.backend.world_gauge import in_moved_world
from slam_graph.config import load_config
from slam_graph.datasets.faults.injection import inject
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.pipeline.divergence import DivergenceError
from slam_graph.pipeline.recovery import Recovery
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.results import RunInput, RunResult
from slam_graph.results.localization_result import LocalizationLog
from slam_graph.sensors import FeatureFrame, ImuData

CAUSAL = ["final_ba.enabled=false", "backend.initialization.mode=given"]
SECOND_NS = 1_000_000_000

Finish = Callable[[Estimator], list[NavState]]


def flown(monkeypatch: pytest.MonkeyPatch, finish: Finish) -> RunResult:
    """A short run whose estimator finishes in another way."""
    monkeypatch.setattr(Estimator, "finish", finish)
    flight = sg.simulate(duration_s=3.0, rate_hz=10.0, cameras=2, seed=1)
    return sg.run(flight, overrides=[*CAUSAL, "limits.refuse_wrong_setup=false"])


def later_than(estimator: Estimator, steps: int, **changes: Any) -> NavState:
    """The last state some frames later, changed."""
    state = estimator.states[-1]
    return replace(state, stamp_ns=state.stamp_ns + steps * SECOND_NS // 10, **changes)


def velocities(result: RunResult) -> FloatArray:
    """(N, 3) of all states."""
    found = result.history.trajectory().velocities
    assert found is not None
    return found


def test_a_new_beginning_at_the_end_is_noted_with_its_calibration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def finish(estimator: Estimator) -> list[NavState]:
        estimator._corrected = True
        states = [later_than(estimator, steps) for steps in (1, 2)]
        estimator.states = estimator.replayed = states
        return states

    result = flown(monkeypatch, finish)
    assert result.status in ("ok", "low_coverage")
    assert len(result.history) == 2, "states before are superseded"
    assert result.corrected_rig is not None


@pytest.mark.parametrize("wrong", [0, 1])
def test_no_state_that_cannot_be_true_is_noted_at_the_end(
    monkeypatch: pytest.MonkeyPatch, wrong: int
) -> None:
    """Whichever of several it is."""

    def finish(estimator: Estimator) -> list[NavState]:
        if not estimator.states:  # after the loss
            return []
        velocity = np.full(3, np.nan)
        states = [
            later_than(estimator, 1 + k, **({"velocity": velocity} if k == wrong else {}))
            for k in range(2)
        ]
        estimator.states = states
        return states

    result = flown(monkeypatch, finish)
    assert result.status == "diverged"
    assert "the state is not finite" in result.message
    assert len(result.history) > 10, "what was good stays"
    assert np.isfinite(velocities(result)).all()


@pytest.mark.parametrize("error", [RuntimeError("singular\nsystem"), np.linalg.LinAlgError("no")])
def test_equations_that_cannot_be_solved_at_the_end_are_a_divergence(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def finish(estimator: Estimator) -> list[NavState]:
        raise error

    result = flown(monkeypatch, finish)
    assert result.status == "diverged"
    assert "diverged at the last frames: the equations cannot be solved" in result.message
    assert len(result.history) > 10


def test_each_of_several_states_of_a_frame_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not only the last one."""
    add_frame, count = Estimator.add_frame, 0

    def with_another(estimator: Estimator, frame: FeatureFrame) -> NavState | None:
        nonlocal count
        state, count = add_frame(estimator, frame), count + 1
        if state is not None and count == 20:
            before = replace(state, stamp_ns=state.stamp_ns - 1, velocity=np.full(3, np.inf))
            estimator.states = [before, state]
        return state

    monkeypatch.setattr(Estimator, "add_frame", with_another)
    result = flown(monkeypatch, Estimator.finish)
    assert result.warnings["new_segment"] == 1
    assert np.isfinite(velocities(result)).all()


class Frames:
    """A viewer that keeps what it is shown: frames, and the report of the estimator then."""

    def __init__(self) -> None:
        self.shown: list[tuple[EstimatedFrame, Any]] = []

    def show(self, frame: EstimatedFrame, estimator: Estimator) -> None:
        self.shown.append((frame, estimator.report))

    def open(self, *_: object) -> None: ...
    def finish(self, *_: object) -> None: ...
    def close(self) -> None: ...


def test_a_frame_that_no_step_has_seen_reports_none() -> None:
    """Where nothing was recorded before it, the estimator is not asked."""
    flight = sg.simulate(duration_s=5.0, rate_hz=10.0, cameras=2, seed=1)
    frames = Frames()
    sg.run(inject(flight, ["all_missing:at_s=3,duration_s=1.5"]), overrides=CAUSAL, viewer=frames)
    (lost,) = (k for k, (frame, _) in enumerate(frames.shown) if frame.restarted)
    assert frames.shown[lost - 1][1].innovations.tested
    frame, report = frames.shown[lost]
    assert frame.state is None
    assert not frame.waits
    assert not len(frame.rejected)
    assert not report.innovations.tested
    assert not report.timings


# --- what counts as recorded ---------------------------------------------------------------------


@pytest.fixture
def recovery() -> tuple[Recovery, Estimator]:
    """Of a run with a state at 10 s and samples up to there."""
    flight = sg.simulate(duration_s=1.0, cameras=2)
    config, info = load_config(), flight.info()
    result = RunResult(RunInput(info, config, flight.rig, info.start_ns, info.end_ns))
    estimator = Estimator(flight.rig, config.algorithm, config.backend)
    state = NavState(
        10 * SECOND_NS,
        gtsam.Pose3(),
        np.zeros(3),
        accel_bias=np.zeros(3),
        gyro_bias=np.zeros(3),
        covariance=np.eye(15),
    )
    estimator.start(state)
    estimator.add_imu(samples(9.0, 10.0))
    recovery = Recovery(result, estimator, Diagnostics())
    recovery.append([state])
    return recovery, estimator


@pytest.mark.slow
def test_frames_alone_may_be_missing_where_the_imu_leads() -> None:
    """As it does once a time offset is found."""
    flight = sg.simulate(trajectory="random", duration_s=15.0, rate_hz=10.0, cameras=2, seed=3)
    faults = ["imu_late:at_s=0,by_s=0.03", "frames_dropped:at_s=11,duration_s=1.5"]
    result = sg.run(inject(flight, faults), overrides=["final_ba.enabled=false"])
    assert result.warnings["calibration_corrected"] == 1
    assert result.warnings["frame_gap"] == 1
    assert [segment.ended_by for segment in result.segments] == [""]


def samples(begin_s: float, end_s: float) -> ImuData:
    """Samples at 100 Hz, after one time up to another."""
    stamps = (np.arange(round(begin_s * 100), round(end_s * 100)) + 1) * (SECOND_NS // 100)
    return ImuData(stamps.astype(np.int64), *np.zeros((2, len(stamps), 3)))


def test_samples_that_came_with_an_earlier_frame_were_recorded(
    recovery: tuple[Recovery, Estimator],
) -> None:
    """Where the IMU has to lead, they have: the packet of the next frame begins after it."""
    check, estimator = recovery
    estimator.add_imu(samples(10.0, 11.5))
    check.check_recorded(11 * SECOND_NS + SECOND_NS // 2)
    estimator.add_imu(samples(11.5, 11.6))
    check.check_recorded(11 * SECOND_NS + SECOND_NS // 2)


@pytest.mark.parametrize("shift_s", [2.0, -2.0])
def test_so_were_those_on_another_clock(
    recovery: tuple[Recovery, Estimator], shift_s: float
) -> None:
    check, estimator = recovery
    change = ClockChange(0, 0, 0, shift_s, 0.001)  # all samples that follow are of the new clock
    estimator.clock_changes = estimator.clock_changes.and_then(change)
    estimator.add_imu(samples(10.0 + shift_s, 11.3 + shift_s))
    check.check_recorded(11 * SECOND_NS + SECOND_NS // 5)


def test_a_time_without_frames_and_samples_is_refused(
    recovery: tuple[Recovery, Estimator],
) -> None:
    check, estimator = recovery
    estimator.add_imu(samples(11.2, 11.5))
    with pytest.raises(DivergenceError, match=r"nothing was recorded for 1\.2 s"):
        check.check_recorded(11 * SECOND_NS + SECOND_NS // 2)


# --- what rests on states ------------------------------------------------------------------------


def state_at(stamp_s: float) -> NavState:
    """A state somewhere."""
    pose = gtsam.Pose3(gtsam.Rot3.Rz(stamp_s), np.array([stamp_s, 1.0, 2.0]))
    known = {"accel_bias": np.zeros(3), "gyro_bias": np.zeros(3), "covariance": np.eye(15)}
    return NavState(round(stamp_s * SECOND_NS), pose, np.zeros(3), **known)


def with_objects(check: Recovery, stamps_s: list[float]) -> tuple[MovingObjects, LocalizationLog]:
    """An object, a direction, and a pose in a map at some times of a run, all where it is."""
    result = check._result
    config = result.config
    settings = config.object_policies, config.backend, config.objects
    objects = result.objects = MovingObjects(result.rig, *settings, {})
    log = result.begin_localization(World().map())
    for stamp_s in stamps_s:
        stamp_ns, pose = round(stamp_s * SECOND_NS), state_at(stamp_s).world_T_body
        known = pose, np.eye(6), pose, None, np.zeros(3), np.eye(3), True, 20
        objects.note([ObjectState(stamp_ns, 1, 0, *known)], ())
        objects.directions.append(ObjectDirection(stamp_ns, 2, *np.eye(3)[:2], 0.1, 0.1, 5))
        log.append(stamp_ns, True, pose, 0.1)
    return objects, log


def test_what_rests_on_states_that_are_taken_back_goes_with_them(
    recovery: tuple[Recovery, Estimator],
) -> None:
    check, _ = recovery
    objects, log = with_objects(check, [9.0, 10.0, 10.5])
    check._result.forget_states(10 * SECOND_NS)
    assert [state.stamp_ns for state in objects.states(1)] == [9 * SECOND_NS]
    assert [seen.stamp_ns for seen in objects.directions] == [9 * SECOND_NS]
    assert log.located.tolist() == [True, False, False]
    assert log.trajectory().stamps_ns.tolist() == [9 * SECOND_NS]
    check._result.forget_states(None)
    assert objects.numbers == []
    assert not log.located.any()
    objects.begin(check._result.rig)
    assert objects._tracker._next == 3, "a number means one object for good"


@pytest.mark.parametrize("rigid", [True, False])
def test_what_rests_on_states_that_move_with_their_world_stays(
    recovery: tuple[Recovery, Estimator], rigid: bool
) -> None:
    """To that of the fixes; states that come back otherwise are other ones."""
    check, estimator = recovery
    before = [state_at(10.0), state_at(10.1)]
    check._recent.clear()
    check.append(before)
    objects, log = with_objects(check, [10.0, 10.1])
    motion = gtsam.Pose3(gtsam.Rot3.Rz(1.0), np.array([100.0, -50.0, 2.0]))
    found = WorldAlignment(motion, np.eye(4), np.zeros(3), np.ones(0, np.bool_))
    estimator.aiding.found = found
    after = in_moved_world(before, motion)
    after[0] = after[0] if rigid else before[0]
    check.supersede(after)
    assert (check.world_motion is not None) == rigid
    assert log.located.all() == rigid
    assert (objects.numbers == [1]) == rigid
