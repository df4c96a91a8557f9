# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features that are put aside and recalled are what they would be had they always stayed."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph.backend.marginalization import landmark_store
from slam_graph.backend.marginalization.landmark_store import LandmarkStore
from slam_graph.backend.marginalization.marginalize import LinearizationPoints, marginalize
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of, imu_state_keys
from slam_graph.geometry.trajectory import NavState

FEATURES = 6
STEPS = 9


class Filter:
    """A filter on random rows, with features that leave put aside or held on to."""

    def __init__(self, archive: bool, points: LinearizationPoints) -> None:
        self.state = State()
        self.archive = LandmarkStore()
        self.put_aside, self.points = archive, points
        self.prior = SquareRootInformation.empty()
        self.tracked: set[int] = set()
        self.kept: list[int] = []

    def step(self, frame: int, tracked: set[int], rng: np.random.Generator) -> None:
        """A new frame and new features, random measurements of them, and all else leaves."""
        self.state.insert_imu_state(
            frame,
            NavState(
                frame, gtsam.Pose3(), np.zeros(3), accel_bias=np.zeros(3), gyro_bias=np.zeros(3)
            ),
        )
        again = self.archive.due(np.array(sorted(tracked)))
        if len(again):
            self.prior = self.archive.recall(again, self.prior, self.state)
        keys = [*imu_state_keys(frame), *(L(j) for j in sorted(tracked))]
        for j in sorted(tracked):
            if L(j) not in self.state.offsets:
                self.state.insert_point(j, np.zeros(3))
        old = [X(frame - 1), V(frame - 1), B(frame - 1)] if frame else []
        measured = dims_of([*old, *keys])
        rows = rng.normal(size=(40, sum(measured.values()) + 1)) * 0.1
        estimate = self.prior.shifted(self.state.offset(self.prior.layout))
        joint = estimate.extended({k: d for k, d in measured.items() if k not in estimate.layout})
        Ab = np.zeros((len(rows), joint.layout.size + 1))
        Ab[:, np.append(joint.layout.indices(measured), joint.layout.size)] = rows
        posterior = joint.updated(Ab)
        delta = posterior.solution()
        self.state.update(posterior.layout, delta)
        features = [k for k in posterior.layout.dims if gtsam.Symbol(k).chr() == ord("l")]
        if self.put_aside:
            features = [k for k in features if gtsam.Symbol(k).index() in tracked]
        self.prior = marginalize(
            posterior.shifted(delta),
            self.state,
            [*features, *imu_state_keys(frame)],
            self.points,
            self.archive if self.put_aside else None,
        )


@pytest.mark.parametrize("points", ["first", "current"])
@pytest.mark.parametrize("seed", range(4))
def test_put_aside_and_recalled_is_held_on_to(seed: int, points: LinearizationPoints) -> None:
    rng = np.random.default_rng(seed)
    archive, joint = (Filter(aside, points) for aside in (True, False))
    for frame in range(STEPS):
        tracked = set(rng.choice(FEATURES, rng.integers(1, 4), replace=False).tolist())
        for one in (archive, joint):
            one.step(frame, tracked, np.random.default_rng([seed, frame]))
        keys = list(archive.prior.layout.dims)
        np.testing.assert_allclose(
            archive.prior.covariance_of(keys), joint.prior.covariance_of(keys), rtol=1e-7, atol=1e-9
        )
        for j in tracked:
            np.testing.assert_allclose(
                archive.state.estimate.atPoint3(L(j)),
                joint.state.estimate.atPoint3(L(j)),
                atol=1e-7,
            )
    seen = {gtsam.Symbol(k).index() for k in joint.prior.layout.dims if k != X(STEPS - 1)}
    assert len(archive.archive) > 0
    assert len(seen) > len(tracked)


def test_a_store_that_closes_forgets(monkeypatch: pytest.MonkeyPatch) -> None:
    """A feature that comes back is a new variable then, and nothing is stored any more."""
    rng, own = np.random.default_rng(5), Filter(archive=True, points="first")
    own.step(0, {0, 1}, rng)
    own.step(1, {2}, rng)
    assert len(own.archive) == 2
    monkeypatch.setattr(landmark_store, "_MAX_EXCHANGES", -1)
    before = own.prior
    own.step(2, {0, 2}, rng)
    assert not own.archive.open
    assert own.archive.size == 0
    assert L(0) in own.state.offsets
    assert L(0) not in before.layout
    assert len(own.archive.due(np.array([0, 1, 2]))) == 0


def test_the_oldest_conditionals_are_dropped_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is still stored is what it would be had nothing been dropped; the rest is new again."""
    bounded, joint = (Filter(aside, points="first") for aside in (True, False))
    for frame, tracked in enumerate([{0, 1}, {1, 2}, {2, 3}, {3, 4}]):
        if frame == 3:  # features 0 and 1 have left; only what leaves now has room
            monkeypatch.setattr(landmark_store, "_MAX_BYTES", 8000)
        for one in (bounded, joint):
            one.step(frame, tracked, np.random.default_rng([7, frame]))
    assert bounded.archive.due(np.array([0, 1, 2])).tolist() == [2]
    for one in (bounded, joint):
        one.step(4, {2, 3, 4}, np.random.default_rng([7, 4]))
    keys = list(bounded.prior.layout.dims)
    np.testing.assert_allclose(
        bounded.prior.covariance_of(keys), joint.prior.covariance_of(keys), rtol=1e-7, atol=1e-9
    )
    bounded.step(5, {0, 2}, np.random.default_rng([7, 5]))
    assert L(0) in bounded.state.offsets
