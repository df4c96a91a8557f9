# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""When the images of one camera are used first: once its way is longer than its σ."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

import slam_graph as sg
from slam_graph.backend.cost.first_scale import FirstScale
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.backend.window import Window

SECOND_NS = 1_000_000_000


def nav_state(number: int, position: list[float], turn: float) -> sg.NavState:
    pose = gtsam.Pose3(gtsam.Rot3.Rz(turn), np.array(position))
    biases = {"accel_bias": np.zeros(3), "gyro_bias": np.zeros(3)}
    return sg.NavState(number * SECOND_NS, pose, np.zeros(3), **biases)


def window_of(way: list[float], stamp_ns: int = SECOND_NS) -> Window:
    """Two poses; the platform has turned between them."""
    state = State()
    state.insert_imu_state(0, nav_state(0, [0.0, 0.0, 0.0], 0.3))
    state.insert_imu_state(1, nav_state(1, way, 1.0))
    return Window(1, stamp_ns, state, SquareRootInformation.empty(), past=[0])


def known_to(sigma: float, drifting: float = 1e3) -> SquareRootInformation:
    """Poses whose distance is known to `sigma` (m) on each axis, and where they are together not.

    The positions of both in the world are p0 = a and p1 = a + way, with σ `drifting` of a.
    """
    J = np.zeros((6, 12))  # of (p0, p1 - p0) by the poses in their own frames
    R0, R1 = (gtsam.Rot3.Rz(turn).matrix() for turn in (0.3, 1.0))
    J[:3, 3:6], J[3:, 3:6], J[3:, 9:12] = R0, -R0, R1
    rows = J / np.repeat([drifting, sigma], 3)[:, None]
    turns = 1e3 * np.eye(12)[[0, 1, 2, 6, 7, 8]]
    R = np.linalg.qr(np.vstack([rows, turns]), mode="r")
    Rd = np.zeros((13, 13), order="F")
    Rd[:-1, :-1] = R
    return SquareRootInformation(Layout(dims_of([X(0), X(1)])), Rd)


@pytest.mark.parametrize(("sigma", "used"), [(0.8, True), (1.2, False)])
def test_it_is_the_way_that_must_be_known_and_not_the_place(sigma: float, used: bool) -> None:
    window = window_of([0.6, 0.8, 0.0])
    assert FirstScale(known=False).known(window, window.state, known_to(sigma)) == used


def test_two_cameras_or_a_feature_of_the_state_tell_it() -> None:
    window = window_of([0.0, 0.0, 0.01])
    assert FirstScale(known=True).known(window, window.state, known_to(1.0))
    scale = FirstScale(known=False)
    assert not scale.known(window, window.state, known_to(1.0))
    window.state_features = np.array([7])
    assert scale.known(window, window.state, known_to(1.0))
    window.state_features = np.zeros(0, np.int64)
    assert scale.known(window, window.state, known_to(1.0)), "what was known is not asked again"


def test_it_does_not_wait_for_ever() -> None:
    scale = FirstScale(known=False)
    for seconds, used in [(1, False), (14, False), (17, True)]:
        window = window_of([0.0, 0.0, 0.01], seconds * SECOND_NS)
        assert scale.known(window, window.state, known_to(1.0)) == used


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
    run = sg.run(sequence, algorithm="swf", overrides=["final_ba.enabled=false"])
    assert run.status == "ok"
    assert len(run.segments) == 1
    assert "start_corrected" not in run.warnings
    assert run.groundtruth is not None
    errors = sg.ape(run.groundtruth, run.trajectory, alignment="none").values
    hovering = run.trajectory.stamps_ns - run.trajectory.stamps_ns[0] < 5 * SECOND_NS
    assert np.max(errors[hovering]) < 0.1
    assert np.max(errors[-40:]) < 0.05
