# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A clock that changes on the way: noticed, corrected, and the run goes on as if it had not."""

from typing import Any

import gtsam
import numpy as np
import pytest
from groups import slow, slow_but

import slam_graph as sg
from slam_graph.backend import BackendConfig
from slam_graph.backend.initialization.clock_change import ClockChange
from slam_graph.backend.initialization.start_calibration import FoundCalibration, StartCalibration
from slam_graph.datasets.faults.injection import inject
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.evaluation import ape
from slam_graph.frontend.prediction import ImuMotion
from slam_graph.geometry import NavState, Trajectory
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData, ImuNoise, Packet

CHANGED_S = 9.0
NONE = np.zeros(0, np.int64)


def flight(
    by_s: float | None = None, seed: int = 3, duration_s: float = 20.0, **settings: Any
) -> RecordedSequence:
    """Simulated stereo whose IMU is late (or early) from `CHANGED_S` on."""
    settings = {"rate_hz": 10.0, "cameras": 2, **settings}
    made = sg.simulate(trajectory="random", duration_s=duration_s, seed=seed, **settings)
    return inject(made, [f"imu_late:at_s={CHANGED_S},by_s={by_s}"] if by_s else [])


def found_in(
    recording: RecordedSequence, done: bool = False
) -> list[tuple[float, ClockChange | FoundCalibration]]:
    """What is found in a recording, and when, s; no estimator takes part.

    Args:
        recording: of tracks.
        done: whether the calibration counts as checked from the beginning.
    """
    check, imu = StartCalibration(recording.rig, BackendConfig()), ImuBuffer()
    check.done = done
    first_ns, found = recording.info().start_ns, []
    for packet in recording.packets():
        assert isinstance(packet.frame, FeatureFrame)
        imu.add(packet.imu)
        at_s = (packet.frame.stamp_ns - first_ns) * 1e-9
        change = check.add(packet.frame, imu, at_s > 2.0, NONE)
        if change is not None:
            found.append((at_s, change))
    return found


def changes(recording: RecordedSequence, done: bool = False) -> list[tuple[float, ClockChange]]:
    """Changes alone; nothing else is found."""
    everything = found_in(recording, done)
    found = [(at, x) for at, x in everything if isinstance(x, ClockChange)]
    assert len(found) == len(everything)
    return found


def error_m(result: RunResult, estimate: Trajectory) -> float:
    assert result.groundtruth is not None
    return ape(result.groundtruth, estimate, alignment="yaw").statistics.rmse


@pytest.mark.parametrize("by_s", [slow(0.03), -0.03, slow(0.08)])
@pytest.mark.parametrize("seed", [slow(1), 3])
def test_a_change_is_found_when_and_as_large_as_it_is(by_s: float, seed: int) -> None:
    """Within five seconds. Of a later clock the gap in the stamps tells the exact time."""
    recording = flight(by_s, seed)
    at_s, change = changes(recording)[0]
    assert CHANGED_S < at_s < CHANGED_S + 5.0
    assert abs(change.shift_s - by_s) < max(4.0 * change.sigma_s, 1e-4)
    begin_ns = recording.info().start_ns + round(CHANGED_S * 1e9)
    assert abs(change.good_ns - begin_ns) < 500_000_000  # which recovery leaves out before it
    assert begin_ns < change.frames_ns < begin_ns + 1_000_000_000
    if by_s > 0.0:
        assert 0 <= change.since_ns - begin_ns - round(by_s * 1e9) < 10_000_000


@pytest.mark.parametrize("rate_hz", [5.0, 9.66, 12.0, slow(20.0)])
def test_a_change_is_found_later_as_well_whatever_the_rate(rate_hz: float) -> None:
    """After the calibration was checked, by a few rotations a second."""
    recording = flight(0.03, rate_hz=rate_hz)
    at_s, change = changes(recording, done=True)[0]
    assert CHANGED_S < at_s < CHANGED_S + 6.0
    assert change.shift_s == pytest.approx(0.03, abs=1e-4)


@pytest.mark.parametrize("seed", [slow(1), 2, slow(3)])
@pytest.mark.parametrize("done", [False, True])
def test_a_clock_that_stays_is_left_alone(seed: int, done: bool) -> None:
    assert not changes(flight(seed=seed, duration_s=30.0), done)


@pytest.mark.parametrize("seed", slow_but({0, 2}, range(4)))
@pytest.mark.parametrize("by_s", [-0.009, 0.012])
def test_an_offset_that_is_wrong_all_the_time_is_no_change(by_s: float, seed: int) -> None:
    made = sg.simulate(trajectory="random", duration_s=20.0, rate_hz=10.0, seed=seed)
    found = found_in(inject(made, [f"imu_late:at_s=0,by_s={by_s}"]))
    assert all(isinstance(what, FoundCalibration) for _, what in found)


