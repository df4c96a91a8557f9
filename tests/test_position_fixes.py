# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes and odometry: geodesy, factors, gauge, gate, files, and whole runs."""

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from flight import Flight
from groups import slow
from gtsam.symbol_shorthand import L, V, X
from scipy.spatial.transform import Rotation

from slam_graph import run
from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.aiding_factors import Aiding
from slam_graph.backend.aiding.fix_factors import FixGate, PositionFix
from slam_graph.backend.aiding.path_of_fixes import PathFix
from slam_graph.backend.aiding.regauging import gauge_directions, with_free_gauge
from slam_graph.backend.aiding.world_alignment import WorldAlignment, align_world
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.datasets import TrackRecorder, open_dataset
from slam_graph.datasets.streams.aiding_files import read_fixes
from slam_graph.datasets.streams.geodesy import geodetic_positions, local_positions
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.evaluation import ape
from slam_graph.results import RunResult
from slam_graph.sensors import AidingData, FeatureFrame
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

CAUSAL_ONLY: dict[str, Any] = {"final_ba": {"enabled": False}, "overrides": [BELIEVED]}
PLACES = [(49.0, 8.4, 115.0), (-33.9, 151.2, 20.0), (64.1, -21.9, 0.0), (0.01, 179.99, 4000.0)]


def drive(duration_s: float, seed: int = 1, **settings: object) -> SimulatedSequence:
    """A car without an IMU."""
    few = {"features": 60}
    return simulate(
        trajectory="car", duration_s=duration_s, seed=seed, with_imu=False, tracks=few, **settings
    )


# --- geodesy -------------------------------------------------------------------------------------


@pytest.mark.parametrize("datum", PLACES)
def test_local_positions_go_back(
    datum: tuple[float, float, float],
) -> None:
    local = np.random.default_rng(0).uniform(-5e4, 5e4, (200, 3))
    again = local_positions(geodetic_positions(local, datum), datum)
    assert np.abs(again - local).max() < 1e-6  # one micrometre


def test_axes_point_east_north_up() -> None:
    datum = (49.0, 8.4, 115.0)
    step = np.array(datum) + np.diag([1e-5, 1e-5, 1.0])
    north, east, up = local_positions(step, datum)
    # radii of curvature of WGS84 at this latitude (Torge, Geodesy, 4.2)
    e2, a, sine = 6.69437999014e-3, 6378137.0, np.sin(np.radians(49.0))
    M = a * (1 - e2) / (1 - e2 * sine**2) ** 1.5
    N = a / np.sqrt(1 - e2 * sine**2)
    angle = np.radians(1e-5)
    assert north == pytest.approx([0.0, (M + 115.0) * angle, 0.0], abs=1e-5)
    across = (N + 115.0) * np.cos(np.radians(49.0)) * angle
    assert east == pytest.approx([across, 0.0, 0.0], abs=1e-5)
    assert up == pytest.approx([0.0, 0.0, 1.0], abs=1e-8)


# --- factors and gauge ---------------------------------------------------------------------------


def random_pose(rng: np.random.Generator) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), 5.0 * rng.normal(size=3))


def test_the_jacobian_of_a_fix_is_the_numerical_one() -> None:
    rng, arm = np.random.default_rng(3), np.array([0.3, -0.2, 1.1])
    factor = PositionFix(0, rng.normal(size=3), np.diag([1.0, 2.0, 4.0]), arm).factor(X(0))
    values = gtsam.Values()
    values.insert(X(0), random_pose(rng))
    A, _ = gtsam.JacobianFactor(factor.linearize(values)).jacobian()

    def error(delta: FloatArray) -> FloatArray:
        moved = gtsam.Values()
        moved.insert(X(0), values.atPose3(X(0)).retract(delta))
        return np.asarray(factor.whitenedError(moved))

    step = 1e-6
    columns = [(error(step * e) - error(-step * e)) / (2 * step) for e in np.eye(6)]
    assert np.abs(A - np.array(columns).T).max() < 1e-8


