# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What becomes of features that are not variables of the state: the policy `features`.

A policy says which of the waiting tracks are in the cost of a step, and whether they stay there.
That every observation is counted exactly once is not its business: the engine makes what was used
part of the prior and takes its observations out of the tracks (`feature_tracks.py`). So a policy of
your own cannot be overconfident, only wasteful.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.plugins import Registry


@dataclass(frozen=True, slots=True, eq=False)
class WaitingTracks:
    """J features outside the state with observations that have not been used.

    Attributes:
        ids: (J,) ascending.
        lengths: (J,) number of frames that see each.
        tracked: (J,) whether the current frame sees it.
        leaving: (J,) whether a pose that leaves now saw it, and its observations do not go unused.
    """

    ids: IntArray
    lengths: IntArray
    tracked: BoolArray
    leaving: BoolArray


@dataclass(frozen=True, slots=True)
class FeaturePolicy:
    """One choice of the policy `features`.

    Attributes:
        due: (J,) which of the waiting tracks are in the cost of this step.
        relinearized: whether these stay in the cost, linearised anew in every step, until a pose
            that saw them leaves; else they are marginalised in the step that uses them.
        drops_ended: whether the observations of a track that has ended are dropped unused.
    """

    due: Callable[[WaitingTracks], BoolArray]
    relinearized: bool = False
    drops_ended: bool = False


FEATURE_POLICIES: Registry[FeaturePolicy] = Registry(
    "slam_graph.feature_policies",
    "feature policy",
    accepts=lambda part: isinstance(part, FeaturePolicy),
)
"""Feature policies by the names that `algorithm.cost.features` takes."""


def _ended_or_leaving(tracks: WaitingTracks) -> BoolArray:
    """Later observations make a feature worth more, so it waits as long as it can."""
    return ~tracks.tracked | tracks.leaving


def _none(tracks: WaitingTracks) -> BoolArray:
    return np.zeros(len(tracks.ids), np.bool_)


def _all(tracks: WaitingTracks) -> BoolArray:
    return np.ones(len(tracks.ids), np.bool_)


FEATURE_POLICIES.register("once")(FeaturePolicy(_ended_or_leaving))
FEATURE_POLICIES.register("state")(FeaturePolicy(_none, drops_ended=True))
FEATURE_POLICIES.register("every_step")(FeaturePolicy(_all, relinearized=True))
