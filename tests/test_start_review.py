# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A start is compared with what follows it, and may do without a metre scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import from_given_state

from slam_graph.backend import Estimator
from slam_graph.backend.cost.adaptive_imu_noise import DynamicsNoise
from slam_graph.backend.initialization import start_review
from slam_graph.backend.initialization.start_review import StartReview, contradict
from slam_graph.backend.initialization.take_off import TakeOff
from slam_graph.backend.window import Window
from slam_graph.config import load_config
from slam_graph.evaluation import ape
from slam_graph.geometry import NavState, StateHistory
from slam_graph.sensors import FeatureFrame
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

DRAWS = 2000
SECOND_NS = 1_000_000_000
WRONG = np.array([0.6, -0.4, 0.3])
"""Error of a velocity, m/s."""


def drawn(truth: NavState, covariance: np.ndarray, rng: np.random.Generator) -> NavState:
    """An estimate with an error of this covariance, in a world of its own."""
    error = rng.multivariate_normal(np.zeros(15), covariance)
    world = gtsam.Pose3(gtsam.Rot3.Yaw(rng.uniform(-3.0, 3.0)), rng.normal(size=3))
    pose = world.compose(truth.world_T_body.retract(error[:6]))
    velocity = world.rotation().rotate(truth.velocity + error[6:9])
    J = np.eye(15)
    J[6:9, 6:9] = world.rotation().matrix()
    return replace(truth, world_T_body=pose, velocity=velocity, covariance=J @ covariance @ J.T)


def test_estimates_with_their_own_errors_seldom_contradict() -> None:
    """One pair in 10000, in worlds that differ in position and yaw; a velocity that is off does."""
    rng = np.random.default_rng(3)
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.5, 1.0), np.array([1.0, 2.0, 3.0]))
    biases = {"accel_bias": np.zeros(3), "gyro_bias": np.zeros(3)}
    truth = NavState(0, pose, np.array([1.0, -0.5, 0.2]), **biases)
    A, B = (0.02 * rng.normal(size=(15, 15)) for _ in range(2))
    P, Q = (M @ M.T + 1e-6 * np.eye(15) for M in (A, B))
    pairs = [(drawn(truth, P, rng), drawn(truth, Q, rng)) for _ in range(DRAWS)]
    assert sum(contradict(one, other) for one, other in pairs) <= 2
    one, other = pairs[0]
    assert contradict(one, replace(other, velocity=other.velocity + 5.0))


MOTION = ["backend.initialization.mode=motion", "backend.initialization.check_calibration=false"]
CAMERA = {"cameras": 1, "rate_hz": 20.0, "tracks": {"features": 100, "pixel_sigma": 1.0}}
MOVING = CAMERA | {"flight": {"hover_s": 0.0}}


def flown(
    sequence: SimulatedSequence,
    overrides: list[str],
    review: bool = False,
    late_ns: int = 0,
) -> tuple[Estimator, StateHistory, tuple[NavState, NavState] | None]:
    """States of a run, and where a review doubts a state of wrong velocity, the right one and its
    own."""
    config = load_config(algorithm="msckf", overrides=overrides)
    estimator, history = Estimator(sequence.rig, config.algorithm, config.backend), StateHistory()
    checked: StartReview | None = None
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        stamped = FeatureFrame(packet.frame.stamp_ns - late_ns, packet.frame.cameras)
        state = estimator.add_frame(stamped)
        if estimator.replayed is not None:
            history = StateHistory()
        for known in estimator.states:
            history.append(known)
        if state is None:
            continue
        if review and checked is None:
            checked = StartReview(estimator._context, state.stamp_ns, 0.01)
        elif checked is not None:
            wrong = replace(state, velocity=state.velocity + WRONG)
            window = checked.better(state.stamp_ns, packet.frame, wrong)
            if window is not None:
                return estimator, history, (state, window.current(window.prior))
    return estimator, history, None


def test_a_wrong_velocity_is_contradicted_by_the_frames_that_follow() -> None:
    sequence = simulate(trajectory="figure8", duration_s=9.0, seed=5, **MOVING)
    estimator, _, doubted = flown(sequence, MOTION, review=True)
    assert doubted is not None
    body = [state.world_T_body.rotation().unrotate(state.velocity) for state in doubted]
    assert np.linalg.norm(body[0] - body[1]) < 0.1 * np.linalg.norm(WRONG)
    assert "start_corrected" in estimator.diagnostics.counts


