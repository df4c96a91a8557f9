# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bad input: the estimator counts it, goes on with finite states, and finds its way back."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from flight import Flight, packets, rig, room
from groups import slow, slow_but

from slam_graph.arrays import FloatArray
from slam_graph.backend import engine
from slam_graph.backend.backend_config import BackendConfig, InitializationConfig
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.solve.gauss_newton import Minimum, minimize
from slam_graph.config import load_config
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData, Packet

Change = Callable[[list[Packet]], list[Packet]]

FRAME_RATE_HZ = 20.0
FALGORITHM = Flight()
RIG = rig(2)
SURE = np.array([0.01, 0.01, 0.01, 0.05, 0.005])
ALGORITHM = load_config().algorithm
GIVEN = BackendConfig(initialization=InitializationConfig(mode="given", check_calibration=False))


@pytest.fixture(scope="module")
def recording() -> list[Packet]:
    """Five and a half good seconds, in stereo."""
    rng = np.random.default_rng(0)
    return list(packets(FALGORITHM, RIG, room(300, rng), 5.5, rng, FRAME_RATE_HZ))


@dataclass
class Outcome:
    """What came out of a run."""

    states: list[NavState]
    refused: int
    counts: dict[str, int]

    def errors_m(self) -> FloatArray:
        """Position errors over time; the given start defines the world."""
        return np.array(
            [
                np.linalg.norm(
                    s.world_T_body.translation()
                    - FALGORITHM.nav_state(s.stamp_ns * 1e-9).world_T_body.translation()
                )
                for s in self.states
            ]
        )


def fly(recording: list[Packet]) -> Outcome:
    """Run from a given start and check that every state is finite and its covariance positive."""
    estimator = Estimator(RIG, ALGORITHM, GIVEN)
    estimator.start(FALGORITHM.nav_state(0.0, SURE))
    states, refused = [], 0
    for packet in recording:
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
        if state is None:
            refused += 1
            continue
        assert state.covariance is not None
        parts = (state.world_T_body.matrix(), state.velocity, state.gyro_bias, state.accel_bias)
        assert all(np.isfinite(part).all() for part in (*parts, state.covariance))
        assert np.all(np.linalg.eigvalsh(state.covariance) > 0)
        states.append(state)
    return Outcome(states, refused, dict(estimator.diagnostics.counts))


def during(
    start_s: float, end_s: float, change: Callable[[Packet], list[Packet]]
) -> Callable[[list[Packet]], list[Packet]]:
    """Apply a change to the packets of some time."""

    def apply(recording: list[Packet]) -> list[Packet]:
        changed: list[Packet] = []
        for packet in recording:
            inside = start_s - 1e-6 <= packet.frame.stamp_ns * 1e-9 <= end_s + 1e-6
            changed += change(packet) if inside else [packet]
        return changed

    return apply


def observed(packet: Packet) -> tuple[FeatureObservations, ...]:
    assert isinstance(packet.frame, FeatureFrame)
    return packet.frame.cameras


def with_cameras(packet: Packet, cameras: tuple[FeatureObservations, ...]) -> list[Packet]:
    return [Packet(packet.imu, FeatureFrame(packet.frame.stamp_ns, cameras))]


def no_features(packet: Packet) -> list[Packet]:
    return with_cameras(packet, (FeatureObservations.empty(),) * 2)


def no_right(packet: Packet) -> list[Packet]:
    return with_cameras(packet, (observed(packet)[0], FeatureObservations.empty()))


def no_left(packet: Packet) -> list[Packet]:
    return with_cameras(packet, (FeatureObservations.empty(), observed(packet)[1]))


def nan_features(packet: Packet) -> list[Packet]:
    broken = []
    for camera in observed(packet):
        pixels, normalized = camera.pixels.copy(), camera.normalized.copy()
        pixels[::3], normalized[1::4] = np.nan, np.inf
        broken.append(FeatureObservations(camera.ids, pixels, normalized))
    return with_cameras(packet, tuple(broken))


def all_nan(packet: Packet) -> list[Packet]:
    nothing = (
        FeatureObservations(c.ids, c.pixels * np.nan, c.normalized * np.nan)
        for c in observed(packet)
    )
    return with_cameras(packet, tuple(nothing))


