# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Frames on another clock than the IMU, and rolling shutters: nothing is lost between the clocks.

States, fixes, known poses, odometry and truth are on the clock of the IMU.
"""

import csv
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

import slam_graph as sg
from slam_graph.arrays import BoolArray, IntArray
from slam_graph.backend import Estimator, Innovations
from slam_graph.backend.engine_protocol import StepReport
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import kalibr_text
from slam_graph.datasets.data_checks import check_sequence
from slam_graph.datasets.packets import packetize
from slam_graph.datasets.sequence import SequenceInfo
from slam_graph.diagnostics import Diagnostics
from slam_graph.results import RunResult
from slam_graph.results.frame_table import FrameTable
from slam_graph.results.object_files import objects_table
from slam_graph.results.run_input import RunInput
from slam_graph.results.run_logs import RunLogs
from slam_graph.sensors import AidingData, FeatureFrame, FeatureObservations, ImuData, Packet, Rig
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulator import euroc_rig

if TYPE_CHECKING:
    from slam_graph.backend import MovingObjects

CAUSAL = ["final_ba.enabled=false", "limits.refuse_wrong_setup=false"]
OFFSETS_S = (0.03, 3.0, -2.0)
ODOMETRY: dict[str, Any] = {"odometry": {"enabled": True}}


def late(rig: Rig, offset_s: float) -> Rig:
    """A rig whose cameras have a clock of their own."""
    cameras = tuple(replace(mounted, time_offset_s=offset_s) for mounted in rig.cameras)
    return replace(rig, cameras=cameras)


def flight(folder: Path, offset_s: float, **settings: Any) -> SimulatedSequence:
    """A drive of 1.5 s, whose exposures and samples are the same whatever the offset is."""
    chain = folder / f"chain_{offset_s}.yaml"
    chain.write_text(kalibr_text(late(euroc_rig(), offset_s)))
    chosen = {"cameras": 1, "duration_s": 1.5, "rate_hz": 10.0, "seed": 3} | ODOMETRY | settings
    tracks = {"features": 20}
    return sg.simulate(trajectory="car", calibration=str(chain), tracks=tracks, **chosen)


def frames_of(result: RunResult) -> list[dict[str, str]]:
    """The rows of `frames.csv`."""
    lines = result.logs.by_frame.csv_lines(result.keyframes_ns, result.nees_series)
    return list(csv.DictReader(lines))


def uncovered(packets: Iterable[Packet], offset_s: float) -> int:
    """Number of intervals between states that the odometry received by then does not cover."""
    received, times_ns, missing = list[AidingData](), list[int](), 0
    for packet in packets:
        assert packet.aiding is not None
        received.append(packet.aiding)
        times_ns.append(packet.frame.stamp_ns + round(1e9 * offset_s))
        if len(times_ns) > 1:
            moved = AidingData.concatenate(received).odometry_between(*times_ns[-2:])
            missing += moved is None
    return missing


# --- the whole run -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def on_one_clock(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return sg.run(flight(tmp_path_factory.mktemp("one"), 0.0), algorithm="okvis", overrides=CAUSAL)


@pytest.mark.parametrize("offset_s", OFFSETS_S)
def test_the_clock_of_the_cameras_changes_stamps_of_frames_and_nothing_else(
    on_one_clock: RunResult, tmp_path: Path, offset_s: float
) -> None:
    """The start, every state with odometry, accuracy, and what is said of frames."""
    same = on_one_clock
    found = sg.run(flight(tmp_path, offset_s), algorithm="okvis", overrides=CAUSAL)
    assert found.status == same.status == "ok"
    np.testing.assert_array_equal(found.trajectory.stamps_ns, same.trajectory.stamps_ns)
    np.testing.assert_array_equal(found.trajectory.positions, same.trajectory.positions)
    assert found.warnings == same.warnings
    for key in ("accuracy", "nees", "world"):
        assert found.metrics[key] == same.metrics[key]
    for key in ("initialization_s", "coverage", "start_was_given", "estimated_frames"):
        assert found.metrics["extent"][key] == same.metrics["extent"][key]

    rows = frames_of(found)
    assert all(row["nees_position"] for row in rows)
    assert any(row["keyframe"] == "1" for row in rows)
    lead_ns = {int(row["state_ns"]) - int(row["stamp_ns"]) for row in rows}
    assert lead_ns == {round(offset_s * 1e9)}
    for row in rows:
        row["stamp_ns"] = row.pop("state_ns")
    assert rows == frames_of(same)


def test_a_saved_run_says_the_same_of_keyframes_and_consistency(tmp_path: Path) -> None:
    result = sg.run(flight(tmp_path, -0.4), algorithm="okvis", overrides=CAUSAL)
    result.save(tmp_path / "out")
    saved = sg.load_result(tmp_path / "out")
    np.testing.assert_array_equal(saved.keyframes_ns, result.keyframes_ns)
    assert saved._view().start_ns == result._view().start_ns == result.input.states_ns[0]
    assert saved.nees_series is not None
    assert result.nees_series is not None
    np.testing.assert_array_equal(saved.nees_series[0], result.trajectory.stamps_ns)
    np.testing.assert_allclose(saved.nees_series[1], result.nees_series[1], rtol=1e-5)


@pytest.mark.parametrize("offset_s", OFFSETS_S)
def test_a_part_of_a_recording_starts_from_the_truth_at_its_first_frame(
    tmp_path: Path, offset_s: float
) -> None:
    """The first packet has the samples of 1 s before, on the clock of the IMU."""
    sequence = flight(tmp_path, offset_s)
    start = ["backend.initialization.mode=groundtruth", "start_s=1.2", "duration_s=0.2"]
    result = sg.run(sequence, overrides=[*CAUSAL, *start])
    assert result.metrics["extent"]["initialization_s"] == 0.0
    assert result.metrics["extent"]["coverage"] == 1.0
    first_ns = int(result.trajectory.stamps_ns[0])
    packet = next(iter(sequence.packets(result.input.start_ns)))
    assert abs(int(packet.imu.stamps_ns[0]) - (first_ns - 10**9)) <= 5_000_000


def test_a_loss_takes_back_the_same_states_on_any_clock(tmp_path: Path) -> None:
    """Nothing is recorded for 1.5 s."""
    found = []
    for offset_s in (0.0, *OFFSETS_S[1:]):
        sequence = blind(flight(tmp_path, offset_s, duration_s=3.2), 1.2, 2.7)
        result = sg.run(sequence, overrides=CAUSAL)
        ends = [(segment.begin_ns, segment.end_ns) for segment in result.segments]
        lengths = len(result.history), len(result.logs.steps), len(result.logs.innovations)
        found.append((ends, result.segments.losses, lengths))
    ends, losses, lengths = found[0]
    assert len(ends) == len(losses) == 1
    assert 0 < lengths[0] < 12
    assert found[1:] == found[:1] * 2


def blind(sequence: SimulatedSequence, begin_s: float, end_s: float) -> SimulatedSequence:
    """A flight of which nothing is recorded from one time to another."""
    exposures_ns, blocks = sequence.flight.exposures_ns, sequence.imu_blocks
    begin_ns, end_ns = (int(exposures_ns[0] + 1e9 * s) for s in (begin_s, end_s))

    def outside(times_ns: IntArray) -> BoolArray:
        return (times_ns < begin_ns) | (times_ns > end_ns)

    def kept(after_ns: int | None = None) -> Iterator[ImuData]:
        for block in blocks(after_ns):
            rows = outside(block.stamps_ns)
            yield ImuData(block.stamps_ns[rows], block.gyro[rows], block.accel[rows])

    sequence.flight = replace(sequence.flight, exposures_ns=exposures_ns[outside(exposures_ns)])
    sequence.imu_blocks = kept  # type: ignore[method-assign]
    return sequence


@pytest.mark.parametrize("offset_s", [0.0, *OFFSETS_S])
def test_a_check_compares_truth_and_frames_on_one_clock(tmp_path: Path, offset_s: float) -> None:
    found = check_sequence(flight(tmp_path, offset_s))
    assert "covers 100.0 % of the frames" in [f.what for f in found if f.where == "ground truth"]
    assert all(finding.severity == "info" for finding in found)


@pytest.mark.parametrize("offset_s", [0.0, *OFFSETS_S])
def test_a_fix_comes_with_the_first_frame_whose_state_is_not_earlier(
    tmp_path: Path, offset_s: float
) -> None:
    sequence = flight(tmp_path, offset_s, gnss={"sigma_m": 0.5, "rate_hz": 35.0})
    packets, before_ns = list(sequence.packets()), -(10**12)
    for packet in packets:
        time_ns = packet.frame.stamp_ns + round(offset_s * 1e9)
        due = sequence.aiding.within(before_ns, time_ns).fix_stamps_ns
        assert packet.aiding is not None
        np.testing.assert_array_equal(packet.aiding.fix_stamps_ns, due)
        before_ns = time_ns
    assert before_ns >= sequence.aiding.fix_stamps_ns[-1]


# --- odometry ------------------------------------------------------------------------------------


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
@pytest.mark.parametrize("offset_s", [0.0, 0.015, 0.05, -0.02])
def test_odometry_reaches_the_state_of_every_frame(
    tmp_path: Path, offset_s: float, readout_s: float
) -> None:
    """And the last sample of the IMU, up to which an online estimate of the offset may move it."""
    odometry = {"enabled": True, "rate_hz": 100.0}
    settings = {"shutter_readout_s": readout_s or None, "odometry": odometry}
    sequence = flight(tmp_path, offset_s, duration_s=1.0, **settings)
    packets = list(sequence.packets())
    assert uncovered(packets, sequence.rig.pose_offset_s) == 0
    last_ns = sequence.aiding.odometry_stamps_ns[-1]
    received = AidingData.empty()
    for packet in packets:
        assert packet.aiding is not None
        received = AidingData.concatenate([received, packet.aiding])
        reached_ns = received.odometry_stamps_ns[-1]
        assert reached_ns >= min(packet.imu.stamps_ns[-1], last_ns)
    np.testing.assert_array_equal(received.odometry_stamps_ns, sequence.aiding.odometry_stamps_ns)


@pytest.mark.parametrize("error_s", [-0.008, 0.008])
def test_nothing_is_lost_where_the_offset_is_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error_s: float
) -> None:
    """Odometry goes from every state to the next, and each state is that of a frame."""
    sequence = flight(tmp_path, 0.01)
    sequence.rig = late(sequence.rig, 0.01 - error_s)
    last_ns, between = int(sequence.aiding.odometry_stamps_ns[-1]), AidingData.odometry_between
    covered = list[bool]()

    def noted(data: AidingData, from_ns: int, to_ns: int) -> Any:
        moved = between(data, from_ns, to_ns)
        covered.append(moved is not None or to_ns > last_ns)
        return moved

    monkeypatch.setattr(AidingData, "odometry_between", noted)
    result = sg.run(sequence, overrides=[*CAUSAL, "backend.calibration.time_offset=true"])
    assert len(covered) > 10
    assert all(covered)
    times_ns, by_frame = result.trajectory.stamps_ns, result.logs.by_frame
    assert np.isin(times_ns, by_frame.times_ns).all()
    assert len(np.unique(by_frame.times_ns - by_frame.stamps_ns)) > 1, "it was estimated"
    assert result.nees_series is not None
    compared = len(result.nees_series[0])
    assert len(times_ns) - 1 <= compared  # the last state may be later than the truth
    assert sum(bool(row["nees_position"]) for row in frames_of(result)) == compared


@pytest.mark.parametrize("shift_s", [0.0, -100.0, 100.0])
def test_odometry_that_no_interval_uses_is_told_once(tmp_path: Path, shift_s: float) -> None:
    sequence = flight(tmp_path, 0.0, duration_s=1.0)
    data = sequence.aiding
    shifted_ns = data.odometry_stamps_ns + round(shift_s * 1e9)
    sequence.aiding = replace(data, odometry_stamps_ns=shifted_ns)
    result = sg.run(sequence, overrides=CAUSAL)
    assert result.warnings["odometry_unused"] == (shift_s != 0.0)


def test_errors_of_objects_are_those_at_the_time_that_the_run_found() -> None:
    """Frames are stamped by the cameras, the truth is on the clock of the IMU."""
    given = euroc_rig()
    stamps_ns = np.arange(10) * 10**8
    truth = sg.Trajectory(stamps_ns, np.zeros((10, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (10, 1)))
    info = SequenceInfo("clip", "euroc", "images", 1, 0, 0, 0, 0, False)
    asked = RunInput(info, load_config(), given, 0, 10**9, truth, object_truth={1: truth})
    found: list[IntArray] = []

    def errors(_: object, true_body: sg.Trajectory) -> SimpleNamespace:
        found.append(true_body.stamps_ns)
        return SimpleNamespace(table=dict)

    smoothed = SimpleNamespace(errors=errors)
    objects = SimpleNamespace(
        single_camera=False, smoothed=smoothed, numbers=[], errors=errors, milliseconds=0, frames=1
    )
    objects_table(cast("MovingObjects", objects), asked, given.shifted(0.06))
    assert len(found) == 2
    for times_ns in found:
        np.testing.assert_array_equal(times_ns, stamps_ns - 60_000_000)


# --- parts ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset_ns", [-200, -30, 0, 30])
def test_frames_without_samples_are_those_at_their_time_on_the_clock_of_the_imu(
    offset_ns: int,
) -> None:
    """Samples every 10 ns, none from 300 to 400; frames every 20 ns of that clock."""
    times_ns = np.arange(100, 500, 10)
    times_ns = times_ns[(times_ns <= 300) | (times_ns >= 400)]
    none = np.zeros((len(times_ns), 3))
    stamps_ns = np.arange(105, 490, 20) - offset_ns
    frames = (FeatureFrame(int(stamp_ns), ()) for stamp_ns in stamps_ns)
    told, diagnostics = list[str](), Diagnostics()
    diagnostics.warn = lambda kind, message: told.append(message)  # type: ignore[method-assign]
    blocks = iter([ImuData(times_ns, none, none)])
    packets = list(packetize((f for f in frames), blocks, diagnostics, None, offset_ns))
    alone = [t for s, t in pairwise((0, *stamps_ns + offset_ns)) if not any_in(times_ns, s, t)]
    assert told == [f"frame at {t - offset_ns} has no IMU samples" for t in alone]
    assert len(alone) == 4
    handed = np.concatenate([packet.imu.stamps_ns for packet in packets])
    np.testing.assert_array_equal(handed, times_ns[: len(handed)])


def any_in(times_ns: IntArray, after_ns: int, until_ns: int) -> bool:
    return bool(np.any((times_ns > after_ns) & (times_ns <= until_ns)))


@pytest.mark.parametrize("lead_ns", [-50, 0, 50])
def test_what_is_taken_back_of_states_is_found_by_their_times(lead_ns: int) -> None:
    """Of frames, steps and innovations; those before the time stay."""
    logs, seen = RunLogs(), FeatureObservations.empty()
    innovations = Innovations(tested=1, passed_distance=2.0, passed_dof=2, expected=2.0)
    report = StepReport(costs=(3.0, 2.0))
    report.innovations = innovations
    estimator = cast(Estimator, SimpleNamespace(window=None, report=report))
    for stamp_ns in (100, 110, 120, 130):
        logs.steps.append(stamp_ns, report.costs, 6)
        logs.innovations.append(stamp_ns, innovations)
        logs.by_frame.append(FeatureFrame(stamp_ns, (seen,)), 0, estimator, {})
        logs.by_frame.note_times({stamp_ns: stamp_ns + lead_ns})
    logs.forget_states(115 + lead_ns)
    assert logs.steps.stamps_ns.tolist() == logs.innovations.stamps_ns.tolist() == [100, 110]
    rows = list(csv.DictReader(logs.by_frame.csv_lines(np.zeros(0, np.int64), None)))
    assert [row["cost_before"] for row in rows] == ["3", "3", "", ""]


def test_a_frame_that_waits_has_its_keyframe_and_state_in_its_own_row() -> None:
    """Frame 1 is solved only as frame 2 comes, and is a keyframe."""
    table, seen = FrameTable(), FeatureObservations.empty()
    report, window = StepReport(), SimpleNamespace(past=[], state_features=[], keyframes=[])
    for stamp_ns, solved_ns in ((0, 0), (10, 0), (20, 10)):
        window.frame = solved_ns // 10
        window.keyframes = [1] if solved_ns else []
        given = SimpleNamespace(window=window, report=report, solved_ns=solved_ns)
        table.append(FeatureFrame(stamp_ns, (seen,)), 0, cast(Estimator, given), {})
        table.note_times({solved_ns: solved_ns + 15})
    assert table.keyframes_ns.tolist() == [25]
    assert table.times_ns.tolist() == [15, 25, 35]
