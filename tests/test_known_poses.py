# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Known poses as absolute measurements: factors, alignment, files, and whole runs."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from groups import slow
from gtsam.symbol_shorthand import X
from recordings import FRAME_PERIOD_NS, START_NS
from recordings_ros import KINDS, LAG_NS, BagWriter, write_bag
from scipy.spatial.transform import Rotation

from slam_graph import run
from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.fix_factors import OrientationFix, PositionFix, fixes_of
from slam_graph.backend.aiding.path_of_fixes import PathFix
from slam_graph.backend.aiding.world_alignment import align_world
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.datasets import open_dataset
from slam_graph.datasets.streams.aiding_files import aiding_texts, read_aiding
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.evaluation import ape
from slam_graph.evaluation.consistency import nees
from slam_graph.results import RunResult
from slam_graph.sensors import AidingData
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

ARM = (0.2, -0.1, 0.3)
TURNED = tuple(Rotation.from_euler("ZYX", [0.5, -0.3, 0.2]).as_quat().tolist())
SENSOR = {"lever_arm_m": ARM, "quaternion": TURNED}
BACKEND = BackendConfig.model_validate({"known_poses": SENSOR})
SIGMAS = [0.02, 0.03, 0.04, 0.01, 0.02, 0.03]


def random_pose(rng: np.random.Generator) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), 5.0 * rng.normal(size=3))


def measured(bodies: list[gtsam.Pose3], sigmas: list[float]) -> AidingData:
    """What an ideal sensor with this mounting measures of poses of the body, one a second."""
    mounting = gtsam.Pose3(gtsam.Rot3(Rotation.from_quat(TURNED).as_matrix()), np.array(ARM))
    sensors = [body.compose(mounting) for body in bodies]
    return AidingData.empty().with_poses(
        np.arange(len(sensors), dtype=np.int64) * 10**9,
        np.array([sensor.translation() for sensor in sensors]),
        Rotation.from_matrix([sensor.rotation().matrix() for sensor in sensors]).as_quat(),
        np.tile(sigmas, (len(sensors), 1)),
    )


# --- factors -------------------------------------------------------------------------------------


def test_factors_vanish_at_the_true_pose_and_have_the_numerical_jacobian() -> None:
    rng = np.random.default_rng(1)
    body = random_pose(rng)
    fixes = fixes_of(measured([body], SIGMAS), BACKEND)
    assert [type(fix) for fix in fixes] == [PositionFix, OrientationFix]
    values, step = gtsam.Values(), 1e-6
    values.insert(X(0), body)
    for fix in fixes:
        factor = fix.factor(X(0))
        assert np.abs(factor.whitenedError(values)).max() < 1e-9
        columns = []
        for e in np.eye(6):
            ends = []
            for sign in (1.0, -1.0):
                moved = gtsam.Values()
                moved.insert(X(0), body.retract(sign * step * e))
                ends.append(np.asarray(factor.whitenedError(moved)))
            columns.append((ends[0] - ends[1]) / (2 * step))
        A, _ = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
        assert np.abs(A - np.array(columns).T).max() < 1e-5


def test_the_noise_of_an_orientation_is_about_the_axes_of_the_world() -> None:
    """A turn about an axis of the world by its σ costs one half."""
    body = random_pose(np.random.default_rng(2))
    fix = fixes_of(measured([body], SIGMAS), BACKEND)[1]
    for axis, sigma in zip(np.eye(3), SIGMAS[3:], strict=True):
        turn, values = gtsam.Rot3.Expmap(1e-3 * sigma * axis), gtsam.Values()
        values.insert(X(0), gtsam.Pose3(turn.compose(body.rotation()), body.translation()))
        assert fix.factor(X(0)).error(values) == pytest.approx(0.5e-6, rel=1e-3)


def test_a_measurement_moves_with_the_body() -> None:
    rng = np.random.default_rng(3)
    then, now = random_pose(rng), random_pose(rng)
    values = gtsam.Values()
    values.insert(X(0), now)
    for fix in fixes_of(measured([then], SIGMAS), BACKEND):
        assert fix.moved(then, now).factor(X(0)).error(values) < 1e-15


@pytest.mark.parametrize(("of", "kind"), [(slice(3, 6), PositionFix), (slice(3), OrientationFix)])
def test_what_was_not_measured_is_no_factor(of: slice, kind: type) -> None:
    sigmas = np.array(SIGMAS)
    sigmas[of] = np.inf
    data = measured([gtsam.Pose3()], sigmas.tolist())
    assert [type(fix) for fix in fixes_of(data, BACKEND)] == [kind]


