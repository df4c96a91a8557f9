# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recovery: what is lost is taken back, and the run goes on as a new segment, honestly joined."""

import csv
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from groups import slow
from gtsam.symbol_shorthand import L, X

from slam_graph.backend.cost.gating import Innovations
from slam_graph.backend.cost.imu_factor import VelocityCorrection
from slam_graph.backend.initialization.segment_joint import moved
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of, imu_state_keys
from slam_graph.backend.window import Window
from slam_graph.config import RunConfig
from slam_graph.datasets.faults.injection import inject
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.geometry.trajectory import NavState
from slam_graph.pipeline.agreement import Agreement
from slam_graph.pipeline.divergence import Bridging, Corrections, DivergenceError
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.sensors import FeatureFrame, FeatureObservations
from slam_graph.simulation.simulator import simulate

CAUSAL = ("final_ba.enabled=false", BELIEVED)
FAULT_S, BLIND_S = 6.0, 3.0


def flown(
    *faults: str,
    algorithm: str = "msckf",
    settings: tuple[str, ...] = CAUSAL,
    rate_hz: float = 10.0,
) -> RunResult:
    """A run over 16 s of simulated stereo."""
    sequence = simulate(trajectory="figure8", cameras=2, duration_s=16.0, rate_hz=rate_hz, seed=1)
    return run(inject(sequence, faults), algorithm=algorithm, overrides=settings)


def error_m(result: RunResult, number: int) -> float:
    """Error of a segment that is aligned on its own."""
    assert result.groundtruth is not None
    part = result.segments[number].part_of(result.trajectory)
    return ape(result.groundtruth, part, alignment="yaw").statistics.rmse


@pytest.fixture(scope="module")
def blind() -> RunResult:
    return flown(f"all_missing:at_s={FAULT_S},duration_s={BLIND_S}")


def test_after_a_time_without_anything_a_new_segment_begins(blind: RunResult) -> None:
    assert blind.status == "ok"
    assert [segment.joined_by for segment in blind.segments] == ["start", "imu"]
    start_ns = blind.input.start_ns
    ends = (blind.segments[0].end_ns - start_ns, blind.segments[1].begin_ns - start_ns)
    assert FAULT_S - 1.0 < ends[0] * 1e-9 <= FAULT_S
    assert FAULT_S + BLIND_S < ends[1] * 1e-9 < FAULT_S + BLIND_S + 5.0
    assert blind.warnings["new_segment"] == 1


def test_what_a_clean_run_reaches_is_reached_after_the_fault(blind: RunResult) -> None:
    clean = error_m(flown(), 0)
    assert max(error_m(blind, 0), error_m(blind, 1)) < 2.0 * clean


def test_the_joint_is_as_wrong_as_it_says(blind: RunResult) -> None:
    """Where the IMU predicts the start of the segment, against the truth in the first world."""
    truth = blind.groundtruth
    assert truth is not None
    first = blind.segments[0].part_of(blind.trajectory)
    aligned = ape(truth, first, alignment="yaw").similarity
    later = blind.segments[1].part_of(blind.trajectory)
    begin = aligned.apply(later[:1])
    nearest = int(np.argmin(np.abs(truth.stamps_ns - begin.stamps_ns[0])))
    off = begin.positions[0] - truth.positions[nearest]
    sigmas = np.sqrt(np.diag(blind.segments[1].joint_covariance))[:3]
    assert np.all(np.abs(off) < 3.0 * sigmas)
    row = int(np.searchsorted(blind.trajectory.stamps_ns, begin.stamps_ns[0]))
    assert np.linalg.norm(blind.sigmas[row, 3:6]) > 0.99 * np.linalg.norm(sigmas)


def test_time_between_segments_is_not_covered(blind: RunResult, tmp_path: Path) -> None:
    first, second = blind.segments
    recorded_s = blind.input.recorded_s
    assert blind.coverage == pytest.approx((first.seconds + second.seconds) / recorded_s)
    stamps = blind.trajectory.stamps_ns
    assert not np.any((stamps > first.end_ns) & (stamps < second.begin_ns))

    blind.save(tmp_path)
    with (tmp_path / "segments.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["states"]) for row in rows] == [
        len((tmp_path / f"trajectory_segment_{k}.tum").read_text().splitlines()) for k in (0, 1)
    ]
    assert "nothing was recorded for 3.0 s" in rows[0]["ended_by"]
    assert sum(int(row["states"]) for row in rows) == len(stamps)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["imu_missing:at_s=6,duration_s=1.5", "frames_dropped:at_s=6"])
def test_one_sensor_alone_goes_on_without_the_other(fault: str) -> None:
    result = flown(fault)
    assert result.status == "ok"
    assert len(result.segments) == 1