def mixed_up(packet: Packet) -> list[Packet]:
    """Ids that belong to other features."""
    rng = np.random.default_rng(packet.frame.stamp_ns)
    wrong = (
        FeatureObservations(rng.permutation(c.ids), c.pixels, c.normalized)
        for c in observed(packet)
    )
    return with_cameras(packet, tuple(wrong))


def twice(packet: Packet) -> list[Packet]:
    return [packet, Packet(ImuData.empty(), packet.frame)]


def no_imu(packet: Packet) -> list[Packet]:
    return [Packet(ImuData.empty(), packet.frame)]


def nan_imu(packet: Packet) -> list[Packet]:
    gyro, accel = packet.imu.gyro.copy(), packet.imu.accel.copy()
    gyro[::5], accel[1::5] = np.nan, np.inf
    return [Packet(ImuData(packet.imu.stamps_ns, gyro, accel), packet.frame)]


def repeated_imu(packet: Packet) -> list[Packet]:
    return [Packet(ImuData.concatenate([packet.imu, packet.imu]), packet.frame)]


def reversed_imu(packet: Packet) -> list[Packet]:
    imu = packet.imu
    backwards = ImuData(imu.stamps_ns[::-1], imu.gyro[::-1], imu.accel[::-1])
    return [Packet(backwards, packet.frame)]


def swapped(recording: list[Packet]) -> list[Packet]:
    """Two frames in the wrong order, with the IMU in the right one."""
    a, b = recording[60:62]
    return [*recording[:60], Packet(a.imu, b.frame), Packet(b.imu, a.frame), *recording[62:]]


def an_old_one_again(recording: list[Packet]) -> list[Packet]:
    return [*recording[:60], Packet(ImuData.empty(), recording[20].frame), *recording[60:]]


def frames_missing(recording: list[Packet]) -> list[Packet]:
    """The IMU goes on for 1.5 s without frames."""
    gone = recording[60:90]
    imu = ImuData.concatenate([p.imu for p in [*gone, recording[90]]])
    return [*recording[:60], Packet(imu, recording[90].frame), *recording[91:]]


CASES: dict[str, tuple[Change, str | None, int]] = {
    "nothing": (lambda recording: recording, None, 0),
    "no features for a second": (during(3.0, 4.0, no_features), None, 0),
    "no right camera": (during(2.0, 4.0, no_right), None, 0),
    "no left camera": (during(2.0, 4.0, no_left), None, 0),
    "never a left camera": (during(0.0, 9.0, no_left), None, 0),
    "some features not finite": (during(2.0, 4.0, nan_features), "feature_not_finite", 41),
    "no feature finite": (during(3.0, 4.0, all_nan), "feature_not_finite", 21),
    "ids mixed up": (during(3.0, 4.0, mixed_up), "feature_rejected_by_gate", 21),
    "frames twice": (during(2.0, 3.0, twice), "frame_out_of_order", 21),
    "frames swapped": (swapped, "frame_out_of_order", 1),
    "an old frame": (an_old_one_again, "frame_out_of_order", 1),
    "frames missing": (frames_missing, None, 0),
    "one frame without IMU": (during(3.0, 3.0, no_imu), None, 0),
    "IMU gap of 0.2 s": (during(3.0, 3.2, no_imu), None, 0),
    "IMU not finite": (during(3.0, 3.3, nan_imu), "imu_rejected", 7),
    "IMU repeated": (during(3.0, 3.3, repeated_imu), "imu_rejected", 7),
    "IMU reversed": (during(3.0, 3.3, reversed_imu), "imu_rejected", 7),
}
"""What is changed, the warning that counts it, and how often it must at least be counted."""


BRIEF = {
    *("nothing", "no right camera", "some features not finite", "ids mixed up"),
    *("an old frame", "frames missing", "IMU not finite"),
}
"""Of the cases, those that `make test` runs."""


@pytest.mark.parametrize("name", slow_but(BRIEF, CASES))
def test_goes_on_and_finds_its_way_back(recording: list[Packet], name: str) -> None:
    change, warning, at_least = CASES[name]
    outcome = fly(change(recording))
    frames = len(change(recording))
    assert len(outcome.states) + outcome.refused == frames
    assert outcome.refused == (at_least if warning == "frame_out_of_order" else 0)
    assert outcome.counts.get(warning or "", 0) >= at_least
    errors = outcome.errors_m()
    assert errors.max() < 0.055
    assert errors[-20:].max() < 0.052