# --- alignment -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("positions", "level"), [(True, True), (False, False), slow(True, False), slow(False, True)]
)
def test_a_few_poses_tell_the_world_as_well_as_they_say(level: bool, positions: bool) -> None:
    """NEES of the gauge over 40 draws of six poses, one of which is off by far."""
    rng, squares, count = np.random.default_rng(4), [], 6
    for _ in range(40):
        axis = np.array([0.0, 0.0, 1.0]) if level else rng.normal(size=3)
        truth = gtsam.Pose3(gtsam.Rot3.Expmap(axis), 10.0 * rng.normal(size=3))
        pairs = []
        for k in range(count):
            pose = random_pose(rng)
            there = truth.compose(pose)
            place = np.asarray(there.translation()) + 0.1 * rng.normal(size=3) + 5.0 * (k == 2)
            off = gtsam.Rot3.Expmap(0.02 * rng.normal(size=3) + 1.0 * (k == 2))
            turned = off.compose(there.rotation())
            pairs.append(PathFix(OrientationFix(k, turned, 4e-4 * np.eye(3)), pose))
            if positions:
                fix = PositionFix(k, place, 0.01 * np.eye(3), np.zeros(3))
                pairs.append(PathFix(fix, pose))
        found = align_world(pairs, np.zeros(3), level)
        assert found is not None
        wrong = [pair.fix.stamp_ns == 2 for pair in pairs]
        assert not found.fits[wrong].any()
        error = truth.compose(found.motion.inverse())
        turn = gtsam.Rot3.Logmap(error.rotation())
        shift = np.asarray(error.transformFrom(found.centre)) - found.centre
        g = np.concatenate([shift, turn[2:] if level else turn])[0 if positions else 3 :]
        covariance = found.covariance[0 if positions else 3 :, 0 if positions else 3 :]
        squares.append(g @ np.linalg.solve(covariance, g))
    dof = (1 if level else 3) + 3 * positions
    assert np.mean(squares) == pytest.approx(dof, abs=3.3 * np.sqrt(2 * dof / 40) + 0.05 * dof)


def test_two_poses_do_not_tell_the_world() -> None:
    pose = gtsam.Pose3()
    pairs = [PathFix(OrientationFix(k, pose.rotation(), np.eye(3)), pose) for k in range(2)]
    assert align_world(pairs, np.zeros(3), level=True) is None


# --- files ---------------------------------------------------------------------------------------


def test_files_keep_poses_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    data = measured([random_pose(rng) for _ in range(4)], [0.1, 0.2, 0.3, *3 * [np.inf]])
    (tmp_path / "poses.csv").write_text(aiding_texts(data)["poses.csv"])
    again = read_aiding([tmp_path], {}, Diagnostics())
    assert np.array_equal(again.pose_stamps_ns, data.pose_stamps_ns)
    assert np.array_equal(again.pose_positions, data.pose_positions)
    assert np.array_equal(again.pose_sigmas, data.pose_sigmas)