@pytest.mark.parametrize("level", [True, False])
def test_directions_of_the_gauge_are_the_derivatives_of_a_moved_world(level: bool) -> None:
    rng = np.random.default_rng(4)
    values = gtsam.Values()
    values.insert(X(0), random_pose(rng))
    values.insert(V(0), rng.normal(size=3))
    values.insert(L(0), rng.normal(size=3))
    layout, centre = Layout(dims_of([X(0), V(0), L(0)])), rng.normal(size=3)
    N, step = gauge_directions(values, layout, centre, level), 1e-6
    axes = np.eye(3)[2:] if level else np.eye(3)
    for k in range(N.shape[1]):
        g = np.zeros(N.shape[1])
        g[k] = step
        turn = gtsam.Rot3.Expmap(axes.T @ g[3:])
        world = gtsam.Pose3(turn, centre + g[:3] - turn.rotate(centre))
        moved = np.concatenate(
            [
                values.atPose3(X(0)).localCoordinates(world.compose(values.atPose3(X(0)))),
                turn.rotate(values.atVector(V(0))) - values.atVector(V(0)),
                world.transformFrom(values.atPoint3(L(0))) - values.atPoint3(L(0)),
            ]
        )
        assert np.abs(moved / step - N[:, k]).max() < 1e-5


def test_a_free_gauge_adds_its_covariance() -> None:
    rng = np.random.default_rng(5)
    layout = Layout(dims_of([X(0), V(0)]))
    prior = SquareRootInformation(layout, triangularize(rng.normal(size=(30, layout.size + 1))))
    N, root = rng.normal(size=(layout.size, 4)), rng.normal(size=(4, 4))
    gauge = root @ root.T
    freed = with_free_gauge(prior, N, gauge)
    assert np.allclose(freed.covariance(), prior.covariance() + N @ gauge @ N.T)
    assert np.allclose(freed.solution(), prior.solution())


# --- alignment and gate --------------------------------------------------------------------------


def aligned(places: FloatArray, fixes: FloatArray, level: bool) -> WorldAlignment | None:
    """The world of fixes (N, 3) of 1 m along a path."""
    pairs = [
        PathFix(fix_of(fix), gtsam.Pose3(gtsam.Rot3(), place))
        for place, fix in zip(places, fixes, strict=True)
    ]
    return align_world(pairs, places[-1], level)


def fix_of(position: FloatArray) -> PositionFix:
    """A fix of 1 m of the origin of the body."""
    return PositionFix(0, position, np.eye(3), np.zeros(3))


@pytest.mark.parametrize("level", [True, False])
def test_the_world_is_found_among_multipath_as_well_as_it_says(level: bool) -> None:
    """NEES of the gauge over 40 draws within its 99.9 % bounds; none is lost to outliers."""
    rng, squares = np.random.default_rng(6), []
    way = np.linspace(0.0, 2 * np.pi, 60)
    places = np.column_stack([60 * np.cos(way), 40 * np.sin(2 * way), 4 * np.sin(3 * way)])
    for _ in range(40):
        axis = np.array([0.0, 0.0, 1.0]) if level else rng.normal(size=3)
        truth = gtsam.Pose3(gtsam.Rot3.Expmap(axis), 100.0 * rng.normal(size=3))
        fixes = np.asarray(truth.transformFrom(places.T)).T + rng.normal(size=places.shape)
        wrong = rng.random(len(fixes)) < 0.2
        angles = rng.uniform(0, 2 * np.pi, len(fixes))
        fixes[wrong, :2] += 10.0 * np.column_stack([np.cos(angles), np.sin(angles)])[wrong]
        found = aligned(places, fixes, level)
        assert found is not None
        assert not found.fits[wrong].any()
        error = truth.compose(found.motion.inverse())
        turn = gtsam.Rot3.Logmap(error.rotation())
        shift = np.asarray(error.transformFrom(found.centre)) - found.centre
        g = np.concatenate([shift, turn[2:] if level else turn])
        squares.append(g @ np.linalg.solve(found.covariance, g))
    dof = 4 if level else 6
    assert np.mean(squares) == pytest.approx(dof, abs=3.3 * np.sqrt(2 * dof / 40) + 0.05 * dof)