def test_the_run_goes_on_from_the_new_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the start was right: the states before are superseded, and those after it fit.

    What vibration adds to the covariance begins anew with the world.
    """
    monkeypatch.setattr(start_review, "contradict", lambda *_: True)
    monkeypatch.setattr(DynamicsNoise, "_is_vibrating", lambda *_: True)
    sequence = simulate(trajectory="figure8", duration_s=9.0, seed=5, **MOVING)
    estimator, history, _ = flown(sequence, MOTION)
    assert estimator.diagnostics.counts["start_corrected"] == 1
    error = ape(sequence.groundtruth(), history.trajectory(), alignment="se3")
    assert error.statistics.rmse < 0.05
    assert np.max(history.sigmas()[:, 6:9]) < 0.1


def test_what_moves_is_known_after_a_review_unless_only_the_start_said_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A feature that did not fit a wrong start may be static."""
    sequence = simulate(trajectory="figure8", duration_s=1.0, seed=5, rate_hz=10.0)
    *_, estimator = from_given_state(sequence, "msckf")
    window, start_up = estimator.window, estimator._start_up
    assert window is not None

    def corrected(*_: object) -> Window:
        start_up.outliers, start_up.contradicted = np.array([4, 8]), True
        return window

    start_up.outliers, start_up.doubtful = np.array([2]), True
    estimator.exclude(np.array([2, 4, 6]))
    monkeypatch.setattr(start_up, "better", corrected)
    (*_, packet) = sequence.packets()
    assert isinstance(packet.frame, FeatureFrame)
    state = estimator._reviewed(packet.frame, window.current(window.prior), False)
    assert estimator.replayed == [state]
    assert estimator.dynamic.tolist() == [4, 6, 8]


@pytest.mark.slow
def test_so_it_does_where_frames_wait_for_the_imu(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a time offset that the start has found, a frame may lead to several states or none."""
    monkeypatch.setattr(start_review, "contradict", lambda *_: True)
    sequence = simulate(trajectory="figure8", duration_s=10.0, seed=5, **MOVING)
    estimator, history, _ = flown(sequence, MOTION[:1], late_ns=40_000_000)
    counts = estimator.diagnostics.counts
    assert counts["calibration_corrected"] == 1
    assert counts["start_corrected"] >= 1
    trajectory = history.trajectory()
    assert np.all(np.diff(trajectory.stamps_ns) > 0)
    error = ape(sequence.groundtruth(), trajectory, alignment="se3")
    assert error.statistics.rmse < 0.05


@pytest.mark.slow
def test_a_start_without_a_metre_scale_is_a_choice() -> None:
    """It comes earlier, says that the scale is not known, and the scale is right in the end."""
    sequence = simulate(trajectory="random", duration_s=16.0, seed=6, **CAMERA)
    _, waited, _ = flown(sequence, MOTION)
    go_on = [*MOTION, "backend.initialization.unknown_scale=go_on"]
    estimator, went_on, _ = flown(sequence, go_on)
    assert estimator.diagnostics.counts["scale_unknown"] == 1
    assert went_on.trajectory().stamps_ns[0] < waited.trajectory().stamps_ns[0] - SECOND_NS
    late = went_on.trajectory()
    late = late.select(late.stamps_ns > late.stamps_ns[-1] - 5 * SECOND_NS)
    scale = ape(sequence.groundtruth(), late, alignment="sim3").similarity.scale
    assert abs(scale - 1.0) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("solved", [True, False])
def test_a_start_from_standstill_that_moves_off_slowly_is_corrected(
    solved: bool, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One camera says nothing for 1.5 s, and the first step of its features comes from far away.

    The first motion is solved again. Where that is given up, the review acts.
    """

    def gives_up(take_off: TakeOff, *_: object) -> None:
        take_off.done = True

    if not solved:
        monkeypatch.setattr(TakeOff, "solved", gives_up)
    handheld = {"tracks": {"features": 150, "pixel_sigma": 1.0}, "seed": 1}
    path = str(data_dir / "tumvi_inertial/room1")
    sequence = simulate(trajectory=path, cameras=1, duration_s=12.0, rate_hz=20.0, **handheld)
    estimator, history, _ = flown(sequence, [])
    assert estimator.diagnostics.counts["start_corrected"] == 1
    late = history.trajectory()
    late = late.select(late.stamps_ns > late.stamps_ns[-1] - 6 * SECOND_NS)
    error = ape(sequence.groundtruth(), late, alignment="sim3")
    assert abs(error.similarity.scale - 1.0) < 0.01
    assert error.statistics.rmse < 0.01


@pytest.mark.slow
def test_images_that_are_lost_later_do_not_bring_the_start_in_doubt() -> None:
    """Without features the velocity becomes unknown, long after the start was confirmed."""
    sequence = simulate(trajectory="figure8", duration_s=16.0, seed=5, **CAMERA)
    config = load_config(algorithm="msckf", overrides=["backend.noise.imu_scale=10"])
    estimator = Estimator(sequence.rig, config.algorithm, config.backend)
    sigmas = []
    for packet in sequence.packets():
        frame = packet.frame
        assert isinstance(frame, FeatureFrame)
        if 9.0 < frame.stamp_ns * 1e-9 < 12.0:
            frame = frame.without(frame.cameras[0].ids)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(frame)
        if state is not None and state.covariance is not None and frame.stamp_ns > 9 * SECOND_NS:
            sigmas.append(float(np.sqrt(np.max(np.diag(state.covariance)[6:9]))))
    assert max(sigmas) > start_review._UNKNOWN_VELOCITY
    assert estimator.diagnostics.counts["start_corrected"] == 0