@pytest.mark.parametrize(
    "row",
    [
        "0,nan,0,0,0,0,0,1,1,1,1,1,1,1",
        "0,0,0,0,0,0,0,0.5,1,1,1,1,1,1",
        "0,0,0,0,0,0,0,1,1,1,inf,1,1,1",
        "0,0,0,0,0,0,0,1,1,1,1,1,0,1",
        "0,0,0,0,0,0,0,1,inf,inf,inf,inf,inf,inf",
    ],
)
def test_a_pose_that_cannot_be_used_is_counted(tmp_path: Path, row: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(f"{row}\n1,9,9,9,0,0,0,9,inf,inf,inf,1,1,1\n2,0,0,0,0,0,0,1,1,1,1,1,1,1\n")
    counted = Diagnostics()
    data = read_aiding([], {"poses": str(path)}, counted)
    assert data.pose_stamps_ns.tolist() == [2]
    assert counted.counts["poses_dropped"] == 2


def test_a_row_that_is_too_short_is_named(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("0,0,0,0,0,0,0,1\n")
    with pytest.raises(DataError, match=r"poses.csv:1: .*three sigmas \[rad\]"):
        read_aiding([], {"poses": str(path)}, Diagnostics())


# --- runs ----------------------------------------------------------------------------------------


def flight(seed: int, imu: bool, **poses: object) -> SimulatedSequence:
    """Ten seconds, with a fifth of the poses off by a metre and a rad."""
    given = {"position_sigma_m": 0.05, "rotation_sigma_rad": 0.02, "outliers": 0.2, **SENSOR}
    return simulate(
        trajectory="figure8",
        duration_s=10.0,
        rate_hz=10.0,
        seed=seed,
        with_imu=imu,
        tracks={"features": 60},
        known_poses=given | poses,
    )


def estimated(
    sequence: SimulatedSequence, algorithm: str = "msckf", smoothed: bool = False
) -> RunResult:
    """A run with a start of its own."""
    backend = {"known_poses": SENSOR}
    return run(
        sequence,
        algorithm=algorithm,
        backend=backend,
        final_ba={"enabled": smoothed},
        overrides=[BELIEVED],
    )


def error_m(sequence: SimulatedSequence, result: RunResult) -> float:
    """Unaligned, rms."""
    return ape(sequence.groundtruth(), result.trajectory, alignment="none").statistics.rmse


@pytest.mark.parametrize(
    ("algorithm", "imu"),
    [("msckf", True), slow("ekf", False), slow("okvis", True), slow("fixed_lag_isam2", False)],
)
def test_a_flight_ends_in_the_world_of_the_poses(algorithm: str, imu: bool) -> None:
    sequence = flight(0, imu)
    result = estimated(sequence, algorithm)
    assert result.status == "ok"
    assert result.georeferenced
    assert error_m(sequence, result) < 0.04


@pytest.mark.slow
def test_positions_alone_and_orientations_alone() -> None:
    sequence = flight(1, True, rotation_sigma_rad=None)
    assert error_m(sequence, estimated(sequence)) < 0.06
    sequence = flight(1, False, position_sigma_m=None)
    result = estimated(sequence)
    assert result.georeferenced
    turned = ape(sequence.groundtruth(), result.trajectory, "angle_deg", alignment="none")
    assert turned.statistics.rmse < 1.0


def test_the_final_adjustment_is_in_the_world_of_the_poses() -> None:
    sequence = flight(2, False)
    result = estimated(sequence, smoothed=True)
    assert result.smoothed is not None
    smoothed = ape(sequence.groundtruth(), result.smoothed, alignment="none").statistics.rmse
    assert smoothed < 0.8 * error_m(sequence, result)
    nees_of = result.metrics["final_ba"]["nees"]
    assert nees_of["alignment"] == "none"
    assert 0.1 < nees_of["position"]["mean"] < 12.0  # of one flight


@pytest.mark.slow
def test_the_estimate_is_as_sure_as_it_should_be() -> None:
    """NEES of orientation and position over eight flights, at times that are far apart."""
    found: list[FloatArray] = []
    for seed in range(8):
        sequence = flight(seed, imu=seed % 2 == 0)
        result = estimated(sequence)
        errors = nees(result.trajectory, result.history.pose_covariances(), sequence.groundtruth())
        found.append(np.array([errors.orientation[20::20], errors.position[20::20]]).mean(axis=1))
    for mean in np.mean(found, axis=0).tolist():
        assert 1.0 < mean < 4.6  # eight runs, 3 degrees of freedom each: 99.9 % of χ²(24) / 8


# --- bags ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("known", [True, False])
def test_known_poses_of_a_bag(tmp_path: Path, kind: str, known: bool) -> None:
    """With the variances of each message, or the documented ones; what is no pose is left out."""
    rng = np.random.default_rng(5)
    stamps = [START_NS + k * FRAME_PERIOD_NS for k in range(4)]
    places, turns = rng.normal(size=(4, 3)), Rotation.random(4, random_state=5).as_quat()
    places[2, 0] = np.nan
    covariance = np.diag(np.square(SIGMAS)) if known else np.zeros((6, 6))

    def write(bag: BagWriter) -> None:
        for stamp, place, turn in zip(stamps, places, turns, strict=True):
            bag.write("/vicon", bag.known_pose(stamp, place, turn, covariance), stamp + LAG_NS)

    path = write_bag(tmp_path, kind, 4, extra=write)
    assert len(open_dataset(path).aiding) == 0  # such a topic may be the ground truth
    sequence = open_dataset(path, sources={"poses": "/vicon"})
    data, kept = sequence.aiding, [0, 1, 3]
    assert data.pose_stamps_ns.tolist() == [stamps[k] for k in kept]
    np.testing.assert_allclose(data.pose_positions, places[kept])
    np.testing.assert_allclose(data.pose_quaternions, turns[kept])
    np.testing.assert_allclose(data.pose_sigmas, [SIGMAS if known else [0.05] * 6] * 3)
    assert sequence.diagnostics.counts["poses_dropped"] == 1
    assert sequence.diagnostics.counts["pose_sigma_assumed"] == (not known)
    with pytest.raises(DataError, match=r"'/cam0.*' is of type .*; expected geometry_msgs"):
        _ = open_dataset(path, sources={"poses": "/cam0/image_raw"}).aiding
