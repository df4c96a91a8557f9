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

from dataclasses import dataclass, field, replace

import numpy as np
from gtsam.symbol_shorthand import L

from slam_graph.arrays import BoolArray, IntArray, ascending_union
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.consensus_gate import gate_by_consensus
from slam_graph.backend.cost.cost import Cost, Linearization, TrackFeatures
from slam_graph.backend.cost.feature_factors import WhitenedObservations
from slam_graph.backend.cost.feature_selection import FeatureSelection, seen_by_leaving
from slam_graph.backend.cost.feature_tracks import Observations, Outcome, Removals, is_in
from slam_graph.backend.cost.first_scale import images_wait
from slam_graph.backend.cost.gating import Gate, Innovations, threshold
from slam_graph.backend.cost.pixel_noise import PixelNoise
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.selection_policies import (
    FEATURE_POLICIES,
    POSE_SELECTIONS,
    PoseSelection,
)
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import POINT_DIM, State
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError

MAX_MOVED = 0.5
"""Features of the state that have moved from their linearisation point by more than this share of
their distance from the nearest camera are not measured again. Jacobians go as one over the
distance: within it they are at most twice as large as they should be."""
_MAX_FAILURES = 3
"""Features that are outliers in this many consecutive frames are treated as dynamic."""


@dataclass(eq=False)
class ConstructedCost:
    """The cost of a step, and what becomes of variables and observations after it.

    Attributes:
        cost: all residuals; its state is a copy of the window's.
        linear: their linearisation at the current estimates, where it is known already.
        poses: which past poses stay.
        moving: the past frames whose velocity and bias stay too.
        features: ids of the features that stay in the state, ascending.
        absorbed: (J,) those of the cost's tracks that become part of the prior.
        loses_pose: (J,) those of them that a pose which leaves has seen.
        keep_lost_features: whether features that leave the state are kept for when they are seen
            again.
        removals: observations that go without being used.
        predicted: what was known of the variables before the images; None at a standstill, and in a
            step without images. The steps change it.
        remaining: the part of its cost that no values of the variables can remove.
        innovations: distances of the images from that.
        offered: the new features before the gate, without those that will come again.
        uses_images: whether features were looked for, so that images no longer wait.
    """

    cost: Cost
    linear: Linearization | None
    poses: PoseSelection
    moving: list[int]
    features: IntArray
    absorbed: BoolArray
    loses_pose: BoolArray
    keep_lost_features: bool
    removals: Removals = field(default_factory=Removals)
    predicted: SquareRootInformation | None = None
    remaining: float = 0.0
    innovations: Innovations = field(default_factory=Innovations)
    offered: TrackFeatures | None = None
    uses_images: bool = False

    def innovations_under(self, posterior: SquareRootInformation) -> Innovations:
        """The innovations with the joint distance of all measurements that entered.

        What they add to the least of the cost is rᵀ (H P Hᵀ + I)⁻¹ r of all of them stacked, with
        the correlations that they have by their common poses.
        """
        if self.predicted is None:
            return Innovations()
        joint = posterior.residual - self.remaining
        known = replace(self.innovations, passed_distance=joint)
        if known.dof:
            return known
        return replace(known, distance=joint, dof=known.passed_dof)  # nothing was gated before


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
        pixels: PixelNoise,
        by_consensus: bool = False,
    ) -> None:
        """Take what all steps have in common.

        Args:
            policy: which poses and features are in the cost.
            rig: the cameras.
            config: settings that do not depend on the algorithm.
            diagnostics: counts what is rejected.
            pixels: the noise of observations.
            by_consensus: whether the gate compares features with the motion that most agree on,
                as nothing but images tells the pose of a new frame.
        """
        self.policy = policy
        self.rig = rig
        self.config = config
        self.diagnostics = diagnostics
        self.pixels = pixels
        self.rejected = np.zeros(0, np.int64)
        self._features = FEATURE_POLICIES[policy.features]
        self._selection = FeatureSelection(policy, rig, config, diagnostics, pixels)
        self._select_poses = POSE_SELECTIONS[policy.past_poses]
        self._loss = RobustLoss(config.gating.loss)
        self._by_consensus = by_consensus
        self._failures: dict[int, int] = {}

    def construct(self, window: Window, still: bool) -> ConstructedCost:
        """The cost now.

        Args:
            window: with the current frame and its observations.
            still: whether the platform stands still. Then images say nothing new, and the new pose
                takes the place of the last one; unless features are in the cost of every step, as
                what was seen before is then known by them and not by the prior.
        """
        self.rejected = np.zeros(0, np.int64)
        cost, removals = self._prior_and_dynamics(window), Removals()
        if still and not self._features.relinearized:
            poses = PoseSelection(window.past[:-1], keyframes=frozenset(window.keyframes))
            removals.add_features(Outcome.STANDSTILL, window.state_features)
            return self._constructed(window, cost, poses, window.state_features, removals)
        poses = self._selected_poses(window)
        rows = cost.factor_rows(cost.layout())
        predicted = cost.prior_at_estimate().updated(rows, overwrite=True, overwrite_rows=True)
        in_state = self._measured_again(window, cost.state)
        cost.landmarks = window.tracks.observations(in_state)
        tracked = is_in(window.state_features, window.tracks.seen)
        held = int(tracked.sum()) if self.policy.keep_lost_features else len(in_state)
        uses_images = not images_wait(window, cost.state, predicted)
        if uses_images:
            cost.tracks = self._selection.new_features(
                window, cost.state, poses, held, self._dynamic, removals
            )
        offered = cost.tracks
        gate, linear = self._apply_gate(window, cost, predicted, removals)
        if not self._features.relinearized:
            # a pose that no waiting observation refers to has nothing more to give
            used = np.zeros(0, np.int64) if cost.tracks is None else cost.tracks.obs.ids
            gone = ascending_union(removals.ids(), window.state_features, used)
            useful = window.tracks.frames(without=gone)
            kept = [i for i in poses.kept if i in useful]
            poses = replace(poses, kept=kept, keyframes=poses.keyframes.intersection(kept))
        features = self._in_state(window, cost)
        constructed = self._constructed(window, cost, poses, features, removals)
        if cost.tracks is not None:
            seen = seen_by_leaving(window.tracks, window.past, poses)
            constructed.loses_pose = is_in(cost.tracks.obs.ids, seen)
            constructed.absorbed = self._absorbed(cost.tracks, constructed.loses_pose)
        constructed.linear, constructed.uses_images = linear, uses_images
        constructed.predicted, constructed.remaining = predicted, predicted.residual
        if offered is not None:  # those that go on waiting come again
            waiting = cost.ids_of(~constructed.absorbed)
            constructed.offered = offered.subset(~is_in(offered.obs.ids, waiting))
        constructed.innovations = gate.innovations
        return constructed

    def without_features(self, window: Window) -> ConstructedCost:
        """The step on prior and dynamics alone: all poses stay, all observations go on waiting."""
        self.rejected = np.zeros(0, np.int64)
        poses = PoseSelection(list(window.past), keyframes=frozenset(window.keyframes))
        cost = self._prior_and_dynamics(window)
        return self._constructed(window, cost, poses, window.state_features, Removals())

    def _prior_and_dynamics(self, window: Window) -> Cost:
        """The cost without images."""
        state, factors = window.state.copy(), list(window.factors)
        rig = self.rig.with_velocities(state, state.motions)
        cost = Cost(state, rig, self.config, window.prior, factors, loss=self._loss)
        cost.sigma_px = self.pixels.sigma_px
        return cost

    def _measured_again(self, window: Window, state: State) -> IntArray:
        """The features of the state, ascending, that are measured in the current frame.

        Where an estimate is far from its linearisation point, the Jacobian there is wrong and would
        turn the platform. Such features leave, or stay unmeasured where lost features are kept.
        """
        waiting = window.tracks.ids_waiting()
        ids: IntArray = window.state_features[is_in(window.state_features, waiting)]
        if not len(ids):
            return ids
        points, first = state.both_positions_of(ids)
        (R,), (p,) = state.poses([window.frame])
        centres = p + self.rig.body_p_camera @ R.T
        away = np.add.reduce((points[:, None] - centres) ** 2, axis=2).min(axis=1)
        moved = np.add.reduce((points - first) ** 2, axis=1)
        near: IntArray = ids[moved <= MAX_MOVED**2 * away]
        return near

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
        keep_lost = bool(self.policy.keep_lost_features) and window.lost_features.open
        none = np.zeros(0, np.bool_)
        return ConstructedCost(cost, None, poses, moving, features, none, none, keep_lost, removals)

    # --- after the steps -------------------------------------------------------------------------

    def reject_residuals(self, window: Window, constructed: ConstructedCost) -> None:
        """Find the observations that do not fit after the steps, of features that stay in the cost.

        They do not become part of the prior, and are not used again. A feature that has one does
        not become a variable of the state yet.
        """
        cost = constructed.cost
        if not self._features.relinearized or cost.tracks is None:
            return
        obs = cost.tracks.obs
        limit = threshold(np.array([2]), self.config.gating.confidence)[0]
        fits = cost.squared_errors(obs, cost.tracks.points) < limit
        self.rejected = ascending_union(self.rejected, obs.ids[obs.feature[~fits]])
        self._count_failures(window, obs, fits)
        constructed.removals.add_observations(Outcome.OUTLIER, obs.rows(~fits))
        rejected = int(np.sum(~fits))
        self.diagnostics.counts["observation_rejected_by_gate"] += rejected
        before = constructed.innovations
        constructed.innovations = replace(
            before, tested=before.tested + len(fits), rejected=before.rejected + rejected
        )
        cost.tracks = replace(cost.tracks, obs=obs.rows(fits))
        alone = cost.tracks.obs.counts < 2
        constructed.removals.add_features(Outcome.OUTLIER, obs.ids[constructed.absorbed & alone])
        spoiled = cost.tracks.in_state & (np.bincount(obs.feature[~fits], None, len(obs.ids)) > 0)
        if spoiled.any():
            self._postpone(constructed, cost.tracks, spoiled)

    def _postpone(
        self, constructed: ConstructedCost, tracks: TrackFeatures, spoiled: BoolArray
    ) -> None:
        """Leave features (J,) that were to enter the state outside of it."""
        cost, ids = constructed.cost, tracks.obs.ids[spoiled]
        cost.tracks = replace(tracks, in_state=tracks.in_state & ~spoiled)
        cost.state.remove(L(int(j)) for j in ids)
        constructed.features = constructed.features[~is_in(constructed.features, ids)]
        constructed.absorbed = self._absorbed(cost.tracks, constructed.loses_pose)

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
        ids = [j for j, n in self._failures.items() if n >= _MAX_FAILURES]
        return np.array(sorted(ids), np.int64)

    # --- the gate --------------------------------------------------------------------------------

    def _apply_gate(
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
        entered = None
        if self._features.relinearized and cost.tracks is not None:
            entered = is_in(cost.tracks.obs.ids, window.kept_points[0])
        gate = self._gate(cost, linear, predicted, None if entered is None else ~entered)
        if entered is not None and cost.tracks is not None:
            passed = gate.tracks | entered
            dof = np.append(
                2 * cost.tracks.obs.counts[passed] - POINT_DIM,
                2 * np.sum(gate.landmarks),
            )
            innovations = replace(
                Innovations.untested(dof),
                tested=int(np.sum(~entered)) + len(gate.landmarks),
                rejected=int(np.sum(~passed) + np.sum(~gate.landmarks)),
            )
            gate = replace(gate, tracks=passed, innovations=innovations)
        return gate, self._leave_out(cost, linear, gate, removals)

    def _gate(
        self,
        cost: Cost,
        linear: Linearization,
        predicted: SquareRootInformation,
        tested: BoolArray | None,
    ) -> Gate:
        """What passes the χ² test, by the prediction or by what most features show."""
        if self._loss.vanishes:
            linear = linear.unweighted(self._loss)
        if self._by_consensus:
            return gate_by_consensus(cost, linear, predicted, tested)
        return cost.gate(linear, predicted, tested)

    def _leave_out(
        self, cost: Cost, linear: Linearization, gate: Gate, removals: Removals
    ) -> Linearization:
        """Leave out what the gate rejects, and make variables of the features that stay."""
        self.diagnostics.counts["feature_rejected_by_gate"] += gate.innovations.rejected
        landmarks, tracks = linear.landmarks, None
        if landmarks is not None and cost.landmarks is not None and not gate.landmarks.all():
            bad = cost.landmarks.rows(~gate.landmarks)
            self.rejected = ascending_union(self.rejected, bad.ids[bad.feature])
            removals.add_observations(Outcome.GATED, bad)
            cost.landmarks = cost.landmarks.rows(gate.landmarks)
            landmarks = landmarks.subset(gate.landmarks)
        if linear.tracks is not None and cost.tracks is not None:
            assert isinstance(linear.tracks, WhitenedObservations)
            tracks = linear.tracks
            if not gate.tracks.all():
                tracks = tracks.subset(gate.tracks[cost.tracks.obs.feature])
                bad_ids = cost.tracks.obs.ids[~gate.tracks]
                self.rejected = ascending_union(self.rejected, bad_ids)
                removals.add_features(Outcome.GATED, bad_ids)
                cost.tracks = cost.tracks.subset(gate.tracks)
            new = cost.tracks.in_state
            cost.state.insert_points(cost.tracks.obs.ids[new], cost.tracks.points[new])
        return Linearization.of(landmarks, tracks, cost.tracks.obs if cost.tracks else None)

    # --- what stays ------------------------------------------------------------------------------

    def _in_state(self, window: Window, cost: Cost) -> IntArray:
        """The features that stay in the state: those that are tracked, old and new."""
        ids = np.zeros(0, np.int64)
        if cost.landmarks is not None:
            ids = ascending_union(cost.landmarks.ids[cost.landmarks.feature])
        if self.policy.keep_lost_features:
            ids = window.state_features[is_in(window.state_features, window.tracks.seen)]
        if cost.tracks is not None:
            ids = ascending_union(ids, cost.tracks.obs.ids[cost.tracks.in_state])
        return ids

    def _absorbed(self, tracks: TrackFeatures, loses_pose: BoolArray) -> BoolArray:
        """Which tracks (J,) become part of the prior: all, or those that enter or lose a pose."""
        if not self._features.relinearized:
            return np.ones(len(tracks.points), np.bool_)
        return tracks.in_state | loses_pose