@pytest.mark.parametrize("algorithm", ["msckf", slow("swf"), slow("okvis")])
def test_being_carried_away_is_noticed_whatever_is_in_the_cost(algorithm: str) -> None:
    result = flown("kidnapped:at_s=6,duration_s=2", algorithm=algorithm)
    assert [segment.joined_by for segment in result.segments] == ["start", "none"]
    begins_s = (result.segments[1].begin_ns - result.input.start_ns) * 1e-9
    assert begins_s < FAULT_S + 5.0
    assert error_m(result, 1) < 0.05


@pytest.mark.slow
def test_a_jump_to_where_everything_fits_is_noticed_by_the_tracks_across_it() -> None:
    result = flown("kidnapped:at_s=6,duration_s=1", rate_hz=20.0)
    assert [segment.joined_by for segment in result.segments] == ["start", "none"]
    assert "not across it" in result.segments[0].ended_by
    assert max(error_m(result, 0), error_m(result, 1)) < 0.02


@pytest.mark.parametrize(
    "algorithm", ["msckf", slow("okvis"), slow("ekf"), slow("fixed_lag_isam2")]
)
def test_images_lead_through_a_time_without_imu(algorithm: str) -> None:
    """What is known of biases stays known, so that no new start is needed."""
    result = flown("imu_missing:at_s=6,duration_s=3", algorithm=algorithm)
    assert [segment.ended_by for segment in result.segments] == [""]
    assert error_m(result, 0) < 0.03
    history = result.history
    times_s = (history.trajectory().stamps_ns - result.input.start_ns) * 1e-9
    after = int(np.argmin(np.abs(times_s - 9.2)))
    assert np.all(history.sigmas()[after, 9:12] < 0.05), "m/s²"


def test_a_correction_is_as_large_as_expected() -> None:
    """Over many draws, where an error of the covariance P⁻ is corrected to one of P⁺."""
    rng, prior = np.random.default_rng(1), np.eye(15)
    prior[6:9, 6:9] = np.diag([1.0, 0.5, 0.1]) + 0.05
    H, squares = rng.normal(size=(2, 3)), []
    P = prior[6:9, 6:9]
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(2))
    posterior = prior.copy()
    posterior[6:9, 6:9] = P - K @ H @ P
    zero = np.zeros(3)
    predicted = NavState(0, gtsam.Pose3(), zero, accel_bias=zero, gyro_bias=zero, covariance=prior)
    for _ in range(2000):
        truth = rng.multivariate_normal(np.zeros(3), P)
        velocity = K @ (H @ truth + rng.normal(size=2))
        state = replace(predicted, velocity=velocity, covariance=posterior)
        found = VelocityCorrection.of(predicted, state)
        squares.append(found.square)
    assert 0.0 < found.expected < 1.0
    assert np.mean(squares) == pytest.approx(found.expected, rel=0.1)


@pytest.mark.parametrize("algorithm", ["okvis", slow("fixed_lag_isam2")])
def test_another_velocity_is_not_taken_over(algorithm: str) -> None:
    """No track goes on across the jump: new features agree with the new velocity, the IMU not."""
    result = flown("kidnapped:at_s=6,duration_s=3.7", algorithm=algorithm)
    assert [segment.joined_by for segment in result.segments] == ["start", "none"]
    begins_s = (result.segments[1].begin_ns - result.input.start_ns) * 1e-9
    assert begins_s < FAULT_S + 5.0
    assert max(error_m(result, 0), error_m(result, 1)) < 0.05


@pytest.mark.parametrize(
    ("first_id", "expected", "noticed"), [(100, 0.1, True), (0, 0.1, False), (100, 0.4, False)]
)
def test_corrections_of_the_velocity_count_where_tracks_are_broken(
    first_id: int, expected: float, noticed: bool
) -> None:
    """Ids begin at another number after 2 s, and corrections are too large; one was before.

    There are none from 1 to 1.75 s, as at a standstill. Corrections that are large because images
    tell much are none that contradict the IMU.
    """
    corrections, step_ns = Corrections(), 50_000_000
    with pytest.raises(DivergenceError) if noticed else nullcontext():
        for k in range(80):
            ids = np.arange(30, dtype=(np.int32, np.int64)[k % 2]) + (first_id if k >= 40 else 0)
            seen = FeatureObservations(ids, np.zeros((30, 2)), np.zeros((30, 2)))
            corrections.note(FeatureFrame(k * step_ns, (seen,)))
            if not 20 < k < 35:
                square = 2.0 if k >= 40 else 20.0 * (k == 20)
                corrections.check(k * step_ns, square, expected)
    agreed = corrections.agreed_until()
    assert (agreed is not None and 35 * step_ns <= agreed < 41 * step_ns) == noticed
    assert (len(corrections) > 0) == noticed


