# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A pose selection: the pose before the current one leaves."""

from slam_graph.backend import PoseSelection, RigProjection
from slam_graph.backend.policies import CostPolicy
from slam_graph.backend.window import Window


def second_newest_leaves(window: Window, policy: CostPolicy, rig: RigProjection) -> PoseSelection:
    """Once there are too many poses, the one before the current leaves; what it saw is dropped."""
    frames = window.past
    if len(frames) <= policy.max_past_poses:
        return PoseSelection(list(frames))
    return PoseSelection(
        [frame for frame in frames if frame != frames[-1]], frozenset({frames[-1]})
    )
