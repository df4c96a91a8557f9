# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Divergence: a run whose images contradict its state says so, and one that recovers goes on."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from groups import slow

from slam_graph.backend.cost.gating import Innovations
from slam_graph.config import RunConfig, load_config
from slam_graph.geometry.trajectory import NavState
from slam_graph.pipeline.agreement import Agreement
from slam_graph.pipeline.divergence import DivergenceError, check_sane
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, Packet
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import simulate

CONFIG = RunConfig()


def flight(seed: int, trajectory: str = "figure8") -> SimulatedSequence:
    """Ten seconds of tracks, whose start is given."""
    settings = {"trajectory": trajectory, "duration_s": 10.0, "rate_hz": 10.0, "seed": seed}
    return simulate(SimulationConfig.model_validate(settings | {"tracks": {"features": 80}}))


class Changed:
    """A sequence with another rig or with other packets."""

    def __init__(self, sequence: SimulatedSequence) -> None:
        self._sequence = sequence
        self.rig = sequence.rig

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)


class Spliced(Changed):
    """A flight that sees after some seconds what another one does, or nothing for a while."""

    def __init__(
        self,
        sequence: SimulatedSequence,
        other: SimulatedSequence | None,
        from_s: float,
        to_s: float,
    ) -> None:
        super().__init__(sequence)
        self._other, self._from_s, self._to_s = other, from_s, to_s

    def packets(self, start_ns: int | None, end_ns: int | None) -> Iterator[Packet]:
        """Those of the one, with frames of the other."""
        packets = list(self._sequence.packets(start_ns, end_ns))
        others = packets if self._other is None else list(self._other.packets(start_ns, end_ns))
        begin_ns = packets[0].frame.stamp_ns
        for packet, other in zip(packets, others, strict=True):
            seconds = (packet.frame.stamp_ns - begin_ns) * 1e-9
            frame = packet.frame
            assert isinstance(frame, FeatureFrame)
            assert isinstance(other.frame, FeatureFrame)
            if self._from_s <= seconds < self._to_s:
                cameras = other.frame.cameras
                if self._other is None:
                    cameras = (FeatureObservations.empty(),) * len(cameras)
                frame = FeatureFrame(frame.stamp_ns, cameras)
            yield Packet(packet.imu, frame)


def outcome(sequence: Any, algorithm: str, cameras: int, refused: bool = True) -> RunResult:
    settings = ["final_ba.enabled=false", f"limits.refuse_wrong_setup={refused}"]
    return run(sequence, load_config(None, settings, algorithm=algorithm, cameras=cameras))


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("algorithm", ["msckf", "okvis"])
def test_cameras_that_are_mounted_otherwise_make_a_run_diverge(
    algorithm: str, cameras: int
) -> None:
    sequence = Changed(flight(0))
    turn = gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2), np.zeros(3))
    turned = [replace(c, body_T_camera=c.body_T_camera.compose(turn)) for c in sequence.rig.cameras]
    sequence.rig = Rig(tuple(turned), sequence.rig.imu)
    result = outcome(sequence, algorithm, cameras, refused=False)
    assert result.status == "diverged"
    assert "images contradict the state" in result.message


@pytest.mark.parametrize("cameras", [slow(1), 2])
def test_images_of_another_flight_make_a_run_diverge(cameras: int) -> None:
    result = outcome(Spliced(flight(0), flight(1, "random"), 3.0, np.inf), "msckf", cameras)
    assert result.status == "diverged"
    assert "images contradict the state" in result.message


@pytest.mark.parametrize("cameras", [slow(1), 2])
def test_after_a_second_without_images_a_run_goes_on(cameras: int) -> None:
    result = outcome(Spliced(flight(0), None, 4.0, 5.0), "msckf", cameras)
    assert result.status == "ok"


def innovations(rejected: int) -> Innovations:
    return Innovations(tested=10, rejected=rejected)


def test_most_must_be_rejected_for_some_time() -> None:
    agreement = Agreement(CONFIG)
    frames = round(CONFIG.limits.disagreement_s * 10.0)
    rejected = [5] * (4 * frames) + [10] * (frames // 6) + [0] * frames
    for k, count in enumerate(rejected):
        agreement.check(k * 10**8, innovations(count))

    def go_on() -> None:
        for k in range(len(rejected), len(rejected) + 2 * frames):
            agreement.check(k * 10**8, innovations(9))

    with pytest.raises(DivergenceError, match="images contradict the state"):
        go_on()


def test_a_pause_gives_no_time() -> None:
    """What is rejected right after a long one does not end a run at once."""
    agreement = Agreement(CONFIG)
    agreement.check(0, innovations(0))
    for k in range(5):
        agreement.check(60 * 10**9 + k * 10**8, innovations(10))


@pytest.mark.parametrize("part", ["gyro_bias", "accel_bias"])
def test_a_bias_that_no_sensor_has_is_not_sane(part: str) -> None:
    zeros = {name: np.zeros(3) for name in ("velocity", "accel_bias", "gyro_bias")}
    state = NavState(0, gtsam.Pose3(), **zeros)
    check_sane(state, CONFIG)
    changed: dict[str, Any] = {part: np.array([0.0, -4.0, 0.0])}
    with pytest.raises(DivergenceError, match=r"bias of 4"):
        check_sane(replace(state, **changed), CONFIG)
