# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which features enter the cost in a step: those whose track ended, or would lose its beginning.

A feature that is still tracked waits, because later observations make it worth more. It enters
when its track has ended, when the oldest pose that saw it leaves, or when it has lived long enough
to become a variable of the state and there is room.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.tracks import TrackWindow, is_in

IntArray = NDArray[np.int64]

MIN_FRAMES = 2
"""A feature must be seen in this many frames to be used."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureChoice:
    """Features that enter now, ascending ids.

    Attributes:
        ended: (J,) their track ended, or loses its beginning: to be used once.
        lasting: (K,) long-lived ones that may become variables of the state.
    """

    ended: IntArray
    lasting: IntArray


def choose_features(
    tracks: TrackWindow, current: int, oldest_leaving: int | None, room: int, policy: CostPolicy
) -> FeatureChoice:
    """Choose the features that enter the cost.

    Args:
        tracks: unused observations of all frames in the cost, the current one included.
        current: index of the current frame.
        oldest_leaving: index of the oldest frame if it leaves in this step.
        room: how many features may still be added to the state.
        policy: limits.
    """
    ids, lengths = tracks.lengths()
    live = is_in(ids, tracks.ids_in(current))
    due = ~live
    if oldest_leaving is not None:
        due |= is_in(ids, tracks.ids_in(oldest_leaving))
    lasting = live & (lengths >= policy.state_feature_frames)
    chosen = _longest(ids[lasting], lengths[lasting], room)
    due &= (lengths >= MIN_FRAMES) & ~is_in(ids, chosen)
    ended = _longest(ids[due], lengths[due], policy.max_features_per_step)
    return FeatureChoice(ended, chosen)


def _longest(ids: IntArray, lengths: IntArray, count: int) -> IntArray:
    """The `count` features with the longest tracks, ascending ids."""
    order = np.argsort(-lengths, kind="stable")[:count]
    return np.sort(ids[order])
