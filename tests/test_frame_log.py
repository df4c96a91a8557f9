# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is read back from the log of frames, and what the benchmarks read once for several runs."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from benchmarks.running import read_once
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.smoothing import recording_problem
from slam_graph.backend.smoothing.cost_minimization import minimized
from slam_graph.backend.smoothing.final_adjustment import adjust_recording
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.imu_noise_estimation import ImuNoiseFactors
from slam_graph.backend.smoothing.keyframe_states import states_at
from slam_graph.backend.smoothing.learned_imu_noise import Minimum, _LinearImages
from slam_graph.backend.smoothing.recording_cost import Estimates, RecordingCost, moved_states
from slam_graph.backend.smoothing.recording_problem import BundleAdjustment
from slam_graph.backend.smoothing.recording_segment import read_segment
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.backend.smoothing.smoothing_task import (
    LooseAdjustment,
    SegmentStart,
    SmoothingTask,
)
from slam_graph.backend.smoothing.state_elimination import ChainEquations
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData, Packet
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

FIRST, STOP = 7, 31
CONFIG = FinalBaConfig(fuse_features=False, robust_loss="none")


@pytest.fixture(scope="module")
def flight() -> SimulatedSequence:
    return simulate(duration_s=4.0, rate_hz=10.0, cameras=2, seed=3, tracks={"features": 20})


@pytest.fixture(scope="module")
def packets(flight: SimulatedSequence) -> list[Packet]:
    return list(flight.packets())


@pytest.fixture(scope="module")
def log(
    flight: SimulatedSequence, packets: list[Packet], tmp_path_factory: pytest.TempPathFactory
) -> FrameLog:
    folder: Path = tmp_path_factory.mktemp("frames")
    with FrameLog.recording(flight.rig, FinalBaConfig(), folder) as log:
        for packet in packets:
            assert isinstance(packet.frame, FeatureFrame)
            log.add(packet.imu, packet.frame, (1.0, 1.0))
    return log


def test_features_are_those_of_the_frames(log: FrameLog, packets: list[Packet]) -> None:
    counts, rows = log.features(FIRST, STOP)
    assert counts.shape == (STOP - FIRST, 2)
    begin = 0
    for number, of_frame in enumerate(counts):
        frame = packets[FIRST + number].frame
        assert isinstance(frame, FeatureFrame)
        for seen, count in zip(frame.cameras, of_frame, strict=True):
            own = rows[begin : begin + count]
            assert np.array_equal(own["id"], seen.ids)
            assert np.array_equal(own["pixel"], seen.pixels)
            assert np.array_equal(own["normalized"], seen.normalized)
            begin += count
    assert begin == len(rows)


def test_features_that_move_are_not_read_back(log: FrameLog, packets: list[Packet]) -> None:
    moving = log.features(FIRST, STOP)[1]["id"][::7]
    still = log.without(moving[:3]).without(moving)
    counts, rows = still.part(None, None).features(FIRST, STOP)
    begin = 0
    for number, of_frame in enumerate(counts):
        frame = packets[FIRST + number].frame
        assert isinstance(frame, FeatureFrame)
        for seen, count in zip(frame.without(moving).cameras, of_frame, strict=True):
            assert np.array_equal(rows["id"][begin : begin + count], seen.ids)
            begin += count
    assert begin == len(rows) < len(log.features(FIRST, STOP)[1])


def test_damaged_features_are_refused(log: FrameLog, packets: list[Packet]) -> None:
    (file,) = log._recorder.path.glob("features.bin")
    kept = file.read_bytes()
    try:
        damaged = np.frombuffer(kept, np.uint8).copy()
        damaged[8:16] = np.frombuffer(np.array([np.nan]).tobytes(), np.uint8)
        file.write_bytes(damaged.tobytes())
        with pytest.raises(DataError, match="a feature is not finite"):
            log.features(0, 3)
    finally:
        file.write_bytes(kept)


@pytest.mark.parametrize("offset_s", [0.0, 0.3, -1.5])
def test_samples_are_around_the_frames(
    log: FrameLog, packets: list[Packet], offset_s: float
) -> None:
    every = ImuData.concatenate([packet.imu for packet in packets])
    rig = log.rig.shifted(offset_s)
    found = log.samples(FIRST, STOP, rig)
    first, last = found.stamps_ns[[0, -1]]
    begin, end = log.frames_ns[[FIRST, STOP - 1]] + round(rig.pose_offset_s * 1e9)
    assert first <= max(begin, every.stamps_ns[0])
    assert last >= min(end, every.stamps_ns[-1])
    inside = (every.stamps_ns >= first) & (every.stamps_ns <= last)
    assert np.array_equal(found.stamps_ns, every.stamps_ns[inside])
    assert np.array_equal(found.gyro, every.gyro[inside])


def test_steps_between_frames_are_those_of_each_interval(packets: list[Packet]) -> None:
    imu = ImuBuffer()
    imu.add(ImuData.concatenate([packet.imu for packet in packets]))
    samples_ns = imu.data.stamps_ns
    times_ns = np.concatenate(
        [
            [samples_ns[0] - 40_000_000],  # before the samples, and behind them
            np.arange(samples_ns[3], samples_ns[-1], 71_000_001),
            [samples_ns[-1] + 90_000_000],
        ]
    )
    steps, first = imu.steps_at(times_ns)
    for n in range(len(times_ns) - 1):
        own = imu.between(int(times_ns[n]), int(times_ns[n + 1])).short_steps()
        rows = slice(first[n], first[n + 1])
        assert np.allclose(steps.durations_s[rows], own.durations_s, rtol=0.0, atol=1e-12)
        assert np.allclose(steps.gyro[rows], own.gyro, rtol=0.0, atol=1e-9)
        assert np.allclose(steps.accel[rows], own.accel, rtol=0.0, atol=1e-8)


