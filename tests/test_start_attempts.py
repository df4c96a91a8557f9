# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What attempts to start in motion cost that come to nothing."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from flight import Flight, packets, rig, room

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, InitializationConfig
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.initialization import dynamic_refinement
from slam_graph.backend.initialization.batch_cost import BatchCost
from slam_graph.backend.initialization.dynamic_refinement import DynamicRefinement
from slam_graph.backend.initialization.initializer import Initializer
from slam_graph.backend.initialization.start_diagnosis import Refusal
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.solve.square_root import Layout
from slam_graph.config import load_config
from slam_graph.sensors.rig import Rig

MOTION = BackendConfig(initialization=InitializationConfig(mode="motion"))


def with_twice_the_baseline(mounted: Rig) -> Rig:
    first, second = mounted.cameras
    origin, pose = first.body_T_camera.translation(), second.body_T_camera
    place = origin + 2.0 * (pose.translation() - origin)
    moved = replace(second, body_T_camera=gtsam.Pose3(pose.rotation(), place))
    return Rig((first, moved), mounted.imu)


def flown(mounted: Rig, duration_s: float) -> Iterator[Estimator]:
    """An estimator that takes some rig for granted, after each frame of a flight."""
    rng = np.random.default_rng(0)
    estimator = Estimator(mounted, load_config().algorithm, MOTION)
    for packet in packets(Flight(), rig(2), room(600, rng), duration_s, rng, 20.0):
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        yield estimator


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many steps each refinement takes from now on."""
    counts: list[int] = []
    apply, refine = BatchCost.apply, DynamicRefinement.refine

    def counted(cost: BatchCost, *given: object) -> None:
        counts[-1] += 1
        apply(cost, *given)

    def attempt(refinement: DynamicRefinement, *given: object) -> object:
        counts.append(0)
        return refine(refinement, *given)

    monkeypatch.setattr(BatchCost, "apply", counted)
    monkeypatch.setattr(DynamicRefinement, "refine", attempt)
    return counts


def test_a_guess_that_leads_astray_is_given_up_after_one_step(steps: list[int]) -> None:
    """With 15 steps, twice, such an attempt took ten times as long, and came to the same."""
    *_, last = flown(with_twice_the_baseline(rig(2)), 2.0)
    assert len(steps) > 1
    assert set(steps) == {1}
    assert last.waiting_for.startswith("images and IMU to agree (normalised cost ")


def test_steps_that_do_not_fit_are_given_up(
    monkeypatch: pytest.MonkeyPatch, steps: list[int]
) -> None:
    """By the residuals that are accepted at the end, here after the first of them."""
    monkeypatch.setattr(dynamic_refinement, "_JUDGED_AFTER", 1)
    monkeypatch.setattr(dynamic_refinement, "MAX_NORMALIZED_COST", 0.1)
    *_, last = flown(rig(2), 2.0)
    assert set(steps) == {1}
    assert last.waiting_for.startswith("images and IMU to agree (normalised cost ")


def test_steps_that_have_not_converged_are_not_taken_again(
    monkeypatch: pytest.MonkeyPatch, steps: list[int]
) -> None:
    hasty = GaussNewtonPolicy(max_steps=2, tolerance=1e-12, damping="levenberg_marquardt")
    monkeypatch.setattr(dynamic_refinement, "_BATCH", hasty)
    *_, last = flown(rig(2), 2.0)
    assert set(steps) == {2}
    assert last.waiting_for.startswith("steps that converge")


def test_the_factors_of_the_imu_are_linearised_once_at_the_guess(
    monkeypatch: pytest.MonkeyPatch, steps: list[int]
) -> None:
    calls = []
    rows = Cost.factor_rows

    def counted(cost: Cost, layout: Layout) -> FloatArray:
        calls.append(cost)
        return rows(cost, layout)

    monkeypatch.setattr(Cost, "factor_rows", counted)
    list(flown(with_twice_the_baseline(rig(2)), 2.0))
    assert len(calls) == len(steps) > 1


def attempts_s(monkeypatch: pytest.MonkeyPatch, outcome: Callable[[int], Refusal]) -> list[float]:
    """Times between attempts that are refused, each as a function of its number says."""
    times: list[float] = []

    def refused(initializer: Initializer) -> Refusal:
        times.append(initializer._tried_ns * 1e-9)
        return outcome(len(times))

    monkeypatch.setattr(Initializer, "_attempt", refused)
    for _ in flown(rig(2), 8.0):
        pass
    return np.diff(times).round(3).tolist()


UNSETTLED = Refusal("fit", "steps that converge", lasting=True)
UNMOVED = Refusal("motion", "more motion")


def test_attempts_in_vain_become_rare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the first ones, and never more rare than one in 1.2 s."""
    between = attempts_s(monkeypatch, lambda number: UNSETTLED)
    assert between[:10] == [*[0.2] * 6, 0.4, 0.8, 1.2, 1.2]


def test_a_start_that_waits_for_motion_is_tried_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also some time after attempts in vain: each other one takes one of these back."""
    assert set(attempts_s(monkeypatch, lambda number: UNMOVED)) == {0.2}
    between = attempts_s(monkeypatch, lambda number: UNSETTLED if number < 9 else UNMOVED)
    assert between[5:12] == [0.2, 0.4, 0.8, 0.4, 0.2, 0.2, 0.2]
