# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""First-estimates Jacobians keep the prior from knowing what no measurement can see.

Cameras and IMU do not see where the world's origin is, nor its heading (Kelly & Sukhatme 2011). A
change of these four moves every variable in a known direction, and along these directions the
information of the prior can only be lost, never gained.
"""

from collections.abc import Iterator

import gtsam
import numpy as np
import pytest
from flight import Flight, packets, rig, room
from groups import slow
from gtsam.symbol_shorthand import X
from scipy.linalg import eigh

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, InitializationConfig
from slam_graph.backend.cost import construction
from slam_graph.backend.cost.construction import ConstructedCost, CostConstruction
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.engine import SquareRootEngine
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.marginalization.marginalize import unobservable_directions
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.backend.window import Window
from slam_graph.config import load_config
from slam_graph.sensors.measurements import FeatureFrame

CONFIG = BackendConfig(
    initialization=InitializationConfig(mode="given", fix_gauge=False, check_calibration=False)
)
WEAK = np.array([0.1, 0.5, 0.3, 0.1, 0.02])


def claimed_information(estimator: Estimator) -> FloatArray:
    """Information (4, 4) of the prior on the position and heading of the world."""
    assert estimator.window is not None
    prior = estimator.window.prior
    rows = prior.R @ unobservable_directions(estimator.window.state.first, prior.layout)
    return rows.T @ rows


def claims_over_time(
    name: str, first_estimates: bool, cameras: int, duration_s: float = 3.0
) -> list[float]:
    """After each frame, the largest factor by which a claim exceeds that of the start."""
    rng = np.random.default_rng(2)
    algorithm: AlgorithmConfig = load_config(
        algorithm=name,
        overrides=[f"algorithm.marginalization.first_estimates={str(first_estimates).lower()}"],
    ).algorithm
    flight, mounted = Flight(), rig(cameras)
    estimator = Estimator(mounted, algorithm, CONFIG)
    estimator.start(flight.nav_state(0.0, WEAK))
    start = claimed_information(estimator)
    growth = []
    for packet in packets(flight, mounted, room(250, rng), duration_s, rng):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        assert estimator.add_frame(packet.frame) is not None
        growth.append(float(eigh(claimed_information(estimator), start, eigvals_only=True)[-1]))
    assert estimator.window is not None
    kinds = {chr(gtsam.Symbol(key).chr()) for key in estimator.window.prior.layout.dims}
    assert kinds >= {"x", "v", "b"}
    assert estimator.window.prior.layout.size > 40
    return growth


@pytest.mark.parametrize(
    ("name", "cameras"),
    [
        *((name, 2) for name in ("ekf", "iekf", "msckf", "swf", "okvis")),
        *(("msckf", 1), ("okvis", 1), slow("ekf", 1), slow("iekf", 1), slow("swf", 1)),
    ],
)
def test_with_first_estimates_nothing_unseen_is_claimed(name: str, cameras: int) -> None:
    assert max(claims_over_time(name, True, cameras)) < 1.0 + 1e-6


def seen_of_the_unobservable(cost: Cost) -> float:
    """The largest derivative along the four directions, relative to the largest of all."""
    linear, layout = cost.linearize(summed=True), cost.layout()
    A = np.concatenate([cost.factor_rows(layout), *cost.rows(linear, layout)])[:, :-1]
    directions = unobservable_directions(cost.state.first, layout)
    return float(np.abs(A @ directions).max() / np.abs(A).max())


def test_no_row_sees_these_directions_wherever_a_step_leads() -> None:
    """A feature that becomes a variable is linearised where its first estimate is.

    Damped steps do not end where the cost is least, so any step will do.
    """
    more = ["algorithm.cost.max_state_features=20", "algorithm.cost.state_feature_frames=5"]
    algorithm: AlgorithmConfig = load_config(algorithm="okvis", overrides=more).algorithm
    rng, flight, mounted = np.random.default_rng(2), Flight(), rig(2)
    estimator = Estimator(mounted, algorithm, CONFIG)
    estimator.start(flight.nav_state(0.0, WEAK))
    entered = 0
    for packet in packets(flight, mounted, room(250, rng), 1.5, rng):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        assert estimator.add_frame(packet.frame) is not None
        engine = estimator._engine
        assert isinstance(engine, SquareRootEngine)
        if engine._cost is None or engine._cost.tracks is None:  # the start
            continue
        everything = np.ones(len(engine._cost.tracks.points), np.bool_)
        cost = engine._cost.part(engine._cost.factors, everything)
        cost.state = cost.state.copy()
        assert cost.tracks is not None
        entered += int(np.sum(cost.tracks.in_state))
        linear, layout = cost.linearize(summed=True), cost.layout()
        cost.apply(1e-3 * rng.standard_normal(layout.size), linear, layout)
        assert seen_of_the_unobservable(cost) < 1e-7
    assert entered > 5


def test_without_first_estimates_the_claims_grow() -> None:
    growth = claims_over_time("msckf", False, 1, 6.0)
    assert growth[0] < 1.0 + 1e-6
    assert growth[-1] > 10.0
    assert claims_over_time("ekf", False, 2)[-1] > 2.0


def test_the_dynamics_do_not_see_these_directions() -> None:
    """The law behind the tests above, at values that do not fit the measurements."""
    flight = Flight()
    params = rig().imu.preintegration_params(9.81)
    pim = flight.imu(0.0, 0.3).preintegrated(gtsam.imuBias.ConstantBias(), params)
    state = State()
    state.insert_imu_state(0, flight.nav_state(0.2))
    state.insert_imu_state(1, flight.nav_state(0.7))
    jacobian = gtsam.JacobianFactor(imu_factor(0, 1, pim).linearize(state.first))
    layout = Layout(dims_of(jacobian.keys()))
    A, b = jacobian.jacobian()
    assert np.linalg.norm(b) > 100.0
    change = A @ unobservable_directions(state.first, layout)
    np.testing.assert_allclose(change, 0.0, atol=1e-9 * np.abs(A).max())


def moved_shares(monkeypatch: pytest.MonkeyPatch, largest: float) -> Iterator[FloatArray]:
    """How far measured features of the state are from their first estimates, over their distance.

    Frame by frame. The camera flies towards points, one after the other, and past them.
    """
    monkeypatch.setattr(construction, "MAX_MOVED", largest)
    shares: list[FloatArray] = []
    construct = CostConstruction.construct

    def kept(self: CostConstruction, window: Window, still: bool) -> ConstructedCost:
        constructed = construct(self, window, still)
        measured, state = constructed.cost.landmarks, window.state
        if measured is not None:
            points = state.positions_of(measured.ids)
            body = state.frames.atPose3(X(window.frame))
            away = points - body.compose(rig().cameras[0].body_T_camera).translation()
            moved = points - state.positions_of(measured.ids, first=True)
            shares.append(np.linalg.norm(moved, axis=1) / np.linalg.norm(away, axis=1))
        return constructed

    monkeypatch.setattr(CostConstruction, "construct", kept)
    settings = ["algorithm.cost.state_feature_depth_error=0.3"]
    algorithm: AlgorithmConfig = load_config(algorithm="msckf", overrides=settings).algorithm
    rng, mounted = np.random.default_rng(2), rig()
    flight = Flight(position=np.array([2.5, 0.3, 0.2]), position_rate=np.array([0.9, 1.7, 2.3]))
    near = rng.uniform([-2.0, -0.3, -0.3], [3.0, 0.3, 0.3], (40, 3))
    points = np.concatenate([near, room(250, rng)])
    noise = CONFIG.noise.model_copy(update={"pixel_sigma": 3.0})
    estimator = Estimator(mounted, algorithm, CONFIG.model_copy(update={"noise": noise}))
    estimator.start(flight.nav_state(0.0, WEAK))
    for packet in packets(flight, mounted, points, 3.5, rng, 20.0, sigma_px=3.0):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        assert estimator.add_frame(packet.frame) is not None
        yield from shares
        shares.clear()


def test_what_has_moved_far_from_its_first_estimate_is_not_measured_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its Jacobian would be that of another distance, and turn the platform."""
    assert any(np.any(share > 0.5) for share in moved_shares(monkeypatch, np.inf))
    monkeypatch.undo()
    shares = np.concatenate(list(moved_shares(monkeypatch, construction.MAX_MOVED)))
    assert 0.0 < shares.max() <= 0.5