@pytest.mark.parametrize("length_s", [slow(0.5), slow(1.0), 9.0])
def test_a_long_imu_gap_gives_finite_states(recording: list[Packet], length_s: float) -> None:
    outcome = fly(during(3.0, 3.0 + length_s, no_imu)(recording))
    assert len(outcome.states) == len(recording)


def test_all_at_once(recording: list[Packet]) -> None:
    changed = recording
    for name in CASES:
        if name != "never a left camera":
            changed = CASES[name][0](changed)
    outcome = fly(changed)
    assert len(outcome.states) > 60
    assert outcome.counts["frame_out_of_order"] > 0


def test_without_features_the_uncertainty_grows_until_they_are_back(
    recording: list[Packet],
) -> None:
    outcome = fly(during(3.0, 4.0, no_features)(recording))
    sigma = []
    for state in outcome.states:
        assert state.covariance is not None
        sigma.append(float(np.sqrt(np.trace(state.covariance[3:6, 3:6]))))
    before, blind, after = sigma[59], sigma[80], sigma[-1]
    assert blind > 1.4 * before
    assert after < blind


def test_a_frame_before_any_imu_waits() -> None:
    estimator = Estimator(RIG, ALGORITHM)
    frame = FeatureFrame(10**9, (FeatureObservations.empty(),) * 2)
    assert estimator.add_frame(frame) is None
    assert not estimator.initialized
    assert estimator.waiting_for
    assert estimator.landmarks()[1].shape == (0, 3)


@pytest.mark.parametrize("change", [no_features, all_nan, no_imu])
def test_a_start_waits_for_good_data_and_then_succeeds(
    recording: list[Packet], change: Callable[[Packet], list[Packet]]
) -> None:
    """Bad data over the first two seconds of a start in motion."""
    estimator = Estimator(RIG, ALGORITHM)
    first_s = None
    for packet in during(0.0, 2.0, change)(recording):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
        if state is not None:
            first_s = state.stamp_ns * 1e-9
            break
    assert first_s is not None, estimator.waiting_for
    assert 2.0 < first_s < 4.5
    truth = FALGORITHM.nav_state(first_s)
    assert state is not None
    ours, true = (s.world_T_body.rotation().unrotate(s.velocity) for s in (state, truth))
    assert np.linalg.norm(ours - true) < 0.037


@pytest.mark.parametrize("name", ["msckf", "fixed_lag_isam2"])
def test_a_dropped_frame_rejects_no_features(recording: list[Packet], name: str) -> None:
    """What the frame before it has rejected is not said twice."""
    estimator = Estimator(RIG, load_config(algorithm=name).algorithm, GIVEN)
    estimator.start(FALGORITHM.nav_state(0.0, SURE))
    for packet in during(2.0, 4.0, mixed_up)(recording):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        if len(estimator.rejected):
            break
    assert len(estimator.rejected) > 0
    assert isinstance(packet.frame, FeatureFrame)
    assert estimator.add_frame(packet.frame) is None
    assert len(estimator.rejected) == 0
    assert estimator.report.innovations.tested == 0


def test_a_solve_that_fails_loses_no_track(
    recording: list[Packet], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The step is taken on the IMU alone; poses and observations wait for the next one."""
    estimator = Estimator(RIG, load_config(algorithm="msckf").algorithm, GIVEN)
    estimator.start(FALGORITHM.nav_state(0.0, SURE))
    failed = iter([True] + 10 * [False])

    def sometimes(cost: Cost, *arguments: Any) -> Minimum:
        if cost.tracks is not None and next(failed):
            raise np.linalg.LinAlgError
        return minimize(cost, *arguments)

    for packet in recording[:20]:
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
    window = estimator.window
    assert window is not None
    monkeypatch.setattr(engine, "minimize", sometimes)
    for packet in recording[20:30]:
        assert isinstance(packet.frame, FeatureFrame)
        waiting, past = len(window.tracks), list(window.past)
        settled, frame = sum(window.tracks.outcomes.values()), window.frame
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        if estimator.diagnostics.counts["features_degenerate"]:
            seen = sum(len(camera) for camera in packet.frame.cameras)
            assert len(window.tracks) == waiting + seen
            assert sum(window.tracks.outcomes.values()) == settled
            assert window.past == [*past, frame]
            assert len(estimator.rejected) == 0
            return
    pytest.fail("no step had tracks")
