# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 1, cost construction: which poses, features and residuals are in the cost now.

The policy chooses the past poses. Features of the state are observed once more; features whose
tracks end enter with all their observations and are used once; long-lived ones become variables of
the state. All of them pass the χ² gate first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from numpy.typing import NDArray

from slam_graph.backend.config import BackendConfig
from slam_graph.backend.cost import Cost, Linearization, NewFeatures
from slam_graph.backend.policies import POSE_CHOICES, CostPolicy
from slam_graph.backend.reprojection import RigProjection
from slam_graph.backend.selection import choose_features
from slam_graph.backend.state import stacked_poses
from slam_graph.backend.tracks import is_in
from slam_graph.backend.triangulation import triangulate
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics

IntArray = NDArray[np.int64]


@dataclass(eq=False)
class ConstructedCost:
    """The cost of a step, and what stays of it afterwards.

    Attributes:
        cost: all residuals.
        linear: their linearisation at the current estimates, where it is known already.
        past: past frames whose poses stay.
        features: ids of the features that stay in the state, ascending.
    """

    cost: Cost
    linear: Linearization | None
    past: list[int]
    features: IntArray

    def drop_features(self) -> None:
        """Leave only the prior and the dynamics."""
        if self.cost.fresh is not None:
            new = self.cost.fresh.obs.ids[self.cost.fresh.in_state]
            self.cost.state.remove(L(int(j)) for j in new)
            self.features = self.features[~is_in(self.features, new)]
        self.cost.tracked = self.cost.fresh = self.linear = None


class CostConstruction:
    """Builds the cost of each step by the policy of an algorithm."""

    def __init__(
        self,
        policy: CostPolicy,
        rig: RigProjection,
        config: BackendConfig,
        diagnostics: Diagnostics,
    ) -> None:
        self.policy = policy
        self.rig = rig
        self.config = config
        self.diagnostics = diagnostics

    def construct(
        self, window: Window, dynamics: Sequence[gtsam.NonlinearFactor], still: bool
    ) -> ConstructedCost:
        """The cost now.

        Args:
            window: with the current frame and its observations.
            dynamics: factors between the frame before and the current one.
            still: whether the platform stands still; then images say nothing new, and the new pose
                takes the place of the last one.
        """
        cost = Cost(window.state, self.rig, self.config, window.prior, dynamics)
        if still:
            return ConstructedCost(cost, None, window.past[:-1], window.features)
        past = POSE_CHOICES[self.policy.past_poses](window.past, self.policy.max_past_poses)
        oldest = window.past[0]
        layout = cost.layout()
        predicted = cost.prior_at_estimate().updated(cost.factor_rows(layout)).covariance()
        seen = np.intersect1d(window.features, window.tracks.ids_in(window.frame), True)
        cost.tracked = window.tracks.observations(seen, [window.frame])
        window.tracks.consume(window.features)
        cost.fresh = self._new_features(window, None if oldest in past else oldest, len(seen))
        linear = cost.linearize()
        tracked_ok, fresh_ok = cost.gate(linear, predicted, layout)
        linear = self._leave_out(cost, linear, tracked_ok, fresh_ok)
        # a pose that no unused observation refers to has nothing more to give
        useful = window.tracks.frames()
        past = [i for i in past if i in useful]
        return ConstructedCost(cost, linear, past, self._in_state(cost))

    def _new_features(
        self, window: Window, oldest_leaving: int | None, in_state: int
    ) -> NewFeatures | None:
        """Triangulated features that enter the cost now; their observations are used up."""
        room = self.policy.max_state_features - in_state
        choice = choose_features(window.tracks, window.frame, oldest_leaving, room, self.policy)
        ids = np.union1d(choice.ended, choice.lasting)
        if len(ids) == 0:
            return None
        obs = window.tracks.observations(ids)
        poses = stacked_poses(window.state.estimate, obs.frames)
        result = triangulate(obs, self.rig, *poses, self.config.triangulation)
        lasting = is_in(ids, choice.lasting)
        window.tracks.consume(ids[~lasting | result.good])  # a lasting one may yet become good
        self.diagnostics.counts["feature_not_triangulated"] += int(np.sum(~result.good & ~lasting))
        return NewFeatures(obs, result.points, lasting).subset(result.good)

    def _leave_out(
        self,
        cost: Cost,
        linear: Linearization,
        tracked_ok: NDArray[np.bool_],
        fresh_ok: NDArray[np.bool_],
    ) -> Linearization:
        """Leave out what the gate rejects, and make variables of the features that stay."""
        rejected = int(np.sum(~tracked_ok) + np.sum(~fresh_ok))
        self.diagnostics.counts["feature_rejected_by_gate"] += rejected
        if linear.tracked is not None and cost.tracked is not None:
            cost.tracked = cost.tracked.rows(tracked_ok)
        if linear.fresh is not None and cost.fresh is not None:
            cost.fresh = cost.fresh.subset(fresh_ok)
            for row in np.flatnonzero(cost.fresh.in_state):
                cost.state.insert_point(int(cost.fresh.obs.ids[row]), cost.fresh.points[row])
        return linear.subset(tracked_ok, fresh_ok)

    def _in_state(self, cost: Cost) -> IntArray:
        """The features of the state that the current frame sees, old and new."""
        ids = np.zeros(0, np.int64)
        if cost.tracked is not None:
            ids = np.unique(cost.tracked.ids[cost.tracked.feature])
        if cost.fresh is not None:
            ids = np.union1d(ids, cost.fresh.obs.ids[cost.fresh.in_state])
        return ids