def test_a_single_correction_after_a_pause_is_no_contradiction() -> None:
    corrections, step_ns = Corrections(), 50_000_000
    for k in (*range(20), 500):
        ids = np.arange(30) + (100 if k == 500 else 0)
        seen = FeatureObservations(ids, np.zeros((30, 2)), np.zeros((30, 2)))
        corrections.note(FeatureFrame(k * step_ns, (seen,)))
        corrections.check(k * step_ns, 50.0 if k == 500 else 0.5, 0.5)
    assert corrections.agreed_until() is None


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["swf", "okvis", "fixed_lag_isam2"])
def test_every_engine_starts_again(algorithm: str) -> None:
    result = flown("all_missing:at_s=6,duration_s=2", algorithm=algorithm)
    assert result.status == "ok"
    assert [segment.joined_by for segment in result.segments] == ["start", "imu"]
    assert error_m(result, 1) < 0.05


def test_a_segment_somewhere_else_is_not_joined_and_places_join_it(tmp_path: Path) -> None:
    """A part of the flight is cut out: the IMU knows nothing of it, recognised places do."""
    sequence = simulate(
        trajectory="rooms",
        duration_s=64.0,
        rate_hz=5.0,
        seed=3,
        cameras=2,
        landmarks={"density": 4.0},
        tracks={"features": 70, "descriptors": True},
    )
    settings = (*CAUSAL, "loop_closure.enabled=true", "loop_closure.places.words=300")
    cut = inject(sequence, ["kidnapped:at_s=20,duration_s=6"])
    result = run(cut, algorithm="msckf", overrides=settings)
    assert result.status == "ok"
    assert [segment.joined_by for segment in result.segments] == ["start", "none"]
    assert result.segments[1].loops > 0
    assert result.groundtruth is not None
    assert result.loop_closed is not None
    apart = ape(result.groundtruth, result.trajectory, alignment="yaw").statistics.rmse
    joined = ape(result.groundtruth, result.loop_closed, alignment="yaw").statistics.rmse
    assert joined < 0.1
    assert apart > 5.0 * joined

    joint = result.segments[1].place_joint
    assert joint is not None
    truth = result.groundtruth
    rows = [int(np.argmin(np.abs(truth.stamps_ns - t))) for t in (joint.first_ns, joint.second_ns)]
    true = truth.pose(rows[0]).between(truth.pose(rows[1]))
    off = true.localCoordinates(joint.first_T_second)
    # the graph takes roll and pitch as they are: only the turn about the vertical counts
    known = np.zeros((4, 6))
    known[0, :3] = truth.pose(rows[1]).rotation().matrix()[2]
    known[1:, 3:] = np.eye(3)
    sigmas = np.sqrt(np.diag(known @ joint.covariance @ known.T))
    assert np.all(np.abs(known @ off) < 4.0 * sigmas)
    assert np.all(sigmas < 0.3)
    result.save(tmp_path)
    with (tmp_path / "segments.csv").open(newline="") as file:
        rows_saved = list(csv.DictReader(file))
    assert rows_saved[0]["joint_cov_55"] == ""
    assert float(rows_saved[1]["joint_cov_55"]) == pytest.approx(joint.covariance[5, 5])


@pytest.mark.slow
def test_worlds_that_are_not_joined_are_smoothed_apart() -> None:
    result = flown("kidnapped:at_s=6,duration_s=3.7", settings=(BELIEVED,))
    assert [segment.joined_by for segment in result.segments] == ["start", "none"]
    assert result.smoothed is not None
    for segment in result.segments:
        part = segment.part_of(result.smoothed)
        assert result.groundtruth is not None
        assert ape(result.groundtruth, part, alignment="yaw").statistics.rmse < 0.02
    sigmas, stamps_ns = result.smoothed_sigmas, result.smoothed.stamps_ns
    assert sigmas is not None
    later = stamps_ns >= result.segments[1].begin_ns
    assert sigmas[~later, 3:6].max() < 1.0
    assert sigmas[later, 3:6].min() > 500.0  # nothing tells where it is


def test_a_run_that_is_lost_again_and_again_is_given_up() -> None:
    result = flown(settings=(*CAUSAL, "limits.max_speed=1e-9"))
    assert result.status == "diverged"
    assert result.warnings["new_segment"] == 2
    assert len(result.history) == 0
    assert result.logs.frames < 100


def test_without_recovery_a_run_ends_where_it_is_lost() -> None:
    fault = f"all_missing:at_s={FAULT_S},duration_s={BLIND_S}"
    result = flown(fault, settings=(*CAUSAL, "limits.recovery=false"))
    assert result.status == "diverged"
    assert "nothing was recorded" in result.message
    assert len(result.segments) == 1


