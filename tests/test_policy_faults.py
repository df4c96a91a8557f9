# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The law of the table when things go wrong: no measurement counts twice, and none comes back.

Features blink, the gate and the test after the steps reject at random, and some solves fail, under
a sample of the combinations of policies. The data are exact, so that the problem stays linear, and
what is rejected is only left out.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flight import rig
from groups import slow_but
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import eigvalsh
from test_policy_product import LOOSE, TOLERANCE, Batch, accepted

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend import engine
from slam_graph.backend.cost.construction import ConstructedCost, CostConstruction
from slam_graph.backend.cost.cost import Cost, Linearization
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations, Outcome
from slam_graph.backend.cost.gating import Gate
from slam_graph.backend.cost.selection_policies import FEATURE_POLICIES, POSE_SELECTIONS
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.solve.gauss_newton import Minimum, minimize
from slam_graph.backend.window import Window
from slam_graph.sensors.measurements import FeatureFrame, Packet

FRAMES, POINTS = 10, 25
SAMPLED = 25
"""Combinations for each selection of poses and feature policy."""
REJECTED, FAILED, BLINKING = 0.1, 0.15, 0.2
"""Shares of tests and solves that fail, and of frames in which a feature appears or vanishes."""

Row = tuple[int, int, int]
"""An observation: feature, frame, camera."""


def rows(obs: Observations, keep: BoolArray | None = None) -> set[Row]:
    table = zip(obs.ids[obs.feature], np.array(obs.frames)[obs.frame], obs.camera, strict=True)
    every = [(int(j), int(i), int(c)) for j, i, c in table]
    return {row for k, row in enumerate(every) if keep is None or keep[k]}


def waiting(tracks: FeatureTracks) -> set[Row]:
    return rows(tracks.observations(tracks.ids_waiting()))


class Faults:
    """Random rejections and failures, and which observations they concern.

    Attributes:
        rejected: what the tests of the present step have rejected.
    """

    def __init__(self, seed: int, patch: pytest.MonkeyPatch) -> None:
        self.rng = np.random.default_rng(seed)
        self.rejected: set[Row] = set()
        self._testing = False
        leave_out, errors = CostConstruction._leave_out, Cost.squared_errors
        gate, reject = Cost.gate, CostConstruction.reject_residuals

        def some_gated(cost: Cost, *arguments: Any) -> Gate:
            found = gate(cost, *arguments)
            kept = [self._some(len(part)) for part in (found.landmarks, found.tracks)]
            return replace(
                found, landmarks=found.landmarks & kept[0], tracks=found.tracks & kept[1]
            )

        def noted(
            this: CostConstruction, cost: Cost, linear: Linearization, found: Gate, *more: Any
        ) -> Linearization:
            if cost.landmarks is not None and linear.landmarks is not None:
                self.rejected |= rows(cost.landmarks, ~found.landmarks)
            if cost.tracks is not None and linear.tracks is not None:
                self.rejected |= rows(cost.tracks.obs, ~found.tracks[cost.tracks.obs.feature])
            return leave_out(this, cost, linear, found, *more)

        def some_large(cost: Cost, obs: Observations, points: FloatArray | None) -> FloatArray:
            squares = errors(cost, obs, points)
            if self._testing:
                bad = ~self._some(len(squares))
                self.rejected |= rows(obs, bad)
                squares = np.where(bad, 1e9, squares)
            return squares

        def tested(this: CostConstruction, window: Window, constructed: ConstructedCost) -> None:
            self._testing = True
            reject(this, window, constructed)
            self._testing = False

        def sometimes(cost: Cost, *arguments: Any) -> Minimum:
            images = cost.tracks is not None or cost.landmarks is not None
            if images and self.rng.random() < FAILED:
                self.rejected.clear()  # the step is taken without them, and they wait
                raise np.linalg.LinAlgError
            return minimize(cost, *arguments)

        patch.setattr(Cost, "gate", some_gated)
        patch.setattr(CostConstruction, "_leave_out", noted)
        patch.setattr(Cost, "squared_errors", some_large)
        patch.setattr(CostConstruction, "reject_residuals", tested)
        patch.setattr(engine, "minimize", sometimes)

    def _some(self, count: int) -> BoolArray:
        return np.asarray(self.rng.random(count) > REJECTED)


class BlinkingBatch(Batch):
    """A flight in which features appear and vanish."""

    frames, points = FRAMES, POINTS

    def recorded(self) -> list[Packet]:
        rng = np.random.default_rng(4)
        seen = np.cumsum(rng.random((FRAMES, POINTS)) < BLINKING, axis=0) % 2 == 0
        blinking = []
        for i, packet in enumerate(self.flown):
            assert isinstance(packet.frame, FeatureFrame)
            cameras = tuple(c.select(seen[i][c.ids]) for c in packet.frame.cameras)
            blinking.append(Packet(packet.imu, FeatureFrame(packet.frame.stamp_ns, cameras)))
        return blinking


@pytest.fixture(scope="module")
def batches() -> list[tuple[Any, BlinkingBatch]]:
    return [(mounted, BlinkingBatch(mounted)) for mounted in (rig(1), rig(2))]


def sample(past_poses: str, features: str) -> Iterator[AlgorithmConfig]:
    every = list(accepted(past_poses, features))
    chosen = np.random.default_rng(7).choice(len(every), SAMPLED, replace=False)
    yield from (every[k] for k in chosen)


@pytest.mark.parametrize("features", slow_but({"state", "once"}, FEATURE_POLICIES))
@pytest.mark.parametrize("past_poses", slow_but({"keyframes"}, POSE_SELECTIONS))
def test_what_is_rejected_does_not_come_back(
    past_poses: str,
    features: str,
    batches: list[tuple[Any, BlinkingBatch]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    faults = Faults(3, monkeypatch)
    rejected, outcomes = 0, set[Outcome]()
    for number, algorithm in enumerate(sample(past_poses, features)):
        mounted, truth = batches[number % 2]
        estimator = Estimator(mounted, algorithm, LOOSE)
        estimator.start(truth.start)
        gone: set[Row] = set()
        for i, packet in enumerate(truth.flown):
            before = set() if estimator.window is None else waiting(estimator.window.tracks)
            faults.rejected = set()
            estimator.add_imu(packet.imu)
            state = estimator.add_frame(packet.frame)
            window = estimator.window
            assert state is not None
            assert window is not None
            now = waiting(window.tracks)
            assert not faults.rejected & now, f"rejected ones wait in frame {i}: {algorithm}"
            gone |= before - now
            assert not gone & now, f"some came back in frame {i}: {algorithm}"
            rejected += len(faults.rejected)
            keys = [X(k) for k in window.past] + [X(i), V(i), B(i)]
            ratios = eigvalsh(estimator.covariance_of(keys), truth.covariance(i, keys))
            assert ratios[0] > 1.0 - TOLERANCE, f"variance x {ratios[0]} in frame {i}: {algorithm}"
        outcomes |= set(window.tracks.outcomes)
    assert rejected > 0
    assert Outcome.GATED in outcomes or Outcome.OUTLIER in outcomes
