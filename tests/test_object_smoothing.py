# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects by all of their observations: the log of their tracks, the adjustment, files."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED

from slam_graph.arrays import IntArray
from slam_graph.backend.objects.ego_motion import motion_samples
from slam_graph.backend.smoothing.final_adjustment import FinalBa
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.keyframe_states import with_angular_rates
from slam_graph.backend.smoothing.object_log import ObjectLog
from slam_graph.geometry import NavState
from slam_graph.pipeline import run
from slam_graph.results import RunResult
from slam_graph.results.result_files import read_tum
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuBuffer
from slam_graph.simulation.simulator import euroc_rig, simulate

PERIOD_NS = 100_000_000
_ZERO = np.zeros(3)
AT_REST = NavState(0, gtsam.Pose3(), _ZERO, accel_bias=_ZERO, gyro_bias=_ZERO)


def seen(k: int, ids: list[int]) -> FeatureFrame:
    """The frame k, in which both cameras see some features."""
    pixels = np.full((len(ids), 2), 100.0)
    observations = FeatureObservations(np.array(ids, np.int64), pixels, pixels / 400.0)
    return FeatureFrame((k + 1) * PERIOD_NS, (observations, observations))


def logged(folder: Path, frames: int, members: Mapping[int, Mapping[int, int]]) -> ObjectLog:
    """A log of frames that see the features 1 to 4, of which some are members of objects."""
    with ObjectLog.recording(euroc_rig(), 0.3, folder) as log:
        for k in range(frames):
            log.add(seen(k, [1, 2, 3, 4]), members.get(k, {}))
    return log


def test_a_track_is_of_the_object_that_it_was_of_in_most_frames(tmp_path: Path) -> None:
    both, first = {1: 7, 2: 8}, {1: 7}
    log = logged(tmp_path, 6, {1: both, 2: {1: 8, 2: 8}, 3: both, 4: first, 5: first})
    assert {n: ids.tolist() for n, ids in log.tracks().items()} == {7: [1], 8: [2]}


def test_a_track_that_left_its_object_early_is_of_none(tmp_path: Path) -> None:
    log = logged(tmp_path, 8, {k: {1: 7, 3: 7} if k < 3 else {1: 7} for k in range(8)})
    assert log.tracks()[7].tolist() == [1]


def test_a_log_has_the_frames_from_before_a_track_was_known(tmp_path: Path) -> None:
    """It waits for three periods, and is written when a later frame comes."""
    log = logged(tmp_path, 10, {k: {2: 1} for k in range(6, 10)})
    frames = list(log.frames(np.array([2])))
    assert [frame.stamp_ns // PERIOD_NS for frame in frames] == list(range(3, 11))
    assert all(frame.cameras[1].ids.tolist() == [2] for frame in frames)


def test_motion_that_is_known_leaves_no_rate_to_estimate() -> None:
    """What differs from it is the rate of the object, in the place of the gyroscope's bias."""
    rate, other = np.array([0.3, -0.2, 0.5]), np.array([0.0, 0.4, 0.0])

    def state(k: int, turn: np.ndarray) -> NavState:
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(turn * 0.1 * k), np.zeros(3))
        return replace(AT_REST, stamp_ns=(k + 1) * PERIOD_NS, world_T_body=pose)

    imu = ImuBuffer()
    imu.add(motion_samples(state(0, rate), state(1, rate)))
    (same, _), (different, _) = (
        with_angular_rates([state(0, turn), state(1, turn)], imu) for turn in (rate, rate + other)
    )
    np.testing.assert_allclose(same.gyro_bias, 0.0, atol=1e-9)
    np.testing.assert_allclose(different.gyro_bias, -other, atol=0.02)


