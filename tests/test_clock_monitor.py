# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A clock that changes on the way: noticed, corrected, and the run goes on as if it had not."""

from functools import cache

import numpy as np
import pytest

import slam_graph as sg
from slam_graph.backend import BackendConfig
from slam_graph.backend.initialization.clock_monitor import ClockChange
from slam_graph.backend.initialization.start_calibration import StartCalibration
from slam_graph.datasets.faults.injection import inject
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.evaluation import ape
from slam_graph.geometry import Trajectory
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData

CHANGED_S = 9.0


def flight(by_s: float | None = None, seed: int = 3, duration_s: float = 20.0) -> RecordedSequence:
    """Simulated stereo whose IMU is late (or early) from `CHANGED_S` on."""
    made = sg.simulate(
        trajectory="random", duration_s=duration_s, rate_hz=10.0, seed=seed, cameras=2
    )
    return inject(made, [f"imu_late:at_s={CHANGED_S},by_s={by_s}"] if by_s else [])


def changes(recording: RecordedSequence) -> list[tuple[float, ClockChange]]:
    """Changes that are found in a recording, and when they are, s; no estimator takes part."""
    check, imu = StartCalibration(recording.rig, BackendConfig()), ImuBuffer()
    first_ns, found = recording.info().start_ns, []
    for packet in recording.packets():
        assert isinstance(packet.frame, FeatureFrame)
        imu.add(packet.imu)
        at_s = (packet.frame.stamp_ns - first_ns) * 1e-9
        change = check.add(packet.frame, imu, started=at_s > 2.0)
        if change is not None:
            assert isinstance(change, ClockChange)
            found.append((at_s, change))
    return found


@cache
def flown(by_s: float | None, algorithm: str) -> RunResult:
    return sg.run(flight(by_s), algorithm=algorithm)


def error_m(result: RunResult, estimate: Trajectory) -> float:
    assert result.groundtruth is not None
    return ape(result.groundtruth, estimate, alignment="yaw").statistics.rmse


@pytest.mark.parametrize("by_s", [0.03, -0.03, 0.08])
@pytest.mark.parametrize("seed", [1, 3])
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


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_clock_that_stays_is_left_alone(seed: int) -> None:
    assert not changes(flight(seed=seed, duration_s=30.0))


def test_samples_are_put_on_the_old_clock() -> None:
    """As far as they do not overlap; what is corrected once is not changed again."""
    stamps = 5_000_000 * np.arange(200, dtype=np.int64)
    late = stamps + 30_000_000 * (stamps >= 500_000_000)
    samples = ImuData(late, np.zeros((200, 3)), np.zeros((200, 3)))
    change = ClockChange(530_000_000, 0, 0, 0.03, 0.001)
    corrected = change.corrected(samples)
    np.testing.assert_array_equal(corrected.stamps_ns, stamps)
    early = ClockChange(500_000_000, 0, 0, -0.03, 0.001).corrected(corrected)
    assert np.all(np.diff(early.stamps_ns) > 0)
    assert len(early) == 200


@pytest.mark.parametrize("algorithm", ["msckf", "fixed_lag_isam2"])
def test_a_run_goes_on_in_a_new_segment(algorithm: str) -> None:
    """Within five seconds, and as well as a clean run does; the whole is as good when smoothed."""
    clean, late = flown(None, algorithm), flown(0.03, algorithm)
    assert late.status == "ok", late.message
    assert "clock" in late.segments[0].ended_by
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


def test_without_recovery_a_run_goes_on_and_is_not_called_good() -> None:
    kept = "limits.recovery=false", "final_ba.enabled=false"
    result = sg.run(flight(0.03), overrides=kept)
    assert result.status in ("suspect", "diverged")
    assert len(result.segments) == 1
