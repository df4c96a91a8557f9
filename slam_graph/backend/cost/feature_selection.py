# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which features enter the cost of a step with all of their observations, and where they are.

The feature policy asks for some (`selection_policies.py`). Beside them, features with long tracks
and a well-known depth become variables of the state while there is room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import BoolArray, FloatArray, IntArray, ascending_union
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.cost import TrackFeatures
from slam_graph.backend.cost.feature_tracks import (
    FeatureTracks,
    Observations,
    Outcome,
    Removals,
    is_in,
)
from slam_graph.backend.cost.pixel_noise import PixelNoise
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.selection_policies import (
    FEATURE_POLICIES,
    PoseSelection,
    WaitingTracks,
)
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.solve.state import State
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics

_RETRY_FRAMES = 4
"""Candidates for the state beyond those with the longest tracks are tried one frame in so many."""
_MIN_FRAMES = 2
"""A feature must be seen in this many frames to be used."""


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


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSelection:
    """Selects and triangulates the features of a step by the policy of an algorithm."""

    policy: CostPolicy
    rig: RigProjection
    config: BackendConfig
    diagnostics: Diagnostics
    pixels: PixelNoise

    def new_features(
        self,
        window: Window,
        state: State,
        poses: PoseSelection,
        in_state: int,
        dynamic: IntArray,
        removals: Removals,
    ) -> TrackFeatures | None:
        """Triangulated features that are in the cost with all of their observations.

        Args:
            window: with all waiting observations.
            state: that of the cost, which still has the values of the window.
            poses: which past poses stay.
            in_state: number of features of the state that the current frame sees.
            dynamic: ids (N,) of features that must not be used, ascending.
            removals: gets the observations that go without being in the cost.
        """
        bound = self.policy.max_state_features
        room = len(window.tracks.seen) if bound is None else bound - in_state
        choice = self._candidates(window, poses, room, dynamic, removals)
        ids = ascending_union(choice.used, choice.lasting)
        if len(ids) == 0:
            return None
        obs = window.tracks.observations(ids)
        lasting = is_in(ids, choice.lasting)
        points, good = self._points(window, state, obs, lasting)
        entering = is_in(ids, choice.entering(ids[good], room))
        # a lasting one that is not good may yet become so
        used = is_in(ids, choice.used) & ~entering & (~lasting | good)
        lost = used & ~good
        self.diagnostics.counts["feature_not_triangulated"] += int(np.sum(lost))
        if not FEATURE_POLICIES[self.policy.features].relinearized:
            removals.add_features(Outcome.NOT_TRIANGULATED, ids[lost])
        return TrackFeatures(obs, points, entering).subset(good & (entering | used))

    def _candidates(
        self,
        window: Window,
        poses: PoseSelection,
        room: int,
        dynamic: IntArray,
        removals: Removals,
    ) -> _Candidates:
        """The features that may be in the cost, where `room` more may be held in the state."""
        tracks, policy = window.tracks, self.policy
        ids, lengths = tracks.lengths()
        removals.add_features(Outcome.DYNAMIC, dynamic)
        outside = ~is_in(ids, window.state_features)
        outside &= ~is_in(ids, dynamic)
        ids, lengths = ids[outside], lengths[outside]
        live = is_in(ids, tracks.seen)
        lasting = live & (lengths >= policy.frames_before_state) & (room > 0)
        lasting &= is_in(ids, _longest(ids[lasting], lengths[lasting], max(room, 0))) | (
            (ids + window.frame) % _RETRY_FRAMES == 0
        )
        leaving = is_in(ids, seen_by_leaving(tracks, window.past, poses))
        choice = FEATURE_POLICIES[policy.features]
        due = choice.due(WaitingTracks(ids, lengths, live, leaving))
        due = due & (lengths >= _MIN_FRAMES)
        if choice.drops_ended:
            removals.add_features(Outcome.ENDED, ids[~live & ~due])
        used = _longest(ids[due], lengths[due], policy.max_features_per_step)
        return _Candidates(used, ids[lasting], lengths[lasting])

    def _points(
        self, window: Window, state: State, obs: Observations, lasting: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """Positions (J, 3) of features, those of the last step where there are, and their worth."""
        known_ids, known_points = window.kept_points
        good = is_in(obs.ids, known_ids)
        points = np.zeros((len(obs.ids), 3))
        points[good] = known_points[known_ids.searchsorted(obs.ids[good])]
        here = state.frames.atPose3(X(window.frame)).translation()
        # steps may have sent a feature with little parallax to infinity
        away = np.sqrt(np.add.reduce((points - here) ** 2, axis=1))
        good &= away < self.config.triangulation.max_depth_m
        if not good.all():
            new, rig = ~good, self.rig.at(state)
            poses = rig.when_taken(obs.frames, *state.poses(obs.frames))
            observed = rig.renormalized(obs.subset(new))
            result = triangulate(observed, rig, *poses, self.config.triangulation)
            noise = float(np.max(self.pixels.sigma_px)) / rig.cameras[0].fx
            # an uncertain mounting makes the depths of all features uncertain
            noise = float(np.hypot(noise, rig.turn_sigma_rad(window.prior)))
            known = noise * result.depth_error < self.policy.state_feature_depth_error
            points[new], good[new] = result.points, result.good & (known | ~lasting[new])
        return points, good


def seen_by_leaving(tracks: FeatureTracks, past: Sequence[int], poses: PoseSelection) -> IntArray:
    """The features, ascending, that poses saw which leave and do not drop their observations."""
    leaving = [i for i in past if i not in poses.kept and i not in poses.dropped]
    return tracks.ids_in_any(leaving)


def _longest(ids: IntArray, lengths: IntArray, count: int) -> IntArray:
    """The `count` features with the longest tracks, ascending ids."""
    if count >= len(ids):
        return ids
    longest = ids[(-lengths).argsort(kind="stable")[:count]]
    longest.sort()
    return longest
