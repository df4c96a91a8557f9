# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One camera that takes off: the first motion is solved again once it tells the scale."""

from pathlib import Path

import numpy as np
import pytest

import slam_graph as sg
from slam_graph.backend.initialization.take_off import TakeOff
from slam_graph.evaluation import nees_of_run
from slam_graph.simulation.simulated_sequence import SimulatedSequence


def error_and_nees(sequence: SimulatedSequence) -> tuple[float, float]:
    """Error of the causal position (m), and its mean NEES."""
    settings = ["backend.initialization.mode=static", "final_ba.enabled=false"]
    run = sg.run(sequence, algorithm="msckf", overrides=settings)
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


def test_the_world_and_the_states_before_stay() -> None:
    """The state at the solution is within its own and the filter's covariance of that before."""
    sequence = sg.simulate(
        trajectory="figure8", cameras=1, rate_hz=10, duration_s=4, seed=2, tracks={"features": 80}
    )
    told = sg.load_config("msckf", ["backend.initialization.mode=static"])
    estimator = sg.Estimator(sequence.rig, told.algorithm, told.backend)
    states = []
    for packet in sequence.packets():
        estimator.add_imu(packet.imu)
        doubtful = estimator.start_is_doubtful
        state = estimator.add_frame(packet.frame)
        assert estimator.replayed is None
        if state is not None:
            states.append((state, doubtful, estimator.window.frame if estimator.window else 0))
    numbers = np.array([number for _, _, number in states])
    (solved,) = np.flatnonzero(np.diff(numbers) != 1) + 1  # numbered anew, once
    assert states[solved][1]
    assert not states[-1][1]
    (before, *_), (after, *_) = states[solved - 1 : solved + 1]
    assert before.covariance is not None
    assert after.covariance is not None
    seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
    way = after.world_T_body.translation() - before.world_T_body.translation()
    jump = way - 0.5 * seconds * (before.velocity + after.velocity)
    sigma = np.sqrt(np.trace(before.covariance[3:6, 3:6]) + np.trace(after.covariance[3:6, 3:6]))
    assert np.linalg.norm(jump) < 4.0 * sigma
