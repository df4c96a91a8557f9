# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which past poses stay in the cost beside the current IMU state."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.window import Window

PoseChoice = Callable[[Window, CostPolicy, RigProjection], list[int]]


def most_recent(window: Window, policy: CostPolicy, rig: RigProjection) -> list[int]:
    """The latest poses."""
    return window.past[-policy.max_past_poses :]


def evenly_spaced(window: Window, policy: CostPolicy, rig: RigProjection) -> list[int]:
    """Poses thinned evenly in time once there are too many, the oldest kept.

    Every third pose leaves, starting from the second oldest (Mourikis & Roumeliotis 2007, sec.
    III-E), so that some poses of the far past stay beside the recent ones.
    """
    frames = window.past
    if len(frames) <= policy.max_past_poses:
        return list(frames)
    leaving = set(frames[1:-1:3])
    return [frame for frame in frames if frame not in leaving]


def keyframes(window: Window, policy: CostPolicy, rig: RigProjection) -> list[int]:
    """Keyframes, and the most recent frames (Leutenegger et al. 2015, sec. 3.4).

    A frame that is no longer recent stays if it is a keyframe, that is, if it sees enough that the
    last keyframe did not see, or sees it from elsewhere; else it leaves, and its observations are
    dropped. When there are too many keyframes, the oldest leaves with its features.
    """
    count = max(len(window.past) - (policy.recent_frames - 1), 0)
    older, recent = window.past[:count], window.past[count:]
    kept: list[int] = []
    for frame in older:
        if not kept or frame in window.keyframes or _is_new(window, kept[-1], frame, policy, rig):
            kept.append(frame)
    kept = kept[-policy.max_past_poses :]
    window.keyframes_before, window.keyframes = window.keyframes, set(kept)
    return kept + recent


def _is_new(
    window: Window, keyframe: int, frame: int, policy: CostPolicy, rig: RigProjection
) -> bool:
    """Whether a frame sees what the last keyframe did not see, or sees it from elsewhere."""
    body_R_camera = rig.body_R_camera[0]
    (before, after), _ = rig.poses(window.state.estimate, [keyframe, frame])
    turn = (after @ body_R_camera).T @ before @ body_R_camera
    angles = window.tracks.parallax(keyframe, frame, turn)
    if len(angles) < policy.keyframe_overlap * len(window.tracks.ids_in(frame)):
        return True
    return bool(np.median(angles) > policy.keyframe_parallax_rad) if len(angles) else False


POSE_CHOICES: dict[str, PoseChoice] = {
    "most_recent": most_recent,
    "evenly_spaced": evenly_spaced,
    "keyframes": keyframes,
}
