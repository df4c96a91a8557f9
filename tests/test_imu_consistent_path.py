# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The path of a recorded flight agrees with its IMU, and is near its ground truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult
from scipy.spatial.transform import Rotation

from slam_graph.datasets import read_groundtruth
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory
from slam_graph.sensors import ImuData
from slam_graph.simulation import imu_consistent_path, simulate
from slam_graph.simulation.imu_consistent_path import at_imu_times, consistent_path, truth_delay_s
from slam_graph.simulation.path_report import PathReport
from slam_graph.simulation.recorded_flight import delay_s, widened
from slam_graph.simulation.simulated_sequence import Flight

JUMP_AT_S, DRIFT_S, JUMP_M = 12.0, 1.5, 0.08
OFFSET_RAD = np.deg2rad(1.0)
LATE_S = 0.02


def flown() -> tuple[Flight, Trajectory, ImuData]:
    """A flight of 25 s, its exact path at 200 Hz, and its noisy IMU."""
    sequence = simulate(trajectory="figure8", duration_s=25.0, seed=3)
    flight = sequence.flight
    stamps = np.arange(flight.motion.start_ns, flight.motion.end_ns, 5_000_000, dtype=np.int64)
    path = Trajectory(
        stamps, flight.motion.positions(stamps), flight.motion.rotations(stamps).as_quat()
    )
    return flight, path, ImuData.concatenate(list(sequence.imu_blocks()))


def as_tracked(path: Trajectory) -> Trajectory:
    """The path as a tracker reports it: late positions, noise, a drift and jump, a turned body."""
    rng = np.random.default_rng(100)
    seconds = (path.stamps_ns - path.stamps_ns[0]) * 1e-9
    drift = np.clip((seconds - JUMP_AT_S + DRIFT_S) / DRIFT_S, 0.0, None)
    drift[seconds >= JUMP_AT_S] = 0.0
    positions = late(path, LATE_S).positions + rng.normal(size=path.positions.shape) * 1e-3
    positions[:, 0] += JUMP_M * drift
    turned = Rotation.from_quat(path.quaternions) * Rotation.from_rotvec([OFFSET_RAD, 0.0, 0.0])
    return Trajectory(path.stamps_ns, positions, turned.as_quat())


def late(path: Trajectory, by_s: float) -> Trajectory:
    """The path with positions of an earlier time."""
    then = path.stamps_ns - round(by_s * 1e9)
    positions = [np.interp(then, path.stamps_ns, column) for column in path.positions.T]
    return Trajectory(path.stamps_ns, np.stack(positions, axis=1), path.quaternions)


def part(path: Trajectory, from_s: float, to_s: float) -> Trajectory:
    """The poses of the path between two times, from its beginning on."""
    seconds = (path.stamps_ns - path.stamps_ns[0]) * 1e-9
    rows = (seconds >= from_s) & (seconds <= to_s)
    return Trajectory(path.stamps_ns[rows], path.positions[rows], path.quaternions[rows])


def distances(path: Trajectory, found: Trajectory) -> NDArray[np.float64]:
    """Of the positions at the times of `found`, m."""
    columns = [np.interp(found.stamps_ns, path.stamps_ns, column) for column in path.positions.T]
    return np.asarray(np.linalg.norm(np.stack(columns, axis=1) - found.positions, axis=1))


def imu_is_honest(report: PathReport) -> bool:
    """Whether recorded samples minus those of the path are white and of the calibrated size."""
    white = max(abs(report.gyro_correlation), abs(report.accel_correlation)) < 0.1
    return white and all(0.9 < ratio < 1.1 for ratio in (report.gyro_ratio, report.accel_ratio))