def test_a_straight_line_does_not_tell_the_world_without_gravity() -> None:
    rng = np.random.default_rng(7)
    places = np.column_stack([np.arange(60.0), np.zeros(60), np.zeros(60)])
    noisy = places + rng.normal(size=places.shape)
    assert aligned(places, noisy, level=False) is None
    assert aligned(places, noisy, level=True) is not None


def test_a_clock_that_is_off_is_found_as_well_as_it_says() -> None:
    """NEES of world and offset over 40 draws of fixes that come late by an unknown time."""
    rng, squares = np.random.default_rng(9), []
    way = np.linspace(0.0, 2 * np.pi, 60)
    places = np.column_stack([60 * np.cos(way), 40 * np.sin(2 * way), np.zeros(60)])
    speeds = np.column_stack([-60 * np.sin(way), 80 * np.cos(2 * way), np.zeros(60)]) / 5.0
    for _ in range(40):
        late = 0.2 * rng.normal()
        truth = gtsam.Pose3(gtsam.Rot3.Yaw(rng.normal()), 100.0 * rng.normal(size=3))
        exact = np.asarray(truth.transformFrom((places + late * speeds).T)).T
        pairs = [
            PathFix(
                fix_of(fix + rng.normal(size=3)), gtsam.Pose3(gtsam.Rot3(), place), velocity=speed
            )
            for fix, place, speed in zip(exact, places, speeds, strict=True)
        ]
        found = align_world(pairs, places[-1], True, (0.0, 0.2))
        assert found is not None
        squares.append(((found.offset_s - late) / found.offset_sigma_s) ** 2)
    assert np.mean(squares) == pytest.approx(1.0, abs=3.3 * np.sqrt(2 / 40))


def test_the_gate_rejects_multipath_and_few_good_fixes() -> None:
    rng, gate, pose = np.random.default_rng(8), FixGate(), gtsam.Pose3()
    known = 0.01 * np.eye(6)
    good = [gate.weight(fix_of(rng.normal(size=3)), pose, known) for _ in range(400)]
    assert np.mean(np.array(good) == 0.0) < 0.01
    assert np.mean(good) > 0.95
    for _ in range(2):
        assert gate.weight(fix_of(np.array([10.0, 0.0, 0.0])), pose, known) == 0.0


def test_a_frame_that_is_not_kept_takes_no_fix_away() -> None:
    """GTSAM's smoothers predict every frame, and keep only some."""
    aiding = Aiding(BackendConfig(), level=True)
    aiding.aligned, state = True, State()
    for frame in range(4):
        state.insert_imu_state(frame, Flight().nav_state(0.0))
    covariances = np.tile(np.eye(3), (6, 1, 1))
    aiding.add(AidingData.of_fixes(np.arange(1, 7) * 10, np.zeros((6, 3)), covariances))

    def counted(first: int, last: int, frames: tuple[int, int]) -> int:
        return len(aiding.factors(state, frames, (first, last), None))

    assert counted(0, 20, (0, 1)) == 2  # not kept: the next frame follows the same one
    assert counted(0, 40, (0, 2)) == 4
    assert counted(40, 60, (2, 3)) == 2


def test_the_gate_gives_in_if_all_fixes_say_the_same() -> None:
    gate, pose, there = FixGate(), gtsam.Pose3(), np.array([30.0, 0.0, 0.0])
    weights = [gate.weight(fix_of(there), pose, 0.01 * np.eye(6)) for _ in range(12)]
    assert weights[0] == 0.0
    assert weights[-1] > 0.0


# --- files ---------------------------------------------------------------------------------------