def test_the_platform_is_adjusted_without_the_tracks_that_move(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read: list[tuple[IntArray, IntArray]] = []

    def noted(log: FrameLog, *_: object) -> None:
        rows = log.features(0, len(log.frames_ns))[1]
        read.append((log.left_out, np.unique(rows["id"])))

    monkeypatch.setattr(FinalBa, "of_worlds", noted)
    flight = simulate(duration_s=3.0, rate_hz=10.0, seed=3, objects={"count": 1, "masks": True})
    run(flight, overrides={"objects.enabled": True, "min_coverage": 0.1})
    ((moved, left),) = read
    assert len(moved) > 5
    assert len(left) > 50
    assert not np.isin(left, moved).any()


def flight_of_two(seed: int) -> RunResult:
    sequence = simulate(
        duration_s=6.0, rate_hz=10.0, seed=seed, tracks={"pixel_sigma": 0.5}, objects={"count": 2}
    )
    changes = ["objects.enabled=true", "backend.noise.pixel_sigma=0.5", BELIEVED]
    return run(sequence, overrides=changes)


@pytest.fixture(scope="module")
def two() -> RunResult:
    return flight_of_two(3)


@pytest.mark.slow
def test_smoothed_objects_are_better_than_those_on_the_way(two: RunResult) -> None:
    table = two.metrics["moving_objects"]
    smoothed, causal = table["smoothed"], table["accuracy"]
    assert smoothed["steps"] > 0.9 * causal["steps"]
    assert smoothed["motion_rotation_deg"] < 0.3 < causal["motion_rotation_deg"] * 1.5
    assert smoothed["motion_translation_m"] < 0.0075
    # how much better scatters: 0.15 to 0.55 over six flights
    other = flight_of_two(1).metrics["moving_objects"]
    errors_m = [
        np.hypot(this["pose_translation_m"], other[name]["pose_translation_m"])
        for this, name in ((smoothed, "smoothed"), (causal, "accuracy"))
    ]
    assert errors_m[0] < 0.5 * errors_m[1]
    assert smoothed["pose_translation_m"] < 0.65 * causal["pose_translation_m"]
    assert smoothed["pose_translation_m"] < 0.015
    assert causal["pose_translation_m"] < 0.03


@pytest.mark.slow
def test_files_of_smoothed_objects(two: RunResult, tmp_path: Path) -> None:
    two.save(tmp_path / "out")
    assert two.objects is not None
    assert two.objects.smoothed is not None
    for number in two.objects.smoothed.numbers:
        path = two.objects.smoothed.trajectory(number)
        read = read_tum(tmp_path / "out" / "objects" / f"{number}_smoothed.tum")
        np.testing.assert_allclose(read.positions, path.positions, atol=1e-6)
    lines = (tmp_path / "out" / "objects_smoothed.csv").read_text().splitlines()
    assert len(lines) == 1 + len(two.objects.smoothed.all_states())
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert 0.3 < metrics["moving_objects"]["smoothed"]["nees"] < 1.5
    states = two.objects.smoothed.all_states()
    steps = [state.step for state in states if state.step is not None]
    assert len(steps) > 0.9 * len(states)
    assert all(np.linalg.eigvalsh(step.covariance)[0] > 0.0 for step in steps)


@pytest.mark.slow
def test_what_is_beyond_the_ground_truth_does_not_count(two: RunResult) -> None:
    truth = two.input.truth
    assert two.objects is not None
    assert truth is not None
    known = truth.stamps_ns - round(two.input.rig.pose_offset_s * 1e9)
    whole, half = (
        two.objects.errors(two.input.object_truth, replace(part, stamps_ns=known[: len(part)]))
        for part in (truth, truth[: len(truth) // 2])
    )
    assert 0 < len(half.truth) < 0.7 * len(whole.truth)


@pytest.mark.slow
def test_smoothed_velocities_have_the_errors_that_they_say(two: RunResult) -> None:
    """Of the point of the body at which its origin is, against how it truly moved."""
    truth = two.input.truth
    assert truth is not None
    assert two.objects is not None
    assert two.objects.smoothed is not None
    bodies = dict(zip(truth.stamps_ns.tolist(), truth, strict=True))
    squares: list[float] = []
    for number in two.objects.smoothed.numbers:
        states = two.objects.smoothed.states(number)
        for before, state, after in zip(states, states[1:], states[2:], strict=False):
            place = bodies[state.stamp_ns].compose(state.world_T_body.inverse())
            origin = place.compose(state.world_T_object).translation()
            own, path = min(
                (
                    (path.at(state.stamp_ns).transformTo(origin), path)
                    for path in two.input.object_truth.values()
                ),
                key=lambda item: float(np.linalg.norm(item[0])),
            )
            ends = [path.at(s.stamp_ns).transformFrom(own) for s in (before, after)]
            seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
            error = state.velocity - place.rotation().unrotate((ends[1] - ends[0]) / seconds)
            squares.append(float(error @ np.linalg.solve(state.velocity_covariance, error)) / 3.0)
    assert len(squares) > 80
    assert 0.3 < np.mean(squares) < 2.0