def test_drift_and_jump_of_the_truth_are_found_and_not_flown() -> None:
    flight, path, imu = flown()
    found, report = consistent_path(as_tracked(path), imu, flight.rig.imu)
    seconds = (found.stamps_ns - found.stamps_ns[0]) * 1e-9
    assert len(report.jumps_ns) == 1
    assert report.jumps_m[0] == pytest.approx(JUMP_M, abs=5e-3)
    assert np.rad2deg(np.linalg.norm(report.rotation_offset_rad)) == pytest.approx(1.0, abs=0.1)
    assert report.late_s == pytest.approx(LATE_S, abs=1e-3)
    assert imu_is_honest(report)
    error = distances(path, found)
    drifting = (seconds > JUMP_AT_S - DRIFT_S - 1.0) & (seconds < JUMP_AT_S + 1.0)
    assert np.max(error[~drifting]) < 5e-3
    assert np.max(error[drifting]) < 0.4 * JUMP_M
    assert found.velocities is not None
    exact = flight.motion.velocities(found.stamps_ns)
    assert np.sqrt(np.mean((found.velocities - exact) ** 2)) < 0.02


def test_gaps_of_the_truth_are_bridged_by_the_imu() -> None:
    flight, path, imu = flown()
    seconds = (path.stamps_ns - path.stamps_ns[0]) * 1e-9
    rows = (seconds < 8.0) | (seconds > 10.0)
    tracked = as_tracked(path)
    gappy = Trajectory(tracked.stamps_ns[rows], tracked.positions[rows], tracked.quaternions[rows])
    found, report = consistent_path(gappy, imu, flight.rig.imu)
    assert report.bridged_s == pytest.approx(2.0, abs=0.02)
    at = (found.stamps_ns - found.stamps_ns[0]) * 1e-9
    assert np.max(distances(path, found)[(at > 8.0) & (at < 10.0)]) < 0.02


@pytest.mark.parametrize("late_s", [0.0, 2e-3, -0.03])
def test_the_clock_of_the_truth_is_found_unless_it_is_little_off(late_s: float) -> None:
    flight, path, imu = flown()
    truth = late(path, late_s)
    expected = late_s if abs(late_s) > 5e-3 else 0.0
    assert truth_delay_s(truth, imu, flight.rig.imu) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("late_s", [0.12, -0.12])
def test_a_truth_far_off_the_clock_of_the_imu_is_refused(late_s: float) -> None:
    flight, path, imu = flown()
    truth = part(late(path, late_s), 8.0, 18.0)
    with pytest.raises(DataError, match=r"0\.1 s or more off the IMU's clock"):
        consistent_path(truth, imu, flight.rig.imu)


def test_less_than_ten_seconds_are_too_short_to_tell_how_late_a_truth_is() -> None:
    flight, path, imu = flown()
    truth = late(path, 0.03)
    assert truth_delay_s(part(truth, 8.0, 17.9), imu, flight.rig.imu) == 0.0
    assert truth_delay_s(part(truth, 7.8, 18.0), imu, flight.rig.imu) != 0.0


def test_positions_are_taken_earlier_and_orientations_are_not() -> None:
    flight, path, _ = flown()
    moved = at_imu_times(late(path, LATE_S), LATE_S)
    moved = part(moved, 1.0, 20.0)  # `late` repeats the first position
    exact = flight.motion.rotations(moved.stamps_ns)
    turned = (exact.inv() * Rotation.from_quat(moved.quaternions)).magnitude()
    assert np.max(turned) < 1e-6
    assert np.max(np.abs(moved.positions - flight.motion.positions(moved.stamps_ns))) < 1e-9


@pytest.mark.parametrize(
    ("late_s", "words"),
    [(0.024, "24 ms late, corrected"), (-0.024, "24 ms early, corrected"), (0.0, "in time")],
)
def test_a_report_says_whether_positions_were_late_or_early(late_s: float, words: str) -> None:
    none = np.zeros(0)
    report = PathReport(
        jumps_ns=none.astype(np.int64),
        jumps_m=none,
        bridged_s=0.0,
        late_s=late_s,
        position_rms_m=3e-3,
        position_p95_m=5e-3,
        position_max_m=9e-3,
        rotation_offset_rad=np.zeros(3),
        rotation_rms_rad=0.0,
        gyro_ratio=1.0,
        accel_ratio=1.0,
        gyro_correlation=0.0,
        accel_correlation=0.0,
    )
    assert report.lines()["positions of the truth"] == words


