# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 1, cost construction: which poses, features and residuals are in the cost now.

The policies choose the past poses and the features. Features of the state are observed once more;
long-lived ones become variables of the state; others are in the cost with all of their
observations. All of them pass the χ² gate first.

Construction reads the window and changes nothing in it. What is to change, if the steps succeed, is
in the `ConstructedCost`; `marginalize_step` carries it out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from gtsam.symbol_shorthand import L, X

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.cost import Cost, Linearization, NewFeatures
from slam_graph.backend.cost.feature_policies import FEATURE_POLICIES, WaitingTracks
from slam_graph.backend.cost.feature_tracks import (
    FeatureTracks,
    Observations,
    Outcome,
    Removals,
    is_in,
)
from slam_graph.backend.cost.gating import Gate, Innovations, threshold
from slam_graph.backend.cost.pose_selection import POSE_SELECTIONS, PoseSelection
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import POINT_DIM
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError

MAX_FAILURES = 3
"""Features that are outliers in this many consecutive frames are treated as dynamic."""
RETRY_FRAMES = 4
"""Candidates for the state beyond those with the longest tracks are tried one frame in so many."""
MIN_FRAMES = 2
"""A feature must be seen in this many frames to be used."""


@dataclass(eq=False)
class ConstructedCost:
    """The cost of a step, and what becomes of variables and observations after it.

    Attributes:
        cost: all residuals; its state is a copy of the window's.
        linear: their linearisation at the current estimates, where it is known already.
        poses: which past poses stay.
        moving: the past frames whose velocity and bias stay too.
        features: ids of the features that stay in the state, ascending.
        leaving: (J,) those of the cost's new features that become part of the prior.
        keep_lost_features: whether features that leave the state are kept for when they are seen
            again.
        removals: observations that go without being used.
        predicted: what was known of the variables before the images; None if these are left out.
        innovations: distances of the images from that.
    """

    cost: Cost
    linear: Linearization | None
    poses: PoseSelection
    moving: list[int]
    features: IntArray
    leaving: BoolArray
    keep_lost_features: bool
    removals: Removals = field(default_factory=Removals)
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

    def without_features(self, window: Window) -> ConstructedCost:
        """The same step on prior and dynamics alone; the observations go on waiting."""
        cost = replace(self.cost, state=window.state.copy(), tracked=None, fresh=None)
        known = is_in(self.features, window.features)
        none = np.zeros(0, np.bool_)
        return replace(
            self,
            cost=cost,
            linear=None,
            features=self.features[known],
            leaving=none,
            removals=Removals(),
            predicted=None,
            innovations=Innovations(),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Features outside the state that may be in the cost, ascending ids.

    Attributes:
        used: (J,) those that the feature policy asks for.
        lasting: (K,) long-lived ones that may become variables of the state: more than there is
            room for, because only their positions tell which are worth it. A dynamic object may
            have the longest tracks, and must not stand in the way of others.
        lengths: (K,) number of frames that see each lasting one.
    """

    used: IntArray
    lasting: IntArray
    lengths: IntArray

    def entering(self, worthy: IntArray, room: int) -> IntArray:
        """New variables: the longest tracks of the lasting ones that are worthy (ascending ids)."""
        rows = is_in(self.lasting, worthy)
        return _longest(self.lasting[rows], self.lengths[rows], room)


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
        self._features = FEATURE_POLICIES[policy.features]
        self._select_poses = POSE_SELECTIONS[policy.past_poses]
        self._loss = RobustLoss(config.gating.robust_loss)
        self._failures: dict[int, int] = {}

    def construct(self, window: Window, still: bool) -> ConstructedCost:
        """The cost now.

        Args:
            window: with the current frame and its observations.
            still: whether the platform stands still; then images say nothing new, and the new pose
                takes the place of the last one.
        """
        self.rejected = np.zeros(0, np.int64)
        state, factors = window.state.copy(), list(window.factors)
        cost = Cost(state, self.rig, self.config, window.prior, factors, loss=self._loss)
        removals = Removals()
        if still:
            poses = PoseSelection(window.past[:-1], keyframes=frozenset(window.keyframes))
            removals.add_features(Outcome.STANDSTILL, window.features)
            return self._constructed(window, cost, poses, window.features, removals)
        poses = self._selected_poses(window)
        predicted = cost.prior_at_estimate().updated(cost.factor_rows(cost.layout()))
        in_state = np.intersect1d(window.features, window.tracks.ids_waiting(), True)
        cost.tracked = window.tracks.observations(in_state)
        cost.fresh = self._new_features(window, poses, len(in_state), removals)
        gate, linear = self._gated(window, cost, predicted, removals)
        if not self._features.relinearized:
            # a pose that no waiting observation refers to has nothing more to give
            used = np.ones(len(cost.fresh.points) if cost.fresh is not None else 0, np.bool_)
            gone = np.unique(np.concatenate([removals.ids(), window.features, cost.ids_of(used)]))
            useful = window.tracks.frames(without=gone)
            poses = replace(poses, kept=[i for i in poses.kept if i in useful])
        features = self._in_state(window, cost)
        constructed = self._constructed(window, cost, poses, features, removals)
        constructed.leaving = self._leaving(window, cost, poses)
        constructed.linear, constructed.predicted = linear, predicted
        constructed.innovations = gate.innovations
        return constructed

    def _selected_poses(self, window: Window) -> PoseSelection:
        poses = self._select_poses(window, self.policy, self.rig)
        if not set(window.past).issuperset(poses.kept):
            raise EstimationError(
                f"past_poses '{self.policy.past_poses}' keeps {poses.kept}, which are not all "
                f"among the past frames {window.past}"
            )
        return poses

    def _constructed(
        self,
        window: Window,
        cost: Cost,
        poses: PoseSelection,
        features: IntArray,
        removals: Removals,
    ) -> ConstructedCost:
        count = self.policy.recent_frames - 1
        recent = set(window.past[-count:]) if count else set()
        moving = [i for i in window.moving if i in recent and i in poses.kept]
        keep_lost = self.policy.keep_lost_features and window.archive.open
        none = np.zeros(0, np.bool_)
        return ConstructedCost(cost, None, poses, moving, features, none, keep_lost, removals)

    # --- after the steps -------------------------------------------------------------------------

    def reject_residuals(self, window: Window, constructed: ConstructedCost) -> None:
        """Find the observations that do not fit after the steps, of features that stay in the cost.

        They do not become part of the prior, and are not used again. A feature that has one does
        not become a variable of the state yet.
        """
        cost = constructed.cost
        if not self._features.relinearized or cost.fresh is None:
            return
        obs = cost.fresh.obs
        limit = threshold(np.array([2]), self.config.gating.confidence)[0]
        fits = cost.squared_errors(obs, cost.fresh.points) < limit
        self.rejected = np.union1d(self.rejected, obs.ids[obs.feature[~fits]])
        self._count_failures(window, obs, fits)
        constructed.removals.add_observations(Outcome.OUTLIER, obs.rows(~fits))
        rejected = int(np.sum(~fits))
        self.diagnostics.counts["observation_rejected_by_gate"] += rejected
        before = constructed.innovations
        constructed.innovations = replace(
            before, tested=before.tested + len(fits), rejected=before.rejected + rejected
        )
        cost.fresh = replace(cost.fresh, obs=obs.rows(fits))
        alone = cost.fresh.obs.counts < 2
        constructed.removals.add_features(Outcome.OUTLIER, obs.ids[constructed.leaving & alone])
        spoiled = cost.fresh.in_state & (np.bincount(obs.feature[~fits], None, len(obs.ids)) > 0)
        if spoiled.any():
            self._postpone(constructed, cost.fresh, spoiled)

    def _postpone(
        self, constructed: ConstructedCost, fresh: NewFeatures, spoiled: BoolArray
    ) -> None:
        """Leave features (J,) that were to enter the state outside of it."""
        cost, ids = constructed.cost, fresh.obs.ids[spoiled]
        cost.fresh = replace(fresh, in_state=fresh.in_state & ~spoiled)
        cost.state.remove(L(int(j)) for j in ids)
        constructed.features = constructed.features[~is_in(constructed.features, ids)]
        constructed.leaving = constructed.leaving & ~spoiled

    def _count_failures(self, window: Window, obs: Observations, fits: BoolArray) -> None:
        """Note in how many consecutive frames each feature was an outlier; `fits` (N,) is of `obs`.

        Not in how many of its life: one in twenty good observations fails.
        """
        latest = np.array(obs.frames)[obs.frame] == window.frame
        failed = np.unique(obs.ids[obs.feature[latest & ~fits]]).tolist()
        fitted = set(obs.ids[obs.feature[latest & fits]].tolist())
        seen = set(window.tracks.seen.tolist())
        before = self._failures
        self._failures = {j: n for j, n in before.items() if j in seen and j not in fitted}
        self._failures |= {j: before.get(j, 0) + 1 for j in failed}

    @property
    def _dynamic(self) -> IntArray:
        """Ids (N,) of the features that were outliers too often, ascending."""
        ids = [j for j, n in self._failures.items() if n >= MAX_FAILURES]
        return np.array(sorted(ids), np.int64)

    # --- features --------------------------------------------------------------------------------

    def _new_features(
        self,
        window: Window,
        poses: PoseSelection,
        in_state: int,
        removals: Removals,
    ) -> NewFeatures | None:
        """Triangulated features that are in the cost with all of their observations.

        Args:
            window: with all waiting observations.
            poses: which past poses stay.
            in_state: number of features of the state that the current frame sees.
            removals: gets the observations that go without being in the cost.
        """
        bound = self.policy.max_state_features
        room = len(window.tracks.seen) if bound is None else bound - in_state
        choice = self._candidates(window, poses, room, removals)
        ids = np.union1d(choice.used, choice.lasting)
        if len(ids) == 0:
            return None
        obs = window.tracks.observations(ids)
        lasting = is_in(ids, choice.lasting)
        points, good = self._points(window, obs, lasting)
        entering = is_in(ids, choice.entering(ids[good], room))
        # a lasting one that is not good may yet become so
        used = is_in(ids, choice.used) & ~entering & (~lasting | good)
        lost = used & ~good
        self.diagnostics.counts["feature_not_triangulated"] += int(np.sum(lost))
        if not self._features.relinearized:
            removals.add_features(Outcome.NOT_TRIANGULATED, ids[lost])
        return NewFeatures(obs, points, entering).subset(good & (entering | used))

    def _candidates(
        self, window: Window, poses: PoseSelection, room: int, removals: Removals
    ) -> _Candidates:
        """The features that may be in the cost, where `room` more may be held in the state."""
        tracks, policy = window.tracks, self.policy
        ids, lengths = tracks.lengths()
        removals.add_features(Outcome.DYNAMIC, self._dynamic)
        outside = ~is_in(ids, window.features) & ~is_in(ids, self._dynamic)
        ids, lengths = ids[outside], lengths[outside]
        live = is_in(ids, tracks.seen)
        lasting = live & (lengths >= policy.frames_before_state) & (room > 0)
        lasting &= is_in(ids, _longest(ids[lasting], lengths[lasting], max(room, 0))) | (
            (ids + window.frame) % RETRY_FRAMES == 0
        )
        leaving = is_in(ids, _seen_by_leaving(tracks, window.past, poses))
        due = self._features.due(WaitingTracks(ids, lengths, live, leaving))
        due = due & (lengths >= MIN_FRAMES)
        if self._features.drops_ended:
            removals.add_features(Outcome.ENDED, ids[~live & ~due])
        used = _longest(ids[due], lengths[due], policy.max_features_per_step)
        return _Candidates(used, ids[lasting], lengths[lasting])

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

    # --- the gate --------------------------------------------------------------------------------

    def _gated(
        self,
        window: Window,
        cost: Cost,
        predicted: SquareRootInformation,
        removals: Removals,
    ) -> tuple[Gate, Linearization]:
        """Leave out what does not pass; what the gate found, and the cost's linearisation.

        A feature is tested once, when it enters the cost: one that stays would sooner or later fail
        one of so many tests, whatever it is. Its observations are tested after the steps.
        """
        linear = cost.linearize()
        gate = cost.gate(linear, predicted)
        if self._features.relinearized and cost.fresh is not None:
            entered = is_in(cost.fresh.obs.ids, window.landmarks[0])
            passed = gate.fresh | entered
            dof = np.append(2 * cost.fresh.obs.counts[passed] - POINT_DIM, 2 * np.sum(gate.tracked))
            innovations = replace(
                Innovations.untested(dof),
                tested=int(np.sum(~entered)) + len(gate.tracked),
                rejected=int(np.sum(~passed) + np.sum(~gate.tracked)),
            )
            gate = replace(gate, fresh=passed, innovations=innovations)
        return gate, self._leave_out(cost, linear, gate, removals)

    def _leave_out(
        self, cost: Cost, linear: Linearization, gate: Gate, removals: Removals
    ) -> Linearization:
        """Leave out what the gate rejects, and make variables of the features that stay."""
        self.diagnostics.counts["feature_rejected_by_gate"] += gate.innovations.rejected
        if linear.tracked is not None and cost.tracked is not None:
            bad = cost.tracked.rows(~gate.tracked)
            self.rejected = np.union1d(self.rejected, bad.ids[bad.feature])
            removals.add_observations(Outcome.GATED, bad)
            cost.tracked = cost.tracked.rows(gate.tracked)
        if linear.fresh is not None and cost.fresh is not None:
            bad_ids = cost.fresh.obs.ids[~gate.fresh]
            self.rejected = np.union1d(self.rejected, bad_ids)
            removals.add_features(Outcome.GATED, bad_ids)
            cost.fresh = cost.fresh.subset(gate.fresh)
            for row in np.flatnonzero(cost.fresh.in_state):
                cost.state.insert_point(int(cost.fresh.obs.ids[row]), cost.fresh.points[row])
        return linear.subset(gate.tracked, gate.fresh)

    # --- what stays ------------------------------------------------------------------------------

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

    def _leaving(self, window: Window, cost: Cost, poses: PoseSelection) -> BoolArray:
        """Which new features (J,) become part of the prior: all, or those that lose a pose."""
        if cost.fresh is None:
            return np.zeros(0, np.bool_)
        if not self._features.relinearized:
            return np.ones(len(cost.fresh.points), np.bool_)
        seen = _seen_by_leaving(window.tracks, window.past, poses)
        return cost.fresh.in_state | is_in(cost.fresh.obs.ids, seen)


def _seen_by_leaving(tracks: FeatureTracks, past: Sequence[int], poses: PoseSelection) -> IntArray:
    """The features, ascending, that poses saw which leave and do not drop their observations."""
    leaving = [i for i in past if i not in poses.kept and i not in poses.dropped]
    return tracks.ids_in_any(leaving)


def _longest(ids: IntArray, lengths: IntArray, count: int) -> IntArray:
    """The `count` features with the longest tracks, ascending ids."""
    order = np.argsort(-lengths, kind="stable")[:count]
    return np.sort(ids[order])
