# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 1, cost construction: which poses, features and residuals are in the cost now.

The policy chooses the past poses. Features of the state are observed once more; long-lived ones
become variables of the state; others enter with all their observations, to be used once when their
track ends, or in every step as long as poses that saw them stay. All of them pass the χ² gate
first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from gtsam.symbol_shorthand import L, X

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.cost import Cost, Linearization, NewFeatures
from slam_graph.backend.cost.feature_selection import choose_features
from slam_graph.backend.cost.feature_tracks import Observations, is_in
from slam_graph.backend.cost.gating import Gate, Innovations, threshold
from slam_graph.backend.cost.pose_selection import POSE_CHOICES
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import POINT_DIM
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics

MAX_FAILURES = 3
"""A feature that in so many frames on end does not fit after the steps is on what moves."""


@dataclass(eq=False)
class ConstructedCost:
    """The cost of a step, and what stays of it afterwards.

    Attributes:
        cost: all residuals.
        linear: their linearisation at the current estimates, where it is known already.
        past: past frames whose poses stay.
        moving: those of them whose velocity and bias stay.
        features: ids of the features that stay in the state, ascending.
        leaving: (J,) those of the cost's new features that are used for the last time.
        keep_lost_features: whether features that leave are put aside for when they are seen again.
        predicted: what was known of the variables before the images; None if these are left out.
        innovations: distances of the images from that.
    """

    cost: Cost
    linear: Linearization | None
    past: list[int]
    moving: list[int]
    features: IntArray
    leaving: BoolArray
    keep_lost_features: bool
    predicted: SquareRootInformation | None = None
    innovations: Innovations = field(default_factory=Innovations)

    def innovations_under(self, posterior: SquareRootInformation) -> Innovations:
        """The innovations with the joint distance of all measurements that entered.

        What they add to the least of the cost is rᵀ (H P Hᵀ + I)⁻¹ r of all of them stacked, with
        the correlations that they have by their common poses.
        """
        if self.predicted is None:
            return Innovations()
        joint = posterior.residual - self.predicted.residual
        known = replace(self.innovations, passed_distance=joint)
        if known.dof:
            return known
        return replace(known, distance=joint, dof=known.passed_dof)  # nothing was gated before

    def drop_features(self) -> None:
        """Leave only the prior and the factors."""
        if self.cost.fresh is not None:
            new = self.cost.fresh.obs.ids[self.cost.fresh.in_state]
            self.cost.state.remove(L(int(j)) for j in new)
            self.features = self.features[~is_in(self.features, new)]
        self.cost.tracked = self.cost.fresh = self.linear = self.predicted = None
        self.leaving = np.zeros(0, np.bool_)


