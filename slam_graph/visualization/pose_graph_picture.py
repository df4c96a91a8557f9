# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a pose graph: the positions before and after, joined by its edges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.visualization.style import BLUE, VERMILION, Picture, drawing

_INCHES = (5.0, 5.0)
"""Of one state."""


def pose_graph_figure(
    title: str,
    states: Mapping[str, FloatArray],
    edges: IntArray,
    is_odometry: BoolArray,
    rejected: BoolArray | None = None,
) -> Picture:
    """A pose graph in one or more states, side by side, such as before and after optimisation.

    Args:
        title: of the picture.
        states: (N, 2 or 3) positions in metres, by the name of the state.
        edges: (M, 2) rows of the poses that each edge joins.
        is_odometry: (M,) which edges are odometry; the others close loops.
        rejected: (M,) which edges the optimisation rejected; they are drawn in the first state.
    """
    rejected = np.zeros(len(edges), bool) if rejected is None else rejected
    kinds = {
        "loop closure": (edges[~rejected & ~is_odometry], BLUE, 0.35, 0.5),
        "odometry": (edges[~rejected & is_odometry], "0.2", 0.7, 1.0),
        "rejected": (edges[rejected], VERMILION, 0.5, 0.6),
    }
    with drawing(title, (_INCHES[0] * len(states), _INCHES[1])) as figure:
        for place, (name, positions) in enumerate(states.items(), 1):
            in_space = positions.shape[1] == 3
            axes: Any = figure.add_subplot(
                1, len(states), place, projection="3d" if in_space else None
            )
            for kind, (rows, colour, width, alpha) in kinds.items():
                if kind != "rejected" or place == 1:
                    _draw_edges(axes, positions, rows, color=colour, linewidth=width, alpha=alpha)
            _dress(axes, name if len(states) > 1 else "", positions, in_space)
        shown = {kind: colour for kind, (rows, colour, _, _) in kinds.items() if len(rows)}
        _legend(figure, shown)
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


def _legend(figure: Picture, kinds: Mapping[str, str]) -> None:
    """The kinds of edges, with lines that are thick enough to be seen."""
    handles = [Line2D([], [], color=colour, linewidth=1.5) for colour in kinds.values()]
    figure.legend(handles, list(kinds), loc="outside lower center", ncols=len(kinds) or 1)