@pytest.mark.parametrize(
    ("part_s", "wider_s"),
    [((0, 8), (0, 30)), ((40, 48), (29, 59)), ((75, 80), (50, 80)), ((10, 50), (10, 50))],
)
def test_a_delay_is_that_of_thirty_seconds_about_a_part(
    part_s: tuple[int, int], wider_s: tuple[int, int]
) -> None:
    stamps = np.arange(0, 81) * 1_000_000_000
    truth = Trajectory(stamps, np.zeros((81, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (81, 1)))
    begin, end = (second * 1_000_000_000 for second in part_s)
    assert widened(begin, end, truth) == tuple(second * 1_000_000_000 for second in wider_s)
    short = part(truth, 0.0, 20.0)  # there is no more
    assert widened(5_000_000_000, 8_000_000_000, short) == (0, 20_000_000_000)


def test_a_gap_beside_a_part_leaves_the_delay_to_the_part() -> None:
    flight, path, imu = flown()
    truth = late(path, LATE_S)
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    there = (seconds < 3.0) | (seconds > 6.0)
    with_gap = Trajectory(truth.stamps_ns[there], truth.positions[there], truth.quaternions[there])
    assert delay_s(with_gap, imu, flight.rig.imu) is None
    assert delay_s(truth, imu, flight.rig.imu) == pytest.approx(LATE_S, abs=1e-3)


def test_a_search_that_does_not_converge_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    flight, path, imu = flown()
    ended = OptimizeResult(x=np.array([12.0]), success=False, message="ABNORMAL")
    monkeypatch.setattr(imu_consistent_path, "minimize", lambda *_, **__: ended)
    with pytest.raises(DataError, match=r"ended at 12\.0 ms without convergence \(ABNORMAL\)"):
        truth_delay_s(path, imu, flight.rig.imu)


def test_a_truth_that_no_motion_explains_is_an_error() -> None:
    flight, path, imu = flown()
    short = part(path, 8.0, 12.0)
    stretched = replace(short, positions=30.0 * short.positions)
    with pytest.raises(DataError, match="no path fits ground truth and IMU"):
        consistent_path(stretched, imu, flight.rig.imu)


def test_what_cannot_be_joined_is_an_error() -> None:
    flight, path, imu = flown()
    seconds = (path.stamps_ns - path.stamps_ns[0]) * 1e-9
    rows = (seconds < 8.0) | (seconds > 12.0)
    gappy = Trajectory(path.stamps_ns[rows], path.positions[rows], path.quaternions[rows])
    with pytest.raises(DataError, match=r"a gap of 4\.\d\d s"):
        consistent_path(gappy, imu, flight.rig.imu)
    later = replace(path, stamps_ns=path.stamps_ns + 3600 * 10**9)
    with pytest.raises(DataError, match="overlap for less than a second"):
        consistent_path(later, imu, flight.rig.imu)


@pytest.mark.slow
@pytest.mark.data
def test_a_machine_hall_flight_has_no_jumps(data_dir: Path) -> None:
    """The truth of MH_04 jumps by up to 130 mm; the path that is flown does not."""
    flight = simulate(
        trajectory=str(data_dir / "euroc_inertial" / "MH_04_difficult"),
        real_imu=True,
        start_s=38.0,
        duration_s=12.0,
    ).flight
    report = flight.report
    assert report is not None
    assert len(report.jumps_ns) == 2
    assert np.max(report.jumps_m) == pytest.approx(0.13, abs=5e-3)
    assert 0.02 < report.late_s < 0.04  # 24 ms in all, more in this part, where it jumps
    assert imu_is_honest(report)
    assert report.position_p95_m < 0.02
    raw = read_groundtruth(data_dir / "euroc_inertial" / "MH_04_difficult")
    stamps = np.arange(flight.motion.start_ns, flight.motion.end_ns, 5_000_000, dtype=np.int64)
    steps = np.diff(flight.motion.positions(stamps), axis=0)
    change = np.linalg.norm(np.diff(steps, axis=0), axis=1)
    assert np.max(change) < 30.0 * 0.005**2  # no acceleration beyond 30 m/s²
    assert np.max(distances(raw, flight.motion.at(stamps))) < 0.2  # type: ignore[attr-defined]