class CostConstruction:
    """Builds the cost of each step by the policy of an algorithm.

    Attributes:
        rejected: ids (N,) of the features that the gate rejected in the last step, ascending.
    """

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
        self.rejected = np.zeros(0, np.int64)
        self.loss = RobustLoss(policy.robust_loss or config.gating.robust_loss)
        self._failures: dict[int, int] = {}

    def construct(self, window: Window, still: bool) -> ConstructedCost:
        """The cost now.

        Args:
            window: with the current frame and its observations.
            still: whether the platform stands still; then images say nothing new, and the new pose
                takes the place of the last one.
        """
        self.rejected = np.zeros(0, np.int64)
        factors = list(window.factors)
        cost = Cost(window.state, self.rig, self.config, window.prior, factors, loss=self.loss)
        nothing = np.zeros(0, np.bool_)
        if still:
            past = window.past[:-1]
            return self._constructed(window, cost, None, past, window.features, nothing)
        window.recall_features()
        cost.prior = window.prior
        past = POSE_CHOICES[self.policy.past_poses](window, self.policy, self.rig)
        predicted = cost.prior_at_estimate().updated(cost.factor_rows(cost.layout()))
        seen = np.intersect1d(window.features, window.tracks.ids_in(window.frame), True)
        cost.tracked = window.tracks.observations(seen, [window.frame])
        window.tracks.consume(window.features)
        leaving_frames = [i for i in window.past if i not in past]
        cost.fresh = self._new_features(window, leaving_frames, len(seen))
        gate, linear = self._gated(window, cost, predicted)
        leaving = self._leaving(window, cost, leaving_frames)
        if self.policy.features != "window":
            # a pose that no unused observation refers to has nothing more to give
            useful = window.tracks.frames()
            past = [i for i in past if i in useful]
        features = self._in_state(window, cost)
        constructed = self._constructed(window, cost, linear, past, features, leaving)
        constructed.predicted, constructed.innovations = predicted, gate.innovations
        return constructed

    def _gated(
        self, window: Window, cost: Cost, predicted: SquareRootInformation
    ) -> tuple[Gate, Linearization]:
        """Leave out what does not pass; what the gate found, and the cost's linearisation.

        Where there is a test after the steps too, this one is for features that enter the cost: one
        that is in every step would sooner or later fail one of so many tests, whatever it is.
        """
        linear = cost.linearize(summed=self.policy.gate == "residual")
        gate = cost.gate(linear, predicted)
        if self.policy.gate == "both" and cost.fresh is not None:
            entered = is_in(cost.fresh.obs.ids, window.landmarks[0])
            passed = gate.fresh | entered
            dof = np.append(2 * cost.fresh.obs.counts[passed] - POINT_DIM, 2 * np.sum(gate.tracked))
            innovations = replace(
                Innovations.untested(dof),
                tested=int(np.sum(~entered)) + len(gate.tracked),
                rejected=int(np.sum(~passed) + np.sum(~gate.tracked)),
            )
            gate = replace(gate, fresh=passed, innovations=innovations)
        return gate, self._leave_out(window, cost, linear, gate)

    def _constructed(
        self,
        window: Window,
        cost: Cost,
        linear: Linearization | None,
        past: list[int],
        features: IntArray,
        leaving: BoolArray,
    ) -> ConstructedCost:
        count = self.policy.recent_frames - 1
        recent = set(window.past[-count:]) if count else set()
        moving = [i for i in window.moving if i in recent and i in past]
        keep_lost = self.policy.keep_lost_features and window.archive.open
        return ConstructedCost(cost, linear, past, moving, features, leaving, keep_lost)

    def reject_residuals(self, window: Window, constructed: ConstructedCost) -> None:
        """Forget the observations that do not fit after the steps, where the gate is on residuals.

        Features that too few others see are left out of what becomes part of the prior.
        """
        cost = constructed.cost
        if self.policy.gate == "prediction" or cost.fresh is None:
            return
        obs = cost.fresh.obs
        limit = threshold(np.array([2]), self.config.gating.confidence)[0]
        fits = cost.squared_errors(obs, cost.fresh.points) < limit
        self.rejected = np.union1d(self.rejected, obs.ids[obs.feature[~fits]])
        self._count_failures(window, obs, fits)
        window.tracks.forget(obs.rows(~fits))
        rejected = int(np.sum(~fits))
        self.diagnostics.counts["observation_rejected_by_gate"] += rejected
        before = constructed.innovations
        constructed.innovations = replace(
            before, tested=before.tested + len(fits), rejected=before.rejected + rejected
        )
        cost.fresh = replace(cost.fresh, obs=obs.rows(fits))

    def _count_failures(self, window: Window, obs: Observations, fits: BoolArray) -> None:
        """Note in how many frames on end each feature has failed; `fits` (N,) is of `obs`."""
        latest = np.array(obs.frames)[obs.frame] == window.frame
        failed = np.unique(obs.ids[obs.feature[latest & ~fits]]).tolist()
        fitted = set(obs.ids[obs.feature[latest & fits]].tolist())
        seen = set(window.tracks.seen.tolist())
        before = self._failures
        self._failures = {j: n for j, n in before.items() if j in seen and j not in fitted}
        self._failures |= {j: before.get(j, 0) + 1 for j in failed}

    @property
    def _unfit(self) -> IntArray:
        """Ids (N,) of the features that failed too often, ascending."""
        ids = [j for j, n in self._failures.items() if n >= MAX_FAILURES]
        return np.array(sorted(ids), np.int64)

    # --- features --------------------------------------------------------------------------------

    def _new_features(
        self, window: Window, leaving_frames: Sequence[int], in_state: int
    ) -> NewFeatures | None:
        """Triangulated features that are in the cost with all of their observations."""
        window.tracks.consume(self._unfit)
        bound = self.policy.max_state_features
        room = len(window.tracks.seen) if bound is None else bound - in_state
        choice = choose_features(window, leaving_frames, room, self.policy)
        ids = np.union1d(choice.used, choice.lasting)
        if len(ids) == 0:
            return None
        obs = window.tracks.observations(ids)
        lasting = is_in(ids, choice.lasting)
        points, good = self._points(window, obs, lasting)
        entering = is_in(ids, choice.entering(ids[good], room))
        # a lasting one that is not good may yet become so
        used = is_in(ids, choice.used) & ~entering & (~lasting | good)
        consumed = entering if self.policy.features == "window" else entering | used
        window.tracks.consume(ids[consumed])
        self.diagnostics.counts["feature_not_triangulated"] += int(np.sum(used & ~good))
        return NewFeatures(obs, points, entering).subset(good & (entering | used))

    def _points(
        self, window: Window, obs: Observations, lasting: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """Positions (J, 3) of features, those of the last step where there are, and their worth."""
        known_ids, known_points = window.landmarks
        good = is_in(obs.ids, known_ids)
        points = np.zeros((len(obs.ids), 3))
        points[good] = known_points[np.searchsorted(known_ids, obs.ids[good])]
        here = window.state.estimate.atPose3(X(window.frame)).translation()
        # steps may have sent a feature with little parallax to infinity
        good &= np.linalg.norm(points - here, axis=1) < self.config.triangulation.max_depth_m
        if not good.all():
            new, rig = ~good, self.rig.at(window.state)
            poses = rig.poses(window.state.estimate, obs.frames)
            observed = rig.renormalized(obs.subset(new))
            result = triangulate(observed, rig, *poses, self.config.triangulation)
            noise = self.config.noise.pixel_sigma / rig.cameras[0].fx
            known = noise * result.depth_error < self.policy.state_feature_depth_error
            points[new], good[new] = result.points, result.good & (known | ~lasting[new])
        return points, good

    def _leave_out(
        self, window: Window, cost: Cost, linear: Linearization, gate: Gate
    ) -> Linearization:
        """Leave out what the gate rejects, and make variables of the features that stay."""
        self.diagnostics.counts["feature_rejected_by_gate"] += gate.innovations.rejected
        if linear.tracked is not None and cost.tracked is not None:
            bad = cost.tracked.rows(~gate.tracked)
            self.rejected = np.union1d(self.rejected, bad.ids[bad.feature])
            cost.tracked = cost.tracked.rows(gate.tracked)
        if linear.fresh is not None and cost.fresh is not None:
            bad_ids = cost.fresh.obs.ids[~gate.fresh]
            self.rejected = np.union1d(self.rejected, bad_ids)
            window.tracks.consume(bad_ids)
            cost.fresh = cost.fresh.subset(gate.fresh)
            for row in np.flatnonzero(cost.fresh.in_state):
                cost.state.insert_point(int(cost.fresh.obs.ids[row]), cost.fresh.points[row])
        return linear.subset(gate.tracked, gate.fresh)

    def _in_state(self, window: Window, cost: Cost) -> IntArray:
        """The features that stay in the state: those that are tracked, old and new, or all."""
        ids = np.zeros(0, np.int64)
        if cost.tracked is not None:
            ids = np.unique(cost.tracked.ids[cost.tracked.feature])
        if self.policy.keep_lost_features:
            ids = window.features
            if window.archive.open:
                ids = ids[is_in(ids, window.tracks.seen)]
        if cost.fresh is not None:
            ids = np.union1d(ids, cost.fresh.obs.ids[cost.fresh.in_state])
        return ids

    def _leaving(self, window: Window, cost: Cost, leaving_frames: Sequence[int]) -> BoolArray:
        """Which new features (J,) become part of the prior: all, or those of a leaving keyframe."""
        if cost.fresh is None:
            return np.zeros(0, np.bool_)
        if self.policy.features != "window":
            return np.ones(len(cost.fresh.points), np.bool_)
        obs = cost.fresh.obs
        going = [i for i in leaving_frames if i in window.keyframes_before]
        leaving = cost.fresh.in_state.copy()
        leaving[obs.feature[np.isin(np.array(obs.frames)[obs.frame], going)]] = True
        return leaving