def test_images_agreed_until_the_rejections_began() -> None:
    agreement, step_ns = Agreement(RunConfig()), 10**8
    assert agreement.agreed_until() is None
    for k in range(55):
        agreement.check(k * step_ns, Innovations(tested=10, rejected=0 if k < 40 else 10))
    until = agreement.agreed_until()
    assert until is not None
    assert until == 39 * step_ns


def test_agreement_is_remembered_however_slowly_it_is_lost() -> None:
    """A share between good and lost over a long time: what was good before it stays known."""
    agreement, step_ns = Agreement(RunConfig()), 10**8
    for k in range(1200):
        rejected = 0 if k < 1000 else 4
        agreement.check(k * step_ns, Innovations(tested=10, rejected=rejected))
    until = agreement.agreed_until()
    assert until is not None
    assert until > 900 * step_ns


def test_a_window_in_a_moved_world_knows_the_same() -> None:
    rng = np.random.default_rng(0)
    state, zero = State(), np.zeros(3)
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
    nav = NavState(0, pose, rng.normal(size=3), accel_bias=zero, gyro_bias=zero)
    state.insert_imu_state(0, nav)
    state.insert_point(7, rng.normal(size=3))
    layout = Layout(dims_of([L(7), *imu_state_keys(0)]))
    Rd = np.triu(rng.normal(size=(layout.size + 1, layout.size + 1)))
    Rd[np.diag_indices_from(Rd)] += 4.0
    state.freeze(layout.dims)
    state.update(layout, 0.1 * rng.normal(size=layout.size))
    window = Window(0, 0, state, SquareRootInformation(layout, np.asfortranarray(Rd)))
    window.kept_points = window.last_points = np.array([9]), rng.normal(size=(1, 3))
    motion = gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([3.0, -2.0, 1.0]))
    other = moved(window, motion)

    expected = motion.compose(state.estimate.atPose3(X(0)))
    assert other.state.estimate.atPose3(X(0)).equals(expected, 1e-12)
    turn = motion.rotation().matrix()
    before, after = window.current(window.prior), other.current(other.prior)
    assert before.covariance is not None
    T = np.eye(15)
    T[6:9, 6:9] = turn
    np.testing.assert_allclose(after.covariance, T @ before.covariance @ T.T, atol=1e-12)
    np.testing.assert_allclose(after.velocity, turn @ before.velocity, atol=1e-12)
    seen = [
        w.state.estimate.atPose3(X(0)).transformTo(w.state.estimate.atPoint3(L(7)))
        for w in (window, other)
    ]
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-12)
    for ids, points in (other.kept_points, other.last_points):
        assert ids.tolist() == [9]
        there = motion.transformFrom(window.kept_points[1][0])
        np.testing.assert_allclose(points, [there], atol=1e-12)
    costs = [
        float(np.sum((w.prior.R @ w.state.offset(layout) - w.prior.d) ** 2))
        for w in (window, other)
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)


def of_velocity(seconds: float, sigma: float) -> NavState:
    """A state whose velocity is known to so many m/s."""
    covariance = np.diag(np.repeat([1e-6, 1e-6, sigma**2, 1e-6, 1e-6], 3))
    zero = np.zeros(3)
    return NavState(
        round(seconds * 1e9),
        gtsam.Pose3(),
        zero,
        gyro_bias=zero,
        accel_bias=zero,
        covariance=covariance,
    )


def test_a_velocity_that_stays_unknown_after_missing_samples_is_a_loss() -> None:
    """From the last state before they were missing on."""
    bridging = Bridging()
    for k, (sigma, missed) in enumerate([(0.01, False), (1.0, True), (2.0, True), (2.0, False)]):
        bridging.check(of_velocity(0.1 * k, sigma), missed)
    assert bridging.agreed_until() is None  # another loss keeps its own time
    for k in (4, 5):
        bridging.check(of_velocity(0.1 * k, 2.0), False)
    with pytest.raises(DivergenceError, match="do not tell the velocity"):
        bridging.check(of_velocity(0.6, 2.0), False)
    assert len(bridging) == 1
    assert bridging.agreed_until() == 0


@pytest.mark.parametrize("before", [0.01, 1.0])
def test_a_velocity_known_soon_or_as_well_as_before_is_none(before: float) -> None:
    bridging = Bridging()
    bridging.check(of_velocity(0.0, before), False)
    for k in range(1, 30):  # samples are missing again and again
        bridging.check(of_velocity(0.1 * k, 2.0 if k % 3 == 1 else before), k % 3 == 1)
    assert len(bridging) == 0