def test_nmea_gives_positions(tmp_path: Path) -> None:
    path = tmp_path / "gnss.csv"
    path.write_text(
        "1000,$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n"
        "2000,$GPGGA,123520,,,,,0,00,,,M,,M,,*47\n"
        "3000,$GPGGA,123521,4807.039,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,,*47\n"
    )
    counted = Diagnostics()
    data = read_fixes(path, counted)
    assert data.fix_stamps_ns.tolist() == [1000, 3000]
    assert counted.counts["gnss_dropped"] == 1
    assert data.datum == pytest.approx((48 + 7.038 / 60, 11 + 31 / 60, 592.3))
    assert data.fix_positions[1] == pytest.approx([0.0, 1.853, 0.0], abs=2e-3)
    assert data.fix_covariances[1, 0, 0] < data.fix_covariances[0, 0, 0]


def test_a_damaged_sentence_is_named(tmp_path: Path) -> None:
    path = tmp_path / "gnss.csv"
    path.write_text("1000,$GPGGA,123519,48x7.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n")
    with pytest.raises(DataError, match=r"gnss.csv:1: expected a stamp \[ns\] and a GGA sentence"):
        read_fixes(path, Diagnostics())


def test_a_recording_keeps_fixes_and_odometry(tmp_path: Path) -> None:
    sequence = drive(5.0, gnss={"sigma_m": 1.0, "rate_hz": 3.0}, odometry={"enabled": True})
    with TrackRecorder(tmp_path / "drive", sequence.rig) as recorder:
        for packet in sequence.packets():
            assert isinstance(packet.frame, FeatureFrame)
            recorder.write(packet.imu, packet.frame, packet.aiding)
    again = open_dataset(tmp_path / "drive")
    for name in AidingData.__slots__:
        was, is_now = getattr(sequence.aiding, name), getattr(again.aiding, name)
        assert np.array_equal(was, is_now), name


def test_packets_part_the_fixes() -> None:
    sequence = drive(5.0, gnss={"sigma_m": 1.0, "rate_hz": 7.0})
    parts = []
    for packet in sequence.packets():
        assert packet.aiding is not None
        assert (packet.aiding.fix_stamps_ns <= packet.frame.stamp_ns).all()
        parts.append(packet.aiding)
    joined = AidingData.concatenate(parts)
    assert np.array_equal(joined.fix_stamps_ns, sequence.aiding.fix_stamps_ns)


def test_odometry_between_two_times() -> None:
    turns = Rotation.from_euler("Z", [[0.0], [0.1], [0.2]]).as_quat()
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    data = AidingData.empty().with_odometry(np.array([0, 10**8, 2 * 10**8]), places, turns)
    found = data.odometry_between(10**8, 15 * 10**7)
    assert found is not None
    assert found[0] == pytest.approx([0.0, 0.0, 0.05])
    assert found[1] == pytest.approx([0.5 * np.cos(0.1), -0.5 * np.sin(0.1), 0.0])
    assert data.odometry_between(0, 3 * 10**8) is None


# --- runs ----------------------------------------------------------------------------------------


def error_m(result: RunResult, sequence: SimulatedSequence, since: float = 0.5) -> float:
    """Unaligned error of the later part of a run, rms in m."""
    path = result.trajectory
    late = path.select(np.arange(len(path)) >= since * len(path))
    return ape(sequence.groundtruth(), late, alignment="none").statistics.rmse


@pytest.mark.parametrize("algorithm", ["msckf", slow("ekf"), slow("okvis")])
def test_a_drive_ends_in_the_world_of_the_fixes(algorithm: str) -> None:
    """From a start of its own, with every fifth fix off by 10 m."""
    sequence = drive(30.0, gnss={"sigma_m": 1.0, "multipath": 0.2})
    auto = {"initialization": {"mode": "static"}}
    result = run(sequence, algorithm=algorithm, backend=auto, **CAUSAL_ONLY)
    assert result.status == "ok"
    assert result.georeferenced
    assert result.metrics["world"]["of_fixes"]
    assert len(result.trajectory) > 295  # what came before the alignment is not lost
    assert error_m(result, sequence) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(("given", "sigma"), [(-0.3, 0.0), (0.0, 0.3)])
