# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a pose graph: the positions before and after, joined by the edges."""

from __future__ import annotations

from typing import Any

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.visualization.style import BLUE, VERMILION, Picture, drawing

_INCHES = (10.0, 5.0)


def pose_graph_figure(
    title: str,
    before: FloatArray,
    after: FloatArray,
    edges: IntArray,
    is_odometry: BoolArray,
    rejected: BoolArray,
) -> Picture:
    """A pose graph before and after its optimisation, side by side.

    Args:
        title: of the picture.
        before: (N, 2 or 3) positions in metres.
        after: (N, 2 or 3).
        edges: (M, 2) rows of the poses that each edge joins.
        is_odometry: (M,) which edges join consecutive poses; the others close loops.
        rejected: (M,) which edges the optimisation rejected; they are drawn only before it.
    """
    in_space = before.shape[1] == 3
    with drawing(title, _INCHES) as figure:
        for place, (name, positions) in enumerate((("before", before), ("after", after)), 1):
            axes: Any = figure.add_subplot(1, 2, place, projection="3d" if in_space else None)
            good = ~rejected
            loops = edges[good & ~is_odometry]
            _draw_edges(axes, positions, loops, color=BLUE, linewidth=0.35, alpha=0.5)
            _draw_edges(axes, positions, edges[good & is_odometry], color="0.2", linewidth=0.7)
            if name == "before":
                _draw_edges(
                    axes, positions, edges[rejected], color=VERMILION, linewidth=0.5, alpha=0.6
                )
            _dress(axes, name, positions, in_space)
        _legend(figure, bool(rejected.any()))
    return figure


def _dress(axes: Any, name: str, positions: FloatArray, in_space: bool) -> None:
    """Labels and scales of one of the two."""
    axes.set_title(name, loc="left")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    if in_space:
        axes.set_zlabel("z [m]")
        axes.set_box_aspect(np.maximum(np.ptp(positions, axis=0), 1e-3), zoom=0.9)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
    else:
        axes.set_aspect("equal", adjustable="datalim")


def _draw_edges(axes: Any, positions: FloatArray, edges: IntArray, **style: Any) -> None:
    """All edges as one line with gaps."""
    if len(edges) == 0:
        return
    gap = np.full((len(edges), positions.shape[1]), np.nan)
    points = np.stack([positions[edges[:, 0]], positions[edges[:, 1]], gap], axis=1)
    axes.plot(*points.reshape(-1, positions.shape[1]).T, **style)


def _legend(figure: Picture, rejected: bool) -> None:
    """The kinds of edges, with lines that are thick enough to be seen."""
    from matplotlib.lines import Line2D

    kinds = {"odometry": "0.2", "loop closure": BLUE}
    if rejected:
        kinds["rejected"] = VERMILION
    handles = [Line2D([], [], color=colour, linewidth=1.5) for colour in kinds.values()]
    figure.legend(handles, list(kinds), loc="outside lower center", ncols=len(kinds))