def test_a_gyroscope_that_says_nothing_is_no_error() -> None:
    recording = sg.simulate(trajectory="random", duration_s=15.0, rate_hz=10.0, seed=3)
    check, imu = StartCalibration(recording.rig, BackendConfig()), ImuBuffer()
    check.done = True
    for packet in recording.packets():
        assert isinstance(packet.frame, FeatureFrame)
        samples = packet.imu
        imu.add(ImuData(samples.stamps_ns, np.zeros_like(samples.gyro), samples.accel))
        assert check.add(packet.frame, imu, True, NONE) is None


def test_a_clock_that_was_corrected_at_the_start_may_change() -> None:
    """What the start has found is found anew until it is known well."""
    made = flight(None, seed=1, duration_s=26.0)
    late = inject(made, ["imu_late:at_s=0,by_s=0.05", "imu_late:at_s=16,by_s=0.03"])
    kinds = [type(what) for _, what in found_in(late)]
    assert kinds[0] is FoundCalibration
    assert ClockChange in kinds[1:]


@pytest.mark.parametrize("shift_s", [0.0, 0.1, -0.1])
def test_the_front_end_predicts_alike_on_any_clock(shift_s: float) -> None:
    """Its samples are on the new one, the state is on that of the beginning."""
    stamps = np.arange(0, 2_000_000_001, 5_000_000) + round(shift_s * 1e9)
    turns = np.tile([0.0, 0.0, 0.5], (len(stamps), 1))
    imu = ImuData(stamps, turns, np.tile([0.0, 0.0, 9.81], (len(stamps), 1)))
    zero, change = np.zeros(3), ClockChange(0, 0, 0, shift_s, 0.001)
    state = NavState(
        1_000_000_000, gtsam.Pose3(), np.array([1.0, 0, 0]), accel_bias=zero, gyro_bias=zero
    )
    features = FeatureFrame(state.stamp_ns, ())
    told = EstimatedFrame(
        *(Packet(imu, features), features, state, NONE, np.zeros((0, 3)), NONE, (1.0, 1.0), True),
        clock_changes=sg.Estimator.ClockChanges((change,)),
    ).feedback()
    motion = ImuMotion(ImuNoise(), 9.81)
    motion.add(imu)
    motion.state = told.state
    pose = motion.pose(state.stamp_ns + 100_000_000 + round(shift_s * 1e9))
    assert pose is not None
    assert pose.translation() == pytest.approx([0.1, 0.0, 0.0], abs=1e-6)
    assert pose.rotation().yaw() == pytest.approx(0.05)


def test_samples_are_put_on_the_old_clock() -> None:
    """As far as they do not overlap; what is corrected once is not changed again."""
    stamps = 5_000_000 * np.arange(200, dtype=np.int64)
    late = stamps + 30_000_000 * (stamps >= 500_000_000)
    samples = ImuData(late, np.zeros((200, 3)), np.zeros((200, 3)))
    change = ClockChange(530_000_000, 0, 0, 0.03, 0.001)
    corrected = change.corrected(samples)
    np.testing.assert_array_equal(corrected.stamps_ns, stamps)
    too_much = ClockChange(530_000_000, 0, 0, 0.05, 0.001).corrected(samples)
    assert np.all(np.diff(too_much.stamps_ns) > 0)
    assert len(too_much) == 196  # four would be before the last sample on the old clock


@pytest.mark.parametrize(("seed", "by_s"), [slow(3, 0.03), (4, -0.06)])
def test_a_run_goes_on_in_a_new_segment(seed: int, by_s: float) -> None:
    """Within five seconds, and as well as a clean run does; the whole is as good when smoothed."""
    seconds = CHANGED_S + 6.0
    clean, late = (sg.run(flight(by, seed=seed, duration_s=seconds)) for by in (None, by_s))
    assert late.status == "ok", late.message
    (_, after) = late.segments
    assert after.joined_by == "imu"
    changed_ns = late.input.start_ns + round(CHANGED_S * 1e9)
    assert late.segments[0].end_ns < changed_ns < after.begin_ns < changed_ns + 5_000_000_000
    limit_m = 2.0 * error_m(clean, clean.trajectory)
    for segment in late.segments:
        assert error_m(late, segment.part_of(late.trajectory)) < limit_m
    assert clean.smoothed is not None
    assert late.smoothed is not None
    assert error_m(late, late.smoothed) < 2.0 * error_m(clean, clean.smoothed)


@pytest.mark.slow
def test_without_recovery_a_run_goes_on_and_is_not_called_good() -> None:
    kept = "limits.recovery=false", "final_ba.enabled=false"
    result = sg.run(flight(0.03), overrides=kept)
    assert result.status in ("suspect", "diverged")
    assert len(result.segments) == 1
