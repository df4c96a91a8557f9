# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures and recordings: the only place that imports rerun or matplotlib."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "Curve",
    "NullViewer",
    "Panel",
    "RerunViewer",
    "TrackPainter",
    "TrackVideo",
    "Viewer",
    "plot_bundle",
    "plot_errors",
    "plot_panels",
    "plot_pose_graph",
    "save_picture",
]

if TYPE_CHECKING:
    from slam_graph.visualization.plots import (
        Curve,
        Panel,
        plot_bundle,
        plot_errors,
        plot_panels,
        plot_pose_graph,
    )
    from slam_graph.visualization.rerun_viewer import RerunViewer
    from slam_graph.visualization.track_picture import TrackPainter, TrackVideo, save_picture
    from slam_graph.visualization.viewer import NullViewer, Viewer
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "plots": (
                "Curve",
                "Panel",
                "plot_bundle",
                "plot_errors",
                "plot_panels",
                "plot_pose_graph",
            ),
            "rerun_viewer": ("RerunViewer",),
            "track_picture": ("TrackPainter", "TrackVideo", "save_picture"),
            "viewer": ("NullViewer", "Viewer"),
        },
    )
