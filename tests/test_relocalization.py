# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Without an IMU a segment after a loss is in another world: recognised places join it."""

import pytest

from slam_graph import run
from slam_graph.datasets.faults.injection import inject
from slam_graph.evaluation import ape
from slam_graph.simulation import simulate
from slam_graph.simulation.simulated_sequence import SimulatedSequence

pytestmark = pytest.mark.slow

CAUSAL = {"final_ba.enabled": False}
LOST = "frames_dropped:at_s={},duration_s=3"


def flight(cameras: int, seed: int, duration_s: float, rate_hz: float = 10.0) -> SimulatedSequence:
    """Through rooms of one world, which are recognised by descriptors."""
    return simulate(
        trajectory="rooms",
        duration_s=duration_s,
        rate_hz=rate_hz,
        seed=seed,
        world_seed=7,
        cameras=cameras,
        with_imu=False,
        landmarks={"density": 4.0},
        tracks={"features": 80, "descriptors": True},
    )


@pytest.mark.parametrize(("cameras", "alignment", "bound"), [(2, "se3", 0.05), (1, "sim3", 0.15)])
def test_loops_join_a_segment_with_the_one_before(
    cameras: int, alignment: str, bound: float
) -> None:
    """In six degrees of freedom, or seven where each segment has a scale of its own."""
    sequence = flight(cameras, 1, 60.0, 5.0)  # it comes back after 40 s
    settings = {**CAUSAL, "loop_closure.enabled": True}
    result = run(inject(sequence, [LOST.format(25)]), algorithm="msckf", overrides=settings)
    assert result.status == "ok"
    assert [segment.joined_by for segment in result.segments] == ["start", "none"]
    assert result.segments[1].loops > 0
    assert result.loop_closed is not None
    apart, joined = (
        ape(sequence.groundtruth(), path, alignment=alignment).statistics.rmse
        for path in (result.trajectory, result.loop_closed)
    )
    assert joined < bound
    assert apart > 5.0 * joined


def test_a_run_is_found_in_its_map_again_after_a_loss() -> None:
    made = run(flight(2, 1, 32.0), algorithm="msckf", overrides={**CAUSAL, "map.enabled": True})
    assert made.slam_map is not None
    sequence = flight(2, 2, 24.0)
    located = run(
        inject(sequence, [LOST.format(14)]),
        algorithm="msckf",
        known_map=made.slam_map,
        overrides=CAUSAL,
    )
    assert [segment.joined_by for segment in located.segments] == ["start", "none"]
    in_map = located.in_map
    assert in_map is not None
    late = in_map.stamps_ns > located.segments[1].begin_ns
    assert 40 < late.sum() < len(in_map) - 100
    assert ape(sequence.groundtruth(), in_map, alignment="se3").statistics.rmse < 0.05
