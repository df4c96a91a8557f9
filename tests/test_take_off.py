# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One camera that takes off: the first motion is solved again once it tells the scale."""

from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED

import slam_graph as sg
from slam_graph.backend.initialization.take_off import RETRY_S, TakeOff, retry_s, tells_scale
from slam_graph.evaluation import nees_of_run
from slam_graph.simulation.simulated_sequence import SimulatedSequence

STATIC = ["backend.initialization.mode=static", BELIEVED]


def error_and_nees(sequence: SimulatedSequence) -> tuple[float, float]:
    """Error of the causal position (m), and its mean NEES."""
    overrides = [*STATIC, "final_ba.enabled=false"]
    run = sg.run(sequence, algorithm="msckf", overrides=overrides)
    assert run.status == "ok"
    assert run.groundtruth is not None
    error = sg.ape(run.groundtruth, run.trajectory, alignment="yaw").statistics.rmse
    found, _ = nees_of_run(run.groundtruth, run.history, False, None)
    return error, float(np.mean(found.position))


@pytest.mark.data
def test_what_was_linearised_far_from_the_scale_is_solved_again(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error falls, and the covariance fits it better, than without."""
    slow = sg.simulate(
        trajectory=data_dir / "euroc_inertial" / "V2_01_easy",
        real_imu=True,
        cameras=1,
        rate_hz=20,
        duration_s=9,
        seed=5,
        tracks={"features": 150},
    )
    error_m, nees = error_and_nees(slow)
    monkeypatch.setattr(TakeOff, "solved", lambda self, *args: None)
    without_m, nees_without = error_and_nees(slow)
    assert error_m < 0.8 * without_m
    assert nees < 0.7 * nees_without


def lift(**settings: object) -> SimulatedSequence:
    """A flight of one camera that begins at rest."""
    few = {"features": 80}
    return sg.simulate(trajectory="figure8", cameras=1, rate_hz=10, seed=2, tracks=few, **settings)


@dataclass
class Lifted:
    """What an estimator gave for each frame.

    Attributes:
        states: those that it reported.
        solved: number of the state at which the first motion was solved again.
        features: number of features in the state there.
        doubtful: whether the start was doubtful before each.
    """

    states: list[sg.NavState] = field(default_factory=list)
    solved: int | None = None
    features: int = 0
    doubtful: list[bool] = field(default_factory=list)


def lifted(
    estimator: sg.Estimator, sequence: SimulatedSequence, blank_s: tuple[float, ...] = ()
) -> Lifted:
    """Run an estimator, and look for the frame from which its window is numbered anew."""
    found, before = Lifted(), -1
    for packet in sequence.packets():
        frame = packet.frame
        seconds = (frame.stamp_ns - sequence.groundtruth().stamps_ns[0]) * 1e-9
        if any(abs(seconds - blank) < 0.01 for blank in blank_s):
            frame = frame.without(frame.cameras[0].ids)
        estimator.add_imu(packet.imu)
        found.doubtful.append(estimator.start_is_doubtful)
        state = estimator.add_frame(frame)
        assert estimator.replayed is None
        if state is None:
            continue
        window = estimator.window
        assert window is not None
        if window.frame <= before:
            assert found.solved is None, "once"
            found.solved, found.features = len(found.states), len(window.state_features)
        before = window.frame
        found.states.append(state)
    return found


def estimator_for(sequence: SimulatedSequence, algorithm: str = "msckf") -> sg.Estimator:
    told = sg.load_config(algorithm, STATIC)
    return sg.Estimator(sequence.rig, told.algorithm, told.backend)


def test_the_world_and_the_states_before_stay() -> None:
    """The state at the solution is within its own and the filter's covariance of that before."""
    sequence = lift(duration_s=5)
    found = lifted(estimator_for(sequence), sequence)
    assert found.solved is not None
    assert not found.doubtful[-1]
    before, after = found.states[found.solved - 1 : found.solved + 1]
    assert before.covariance is not None
    assert after.covariance is not None
    seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
    way = after.world_T_body.translation() - before.world_T_body.translation()
    jump = way - 0.5 * seconds * (before.velocity + after.velocity)
    sigma = np.sqrt(np.trace(before.covariance[3:6, 3:6]) + np.trace(after.covariance[3:6, 3:6]))
    assert np.linalg.norm(jump) < 4.0 * sigma


def test_a_frame_without_features_is_not_what_the_window_begins_with() -> None:
    sequence = lift(duration_s=4)
    plain = lifted(estimator_for(sequence), sequence)
    assert plain.solved is not None
    stamp_ns = plain.states[plain.solved].stamp_ns
    at_s = (stamp_ns - int(sequence.groundtruth().stamps_ns[0])) * 1e-9
    found = lifted(estimator_for(sequence), sequence, (at_s, at_s + 0.1))
    assert found.solved is not None
    assert found.features >= 15


def test_features_that_are_known_to_move_stay_so() -> None:
    sequence = lift(duration_s=4)
    estimator = estimator_for(sequence)
    views = [packet.frame.cameras[0].ids for packet in sequence.packets()]
    moving = views[0][:20]
    estimator.exclude(moving)
    assert lifted(estimator, sequence).solved is not None
    tracked = np.intersect1d(moving, views[-1])
    assert len(tracked)
    assert np.isin(tracked, estimator.dynamic).all()


def test_smoothers_are_left_alone() -> None:
    sequence = lift(duration_s=4)
    assert lifted(estimator_for(sequence, "fixed_lag_isam2"), sequence).solved is None


@pytest.mark.slow
def test_states_before_stay_where_fixes_tell_the_world(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = lift(duration_s=10, gnss={"sigma_m": 0.05})
    overrides = [*STATIC, "final_ba.enabled=false"]
    result = sg.run(sequence, algorithm="msckf", overrides=overrides)
    monkeypatch.setattr(TakeOff, "solved", lambda *_: None)
    without = sg.run(sequence, algorithm="msckf", overrides=overrides)
    assert result.georeferenced
    assert len(result.trajectory) == len(without.trajectory)


@pytest.mark.parametrize("missing", [1.2, 3.0, 16.0, 200.0])
@pytest.mark.parametrize("elapsed_s", [1.0, 2.5])
def test_an_attempt_follows_as_soon_as_the_scale_can_be_known(
    elapsed_s: float, missing: float
) -> None:
    """Where its deviation falls with the fourth power of time, and not a whole retry before."""
    known_s = elapsed_s * missing**0.25 - elapsed_s
    waited_s = retry_s(elapsed_s, missing)
    assert waited_s <= max(known_s, RETRY_S)
    assert waited_s >= known_s - RETRY_S - 1e-9  # rounding


def test_attempts_become_rare_as_the_platform_hovers() -> None:
    assert retry_s(12.0, float("inf")) == pytest.approx(3.0 * RETRY_S)


@pytest.mark.parametrize(("speed", "known"), [(0.0, False), (0.15, False), (0.3, True)])
def test_a_velocity_tells_the_scale_if_it_is_known_well(speed: float, known: bool) -> None:
    covariance = np.diag(np.repeat([1e-3, 1e-3, 0.02, 0.1, 0.01], 3) ** 2)
    velocity = np.array([0.0, speed, 0.0])
    biases = {"accel_bias": np.zeros(3), "gyro_bias": np.zeros(3)}
    state = sg.NavState(0, gtsam.Pose3(), velocity, **biases, covariance=covariance)
    assert tells_scale(state) == known


def test_without_a_deviation_or_with_one_that_is_small_the_next_attempt_is_soon() -> None:
    assert retry_s(3.0, float("inf")) == RETRY_S
    assert retry_s(3.0, 0.5) == RETRY_S