def test_fixes_that_come_late_count_where_they_were_measured(given: float, sigma: float) -> None:
    """By an offset that is given, or found; neglected, it is 3 m on the road."""
    sequence = drive(30.0, rate_hz=10.0, gnss={"sigma_m": 0.3, "rate_hz": 2.0, "late_s": 0.3})
    gnss = {"gnss": {"time_offset_s": given, "time_offset_sigma_s": sigma}}
    result = run(sequence, algorithm="msckf", backend=gnss, **CAUSAL_ONLY)
    assert result.georeferenced
    assert given + result.fix_offset_s == pytest.approx(-0.3, abs=0.06)
    assert error_m(result, sequence) < 0.6


@pytest.mark.slow
def test_fixes_bound_the_error_of_odometry_that_drifts() -> None:
    """With few poor features the path drifts by metres; fixes hold it."""
    poor = {"features": 20, "pixel_sigma": 2.0}
    backend = {"noise": {"pixel_sigma": 2.0}}
    errors = []
    for gnss in (None, 1.0):
        sequence = simulate(
            trajectory="car",
            duration_s=100.0,
            seed=2,
            with_imu=False,
            tracks=poor,
            gnss={"sigma_m": gnss},
        )
        result = run(sequence, algorithm="msckf", backend=backend, **CAUSAL_ONLY)
        errors.append(error_m(result, sequence))
    assert errors[1] < 1.5
    assert errors[0] > 2.0 * errors[1]


def test_without_fixes_results_are_the_same_to_the_bit() -> None:
    sequence = drive(3.0)
    fixes = drive(3.0, gnss={"sigma_m": 1.0})
    off = {"gnss": {"enabled": False}}
    without = run(sequence, algorithm="msckf", **CAUSAL_ONLY)
    ignored = run(fixes, algorithm="msckf", backend=off, **CAUSAL_ONLY)
    assert np.array_equal(without.trajectory.positions, ignored.trajectory.positions)


@pytest.mark.slow
def test_odometry_helps_where_few_features_are_seen() -> None:
    poor = {"features": 20, "pixel_sigma": 2.0}
    backend = {"noise": {"pixel_sigma": 2.0}}
    errors = []
    for enabled in (False, True):
        sequence = simulate(
            trajectory="car",
            duration_s=12.0,
            rate_hz=10.0,
            seed=3,
            with_imu=False,
            tracks=poor,
            odometry={"enabled": enabled},
        )
        result = run(sequence, algorithm="msckf", backend=backend, **CAUSAL_ONLY)
        errors.append(error_m(result, sequence))
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.slow
def test_the_final_adjustment_is_in_the_world_of_the_fixes() -> None:
    sequence = drive(60.0, gnss={"sigma_m": 1.0, "multipath": 0.2})
    result = run(sequence, algorithm="msckf")
    assert result.smoothed is not None
    smoothed = ape(sequence.groundtruth(), result.smoothed, alignment="none").statistics.rmse
    causal = ape(sequence.groundtruth(), result.trajectory, alignment="none").statistics.rmse
    assert smoothed < 0.75 * causal
    assert smoothed < 0.8


def test_one_time_from_the_future_does_not_block_a_file(tmp_path: Path) -> None:
    rows = [[k, k, 0, 0, 1, 1, 1] for k in range(1, 7)]
    rows[2][0], rows[4][1] = 10**15, "nan"  # type: ignore[call-overload]
    path = tmp_path / "gnss.csv"
    header = "#timestamp [ns],east [m],north [m],up [m],e,n,u\n"
    path.write_text(header + "".join(",".join(map(str, row)) + "\n" for row in rows))
    counted = Diagnostics()
    assert read_fixes(path, counted).fix_stamps_ns.tolist() == [1, 2, 4, 6]
    assert counted.counts == {"gnss_dropped": 2}
    path.write_text(header + "1,nan,0,0,1,1,1\n")
    assert len(read_fixes(path, counted)) == 0
