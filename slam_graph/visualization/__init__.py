# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures and recordings: the only place that imports rerun or matplotlib."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "Panel",
    "RerunRecording",
    "TrackPictures",
    "plot_bundle",
    "plot_errors",
    "plot_panels",
    "plot_pose_graph",
]

if TYPE_CHECKING:
    from slam_graph.visualization.plots import (
        Panel,
        plot_bundle,
        plot_errors,
        plot_panels,
        plot_pose_graph,
    )
    from slam_graph.visualization.rerun_recording import RerunRecording
    from slam_graph.visualization.track_picture import TrackPictures
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "plots": (
                "Panel",
                "plot_bundle",
                "plot_errors",
                "plot_panels",
                "plot_pose_graph",
            ),
            "rerun_recording": ("RerunRecording",),
            "track_picture": ("TrackPictures",),
        },
    )
