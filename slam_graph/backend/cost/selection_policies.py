# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The policies `past_poses` and `features`: which poses and features are in the cost of a step.

`past_poses` says which past poses stay beside the current IMU state. A pose that leaves is
marginalised. What its frame saw and has not been used yet is either used now (the features that it
saw enter the cost with all of their observations, or become part of the prior if they are there
already) or dropped unused; a selection says which.

`features` says which of the waiting tracks are in the cost of a step, and whether they stay there.
That every observation is counted exactly once is not its business: the engine makes what was used
part of the prior and takes its observations out of the tracks (`feature_tracks.py`). So a policy of
your own cannot be overconfident, only wasteful.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.plugins import Registry

if TYPE_CHECKING:
    from slam_graph.backend.cost.reprojection import RigProjection
    from slam_graph.backend.policies import CostPolicy
    from slam_graph.backend.window import Window


@dataclass(frozen=True, slots=True)
class PoseSelection:
    """What a step keeps of the past frames.

    Attributes:
        kept: the frames whose poses stay, ascending; some of `window.past`.
        dropped: those of the others whose waiting observations are dropped unused. The features
            that the remaining others saw are used now.
        keyframes: those of `kept` that are keyframes.
    """

    kept: list[int]
    dropped: frozenset[int] = frozenset()
    keyframes: frozenset[int] = frozenset()


_POSE_SPACING_S = 0.037
"""Least time between the poses of one camera with an IMU. A camera of 20 or 25 Hz keeps all, also
where its frames jitter by some milliseconds."""

PoseSelector = Callable[["Window", "CostPolicy", "RigProjection"], PoseSelection]
"""Selects among `window.past`, with the current frame's observations in `window.tracks`; it must
not change the window."""

POSE_SELECTIONS: Registry[PoseSelector] = Registry("slam_graph.pose_selections", "pose selection")
"""Pose selections by the names that `algorithm.cost.past_poses` takes."""


@POSE_SELECTIONS.register("most_recent")
def most_recent(window: Window, policy: CostPolicy, rig: RigProjection) -> PoseSelection:
    """The latest poses that are far enough apart. When the oldest leaves, what it saw is used."""
    frames = _apart(window, policy, rig)
    return PoseSelection(frames[-policy.max_past_poses :], _others(window, frames))


@POSE_SELECTIONS.register("evenly_spaced")
def evenly_spaced(window: Window, policy: CostPolicy, rig: RigProjection) -> PoseSelection:
    """Poses thinned evenly in time once there are too many, the oldest kept.

    Every third pose leaves, starting from the second oldest (Mourikis & Roumeliotis 2007, sec.
    III-E), so that some poses of the far past stay beside the recent ones. The observations of the
    poses that leave are dropped; the features that they saw go on with their other observations.
    """
    frames = _apart(window, policy, rig)
    if len(frames) > policy.max_past_poses:
        del frames[1 : -policy.recent_frames : 3]
    return PoseSelection(frames, _others(window, frames))


def _apart(window: Window, policy: CostPolicy, rig: RigProjection) -> list[int]:
    """The past frames without those that are too close in time to the one before.

    One fast camera would fill the window with one view, and its features would be used, or become
    variables, with little parallax. Several cameras have parallax at once, and what counts is the
    number of observations, as without an IMU. Frames whose IMU states are kept stay.
    """
    spacing_s = policy.pose_spacing_s
    if spacing_s is None:
        spacing_s = _POSE_SPACING_S if rig.has_imu and len(rig.cameras) == 1 else 0.0
    spacing_ns, stamps_ns = round(spacing_s * 1e9), window.past_stamps_ns
    count = max(len(window.past) - (policy.recent_frames - 1), 1)
    apart = window.past[:1]
    for frame in window.past[1:count]:
        if stamps_ns[frame] - stamps_ns[apart[-1]] >= spacing_ns:
            apart.append(frame)
    return apart + window.past[count:]


def _others(window: Window, frames: list[int]) -> frozenset[int]:
    """The past frames that are not among some."""
    return frozenset(window.past).difference(frames)


@POSE_SELECTIONS.register("keyframes")
def keyframes(window: Window, policy: CostPolicy, rig: RigProjection) -> PoseSelection:
    """Keyframes, and the most recent frames (Leutenegger et al. 2015, sec. 3.4).

    A frame that is no longer recent stays if it is a keyframe, that is, if it sees enough that the
    last keyframe did not see, or sees it from elsewhere; else it leaves, and its observations are
    dropped. When there are too many keyframes, the oldest leaves, and the features that it saw are
    used.
    """
    count = max(len(window.past) - (policy.recent_frames - 1), 0)
    older, recent = window.past[:count], window.past[count:]
    kept: list[int] = []
    for frame in older:
        if not kept or frame in window.keyframes or _is_new(window, kept[-1], frame, policy, rig):
            kept.append(frame)
    kept = kept[-policy.max_past_poses :]
    dropped = set(older).difference(kept, window.keyframes)
    return PoseSelection(kept + recent, frozenset(dropped), frozenset(kept))


def _is_new(
    window: Window, keyframe: int, frame: int, policy: CostPolicy, rig: RigProjection
) -> bool:
    """Whether a frame sees what the last keyframe did not see, or sees it from elsewhere."""
    both = [keyframe, frame]
    (before, after), _ = rig.when_taken(both, *window.state.poses(both))
    turns = [(after @ R).T @ before @ R for R in rig.body_R_camera]
    least = policy.keyframe_overlap * len(window.tracks.ids_in(frame))
    angles = window.tracks.parallax(keyframe, frame, turns, least)
    if len(angles) < least:
        return True
    return bool(np.median(angles) > policy.keyframe_parallax_rad) if len(angles) else False


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
        uses_tracks: whether tracks are ever due; without, only features of the state are measured,
            and settings of all others have no effect.
    """

    due: Callable[[WaitingTracks], BoolArray]
    relinearized: bool = False
    drops_ended: bool = False
    uses_tracks: bool = True


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
FEATURE_POLICIES.register("state")(FeaturePolicy(_none, drops_ended=True, uses_tracks=False))
FEATURE_POLICIES.register("every_step")(FeaturePolicy(_all, relinearized=True))
