# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures and recordings: the only place that imports rerun or matplotlib."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "Panel",
    "Picture",
    "RerunRecording",
    "TrackPictures",
    "panel_figure",
]

if TYPE_CHECKING:
    from slam_graph.visualization.panels import Panel, panel_figure
    from slam_graph.visualization.rerun_recording import RerunRecording
    from slam_graph.visualization.style import Picture
    from slam_graph.visualization.track_picture import TrackPictures
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "panels": ("Panel", "panel_figure"),
            "rerun_recording": ("RerunRecording",),
            "style": ("Picture",),
            "track_picture": ("TrackPictures",),
        },
    )
