# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run as a function: deterministic, watched, and never losing what it has done."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from slam_graph.config import RunConfig, load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.errors import DataError, EstimationError
from slam_graph.geometry.trajectory import NavState, Trajectory, interpolate
from slam_graph.pipeline.divergence import DivergenceError, check_sane
from slam_graph.pipeline.estimation import true_state
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.measurements import Packet

STATIC = "backend.initialization.mode=static"
SHORT = load_config(overrides=["duration_s=3", "min_coverage=0.1", STATIC])
FRAMES_BEFORE_FAULT = 55


class Faulty:
    """A real recording that breaks after some frames."""

    def __init__(self, fault: BaseException) -> None:
        self._sequence, self._fault = open_dataset("demo"), fault

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def packets(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Packet]:
        for index, packet in enumerate(self._sequence.packets(start_ns, end_ns)):
            if index == FRAMES_BEFORE_FAULT:
                raise self._fault
            yield packet


class Watcher:
    """Counts what it is told."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.stamps: list[int] = []
        self.adjusted: list[float] = []

    def open(self, *_: object) -> None:
        self.calls.append("open")

    def show(self, *_: object) -> None:
        self.calls.append("show")

    def finish(self, *_: object) -> None:
        self.calls.append("finish")

    def close(self) -> None:
        self.calls.append("close")

    def write(self, imu: object, frame: Any) -> None:
        self.calls.append("write")

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        self.stamps.append(stamp_ns)

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        self.adjusted.append(done / keyframes)


def test_the_same_seed_gives_the_same_trajectory_and_all_are_told() -> None:
    watcher = Watcher()
    first = run(open_dataset("demo"), SHORT, watcher, watcher, watcher)
    second = run(open_dataset("demo"), SHORT)
    np.testing.assert_array_equal(first.trajectory.positions, second.trajectory.positions)
    assert first.status == "ok"
    first.check()
    assert watcher.calls == ["open", *["write", "show"] * first.logs.frames, "finish", "close"]
    assert watcher.stamps == sorted(watcher.stamps)
    assert len(watcher.stamps) == first.logs.frames
    assert watcher.adjusted == sorted(watcher.adjusted), "the final bundle adjustment went back"
    assert len(set(watcher.adjusted)) > 2, "it moves"
    assert watcher.adjusted[-1] < 1.0
    stages = first.metrics["timing"]["stages"]
    assert {"read", "frontend", "backend", "total"} <= stages.keys()
    assert stages["total"]["mean_ms"] >= stages["backend"]["mean_ms"]


@pytest.mark.parametrize(
    ("fault", "status"),
    [
        (DataError("cam0/1.png: broken"), "failed"),
        (KeyboardInterrupt(), "interrupted"),
        (ZeroDivisionError("a slip"), "failed"),
    ],
)
def test_a_fault_during_the_run_loses_nothing_and_is_raised_by_check(
    fault: BaseException, status: str, tmp_path: Path
) -> None:
    watcher = Watcher()
    result = run(Faulty(fault), load_config(overrides=[STATIC]), viewer=watcher)
    assert (result.status, result.logs.frames) == (status, FRAMES_BEFORE_FAULT)
    assert len(result.history) > 0
    assert watcher.calls[-1] == "close"
    assert result.save(tmp_path)
    with pytest.raises(type(fault)) as caught:
        result.check()
    assert caught.value is fault


def test_a_part_of_a_recording_is_run() -> None:
    result = run(
        open_dataset("demo"), load_config(start_s=1.0, duration_s=0.5, overrides=["min_coverage=0"])
    )
    info = open_dataset("demo").info()
    assert result.logs.frames == 11
    assert result.logs.last_frame_ns is not None
    assert result.logs.last_frame_ns <= info.start_ns + 1_500_000_000
    assert result.status == "not_initialized"
    with pytest.raises(EstimationError, match="never initialised"):
        result.check()


@pytest.mark.data
def test_a_run_may_start_from_the_truth(data_dir: Path) -> None:
    sequence = open_dataset(data_dir / "openvins_sim" / "euroc_V1_01", cameras=2)
    config = load_config(
        overrides=["backend.initialization.mode=groundtruth"], duration_s=2.0, cameras="mono"
    )
    result = run(sequence, config)
    result.check()
    assert len(result.rig.cameras) == 1
    assert result.start_was_given
    assert result.metrics["accuracy"]["none"]["ate"]["translation_m"]["rmse"] < 0.042


def state(**changes: Any) -> NavState:
    fields = {
        "stamp_ns": 1,
        "world_T_body": gtsam.Pose3(),
        "velocity": np.zeros(3),
        "gyro_bias": np.zeros(3),
        "accel_bias": np.zeros(3),
        "covariance": np.eye(15),
    }
    return NavState(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"velocity": np.array([np.nan, 0, 0])}, "not finite"),
        ({"covariance": np.diag(np.full(15, np.inf))}, "not finite"),
        ({"velocity": np.array([0, 101.0, 0])}, "speed of 101 m/s"),
        ({"covariance": np.eye(15) * 1e6}, "position sigma of 1e\\+03 m"),
        ({"covariance": np.eye(15) * 9.0}, "orientation sigma of 3 rad"),
        ({"gyro_bias": np.array([0, 0, -3.0])}, "gyroscope bias of 3"),
        ({"accel_bias": np.array([0, 11.0, 0])}, "accelerometer bias of 11"),
    ],
)
def test_states_that_cannot_be_true_are_refused(changes: dict[str, Any], message: str) -> None:
    check_sane(state(), RunConfig())
    with pytest.raises(DivergenceError, match=message):
        check_sane(state(**changes), RunConfig())


def test_the_velocity_of_a_truth_without_one_comes_from_its_positions() -> None:
    stamps = np.arange(0, 10**9, 5_000_000, dtype=np.int64)
    positions = np.outer(stamps * 1e-9, (1.0, -2.0, 0.5))
    truth = Trajectory(stamps, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(stamps), 1)))
    for stamp_ns in (0, 503_000_000, int(stamps[-1])):
        start = true_state(truth, stamp_ns)
        assert start is not None
        assert start.covariance is not None
        np.testing.assert_allclose(start.velocity, (1.0, -2.0, 0.5), atol=1e-9)
        expected = interpolate(truth, np.array([stamp_ns]))[0].positions[0]
        np.testing.assert_allclose(start.world_T_body.translation(), expected)
    assert true_state(truth, 2 * 10**9) is None