class Failing:
    """A recording that cannot be read to its end at first."""

    def __init__(self, packets: list[Packet]) -> None:
        self.diagnostics = Diagnostics()
        self._packets, self.reads = packets, 0

    def packets(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Packet]:
        self.reads += 1
        for number, packet in enumerate(self._packets):
            if self.reads == 1 and number == 5:
                raise DataError("cut")
            if number == 2:
                self.diagnostics.counts["fault"] += 1
            yield packet


def test_a_recording_read_once_is_whole_and_counts_its_faults_for_each_run(
    packets: list[Packet],
) -> None:
    recording = Failing(packets)
    once = read_once(recording)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="cut"):
        list(once.packets())
    for _ in range(3):
        assert list(once.packets()) == packets
        assert dict(once.diagnostics.counts) == {"fault": 1}
        once.diagnostics.counts["of the run"] += 1
    assert recording.reads == 2
    assert len(list(once.packets(packets[3].frame.stamp_ns))) == len(packets)
    assert recording.reads == 3


@pytest.fixture(scope="module")
def minimum(log: FrameLog, flight: SimulatedSequence) -> tuple[RecordingCost, Estimates]:
    """The last cost of an adjustment without a robust loss, and where it is least."""
    minima: list[tuple[RecordingCost, Estimates]] = []

    def noted(cost: RecordingCost, *given: object) -> object:
        end, *others = minimized(cost, *given)  # type: ignore[arg-type]
        minima.append((cost, end))
        return end, *others

    truth = flight.groundtruth()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording_problem, "minimized", noted)
        given = log, truth, flight.rig, BackendConfig(), CONFIG
        adjusted = adjust_recording(*given, lambda *_: None)
    assert adjusted is not None
    return minima[-1]


def test_a_step_lowers_the_cost_by_what_it_predicts(
    minimum: tuple[RecordingCost, Estimates],
) -> None:
    cost, end = minimum
    moved = np.random.default_rng(0).normal(0.0, 0.01, end.points.shape)
    away = replace(end, points=end.points + moved)
    linear = cost.linearized(away)
    step = linear.factor(0.0).step(linear)
    before, after = cost.value(away), cost.value(away.moved(step))
    assert step.predicted > 0.1 * before
    assert np.isclose(before - after, step.predicted, rtol=0.05)
    factor = linear.factor(0.0)
    again = factor.renewed(linear, 0.0).step(linear)
    assert np.allclose(again.states, step.states, rtol=0.0, atol=1e-9)
    assert np.allclose(again.points, step.points, rtol=0.0, atol=1e-9)
    nearer = away.moved(step)
    elsewhere, there = cost.linearized(nearer), cost.value(nearer)
    anew = factor.renewed(elsewhere, 0.0).step(elsewhere)
    gains = [there - cost.value(nearer.moved(s)) for s in (anew, factor.step(elsewhere))]
    assert gains[0] > 0.0
    assert gains[0] > gains[1]
    at_end = cost.linearized(end)
    assert at_end.factor(0.0).step(at_end).predicted < CONFIG.tolerance * cost.value(end)


def test_reduced_equations_follow_the_states(minimum: tuple[RecordingCost, Estimates]) -> None:
    """With features where they are best, as the cost linearised again says."""
    cost, end = minimum
    images = _LinearImages(Minimum(cost, end))
    chain = ChainEquations.of(cost.inertial.linearize(end.states), cost.keyframes)
    push = np.random.default_rng(1).normal(0.0, 10.0, chain.gradient.shape)
    before = images.gradient.copy()
    moved = images.step(images.factor(chain), replace(chain, gradient=push))
    there = images.moved(end, moved_states(end.states, moved))
    again = _LinearImages(Minimum(cost, there)).gradient
    change = np.linalg.norm(images.gradient - before)
    assert np.linalg.norm(images.gradient - again) < 0.02 * change  # the cost is curved
    images.reset()
    assert np.array_equal(images.gradient, before)


def test_a_keyframe_that_is_off_is_moved_before_outliers_are_judged(
    log: FrameLog, flight: SimulatedSequence
) -> None:
    task = SmoothingTask.of(flight.rig, BackendConfig(), FinalBaConfig())
    segment = read_segment(log, log.keyframes, task.rig, task.backend.zero_velocity)
    truth = states_at(
        flight.groundtruth(), segment.keyframe_stamps_ns, segment.imu, task.preintegration
    )
    moved = gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.0]))
    off = list(truth)
    off[5] = replace(off[5], world_T_body=off[5].world_T_body * moved)
    loose = LooseAdjustment(truth, ImuNoiseFactors())
    found = [
        BundleAdjustment(SegmentStart(segment, states, 0, loose), task, lambda *_: None).solve()
        for states in (truth, off)
    ]
    assert found[0].figures.iterations < found[1].figures.iterations
    assert found[0].figures.observations == found[1].figures.observations
    for own, other in zip(*(part.states for part in found), strict=True):
        away = own.world_T_body.between(other.world_T_body)
        assert np.linalg.norm(gtsam.Pose3.Logmap(away)) < 5e-3  # it was 0.1 m off
