# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects: which tracks move, which move together, and how each of these objects moves."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "EgoWindow",
    "ObjectFrame",
    "ObjectHistory",
    "ObjectState",
    "ObjectTracker",
    "ObjectsConfig",
    "merged_frame",
]

if TYPE_CHECKING:
    from slam_graph.objects.ego_motion import EgoWindow
    from slam_graph.objects.object_history import ObjectHistory
    from slam_graph.objects.object_state import ObjectState
    from slam_graph.objects.object_tracker import ObjectFrame, ObjectTracker, merged_frame
    from slam_graph.objects.objects_config import ObjectsConfig
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "ego_motion": ("EgoWindow",),
            "object_history": ("ObjectHistory",),
            "object_state": ("ObjectState",),
            "object_tracker": ("ObjectFrame", "ObjectTracker", "merged_frame"),
            "objects_config": ("ObjectsConfig",),
        },
    )
