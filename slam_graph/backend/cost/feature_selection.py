# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which features are in the cost of a step with all of their observations.

A feature that is to be used once waits as long as it is tracked, because later observations make it
worth more: it enters when its track has ended, or when the oldest pose that saw it leaves. One that
has lived long enough becomes a variable of the state, if there is room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.window import Window

RETRY_FRAMES = 4
"""Lasting features that are not the longest tracks are looked at on one frame out of so many."""

MIN_FRAMES = 2
"""A feature must be seen in this many frames to be used."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureChoice:
    """Features that are in the cost, ascending ids.

    Attributes:
        used: (J,) those whose observations are due.
        lasting: (K,) long-lived ones that may become variables of the state: more than there is
            room for, because only their positions tell which are worth it. An object that moves may
            have the longest tracks, and must not stand in the way of others.
        frames: (K,) number of frames that see each lasting one.
    """

    used: IntArray
    lasting: IntArray
    frames: IntArray

    def entering(self, worthy: IntArray, room: int) -> IntArray:
        """New variables: the longest tracks of the lasting ones that are worthy (ascending ids)."""
        rows = is_in(self.lasting, worthy)
        return _longest(self.lasting[rows], self.frames[rows], room)


def choose_features(
    window: Window, leaving_frames: Sequence[int], room: int, policy: CostPolicy
) -> FeatureChoice:
    """Choose the features of a step.

    Args:
        window: with unused observations of all its frames, the current one included.
        leaving_frames: past frames whose poses leave in this step.
        room: how many features may still be added to the state.
        policy: limits.
    """
    ids, lengths = window.tracks.lengths()
    live = is_in(ids, window.tracks.seen)
    lasting = live & (lengths >= policy.state_feature_frames)
    lasting &= room > 0
    lasting &= is_in(ids, _longest(ids[lasting], lengths[lasting], max(room, 0))) | (
        (ids + window.frame) % RETRY_FRAMES == 0
    )
    if policy.features == "state":
        due = np.zeros(len(ids), np.bool_)
        window.tracks.consume(ids[~live])
    elif policy.features == "window":
        due = np.ones(len(ids), np.bool_)
    else:
        due = ~live
        if window.past and window.past[0] in leaving_frames:
            due |= is_in(ids, window.tracks.ids_in(window.past[0]))
    due &= lengths >= MIN_FRAMES
    used = _longest(ids[due], lengths[due], policy.max_features_per_step)
    return FeatureChoice(used, ids[lasting], lengths[lasting])


def _longest(ids: IntArray, lengths: IntArray, count: int) -> IntArray:
    """The `count` features with the longest tracks, ascending ids."""
    order = np.argsort(-lengths, kind="stable")[:count]
    return np.sort(ids[order])
