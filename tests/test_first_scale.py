# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""When the images of one camera are used first: after a given state."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from gtsam.symbol_shorthand import X

import slam_graph as sg
from slam_graph.backend.cost.first_scale import images_wait
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.backend.window import Window

SECOND_NS = 1_000_000_000


def nav_state(number: int, position: list[float], turn: float) -> sg.NavState:
    pose = gtsam.Pose3(gtsam.Rot3.Rz(turn), np.array(position))
    biases = {"accel_bias": np.zeros(3), "gyro_bias": np.zeros(3)}
    return sg.NavState(number * SECOND_NS, pose, np.zeros(3), **biases)


def window_of(way: list[float]) -> Window:
    """Two poses; the platform has turned between them. Images wait for 15 s at most."""
    state = State()
    state.insert_imu_state(0, nav_state(0, [0.0, 0.0, 0.0], 0.3))
    state.insert_imu_state(1, nav_state(1, way, 1.0))
    prior = SquareRootInformation.empty()
    return Window(1, SECOND_NS, state, prior, past=[0], images_wait_until_ns=15 * SECOND_NS)


def known_to(sigma: float) -> SquareRootInformation:
    """Poses whose distance is known to `sigma` (m) on each axis, and their place to a kilometre."""
    J = np.zeros((6, 12))  # of (p0, p1 - p0) by the poses in their own frames
    R0, R1 = (gtsam.Rot3.Rz(turn).matrix() for turn in (0.3, 1.0))
    J[:3, 3:6], J[3:, 3:6], J[3:, 9:12] = R0, -R0, R1
    rows = J / np.repeat([1e3, sigma], 3)[:, None]
    turns = 1e3 * np.eye(12)[[0, 1, 2, 6, 7, 8]]
    R = np.linalg.qr(np.vstack([rows, turns]), mode="r")
    Rd = np.zeros((13, 13), order="F")
    Rd[:-1, :-1] = R
    return SquareRootInformation(Layout(dims_of([X(0), X(1)])), Rd)


@pytest.mark.parametrize(("sigma", "wait"), [(0.8, False), (1.2, True)])
def test_it_is_the_way_that_must_be_known_and_not_the_place(sigma: float, wait: bool) -> None:
    window = window_of([0.6, 0.8, 0.0])
    assert images_wait(window, window.state, known_to(sigma)) == wait


def test_images_that_are_used_once_are_used_from_then_on() -> None:
    sequence = sg.simulate(duration_s=3.0, rate_hz=10, cameras=1, tracks={"features": 40})
    told, waits = sg.load_config("msckf"), []
    estimator = sg.Estimator(sequence.rig, told.algorithm, told.backend)
    estimator.start(sequence.initial_state())
    for packet in sequence.packets():
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        assert estimator.window is not None
        waits.append(estimator.window.images_wait_until_ns is not None)
    assert waits[0]
    assert not waits[-1]
    assert waits == sorted(waits, reverse=True)


def test_they_do_not_wait_for_ever() -> None:
    window = window_of([0.0, 0.0, 0.01])
    for seconds, wait in [(1, True), (14, True), (15, False), (16, False)]:
        window.stamp_ns = seconds * SECOND_NS
        assert images_wait(window, window.state, known_to(1.0)) == wait


def first_window(speed: float, cameras: int = 1, algorithm: str = "msckf", **sim: object) -> Window:
    """That of an estimator which is given a state with a σ of the velocity of 0.02 m/s."""
    sequence = sg.simulate(duration_s=0.5, rate_hz=10, cameras=cameras, **sim)
    told = sg.load_config(algorithm)
    estimator = sg.Estimator(sequence.rig, told.algorithm, told.backend)
    given = replace(sequence.initial_state(), velocity=np.array([0.0, speed, 0.0]))
    estimator.start(given)
    assert estimator.window is not None
    assert estimator.start_is_doubtful == (estimator.window.images_wait_until_ns is not None)
    return estimator.window


def test_a_given_state_of_one_camera_that_hardly_moves_lets_images_wait() -> None:
    assert first_window(0.05).images_wait_until_ns is not None
    assert first_window(0.5).images_wait_until_ns is None, "the velocity tells the scale"
    assert first_window(0.05, cameras=2).images_wait_until_ns is None
    assert first_window(0.05, algorithm="fixed_lag_isam2").images_wait_until_ns is None


@pytest.mark.slow
@pytest.mark.data
def test_a_given_state_that_hovers_before_it_moves(data_dir: Path) -> None:
    """A hand moves the camera by 20 mm in five seconds; images must not make it a metre."""
    sequence = sg.simulate(
        trajectory=data_dir / "tumvi_inertial" / "room1",
        real_imu=True,
        cameras=1,
        rate_hz=10,
        duration_s=12,
        seed=1,
        tracks={"features": 80},
    )
    run = sg.run(sequence, algorithm="swf", overrides=["final_ba.enabled=false", BELIEVED])
    assert run.status == "ok"
    assert len(run.segments) == 1
    assert "start_corrected" not in run.warnings
    assert run.groundtruth is not None
    errors = sg.ape(run.groundtruth, run.trajectory, alignment="none").values
    hovering = run.trajectory.stamps_ns - run.trajectory.stamps_ns[0] < 5 * SECOND_NS
    assert np.max(errors[hovering]) < 0.1
    assert np.max(errors[-40:]) < 0.05
