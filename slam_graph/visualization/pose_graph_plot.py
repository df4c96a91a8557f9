# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A picture of a pose graph before and after its optimisation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray

SIZE_INCHES = (11.0, 5.2)
DPI = 110


def plot_pose_graph(
    path: Path,
    title: str,
    before: FloatArray,
    after: FloatArray,
    edges: NDArray[np.int64],
    rejected: NDArray[np.bool_],
) -> None:
    """Write a PNG with the positions before and after, joined by the edges.

    Args:
        path: of the PNG.
        title: of the picture.
        before: (N, 2 or 3) positions in metres.
        after: (N, 2 or 3).
        edges: (M, 2) rows of the poses that each edge joins.
        rejected: (M,) which edges the optimisation rejected; they are drawn only before it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    in_space = before.shape[1] == 3
    for place, (name, positions) in enumerate((("before", before), ("after", after)), 1):
        axes: Any = figure.add_subplot(1, 2, place, projection="3d" if in_space else None)
        _draw_edges(axes, positions, edges[~rejected], color="tab:blue", linewidth=0.5)
        if name == "before":
            _draw_edges(axes, positions, edges[rejected], color="tab:red", linewidth=0.3, alpha=0.4)
        axes.set_title(name, fontsize="medium")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        if in_space:
            axes.set_zlabel("z [m]")
            axes.set_box_aspect(np.maximum(np.ptp(positions, axis=0), 1e-3))
        else:
            axes.set_aspect("equal", adjustable="datalim")
            axes.grid(alpha=0.3)
    figure.savefig(path, format="png")


def _draw_edges(axes: Any, positions: FloatArray, edges: NDArray[np.int64], **style: Any) -> None:
    """All edges as one line with gaps."""
    if len(edges) == 0:
        return
    gap = np.full((len(edges), positions.shape[1]), np.nan)
    points = np.stack([positions[edges[:, 0]], positions[edges[:, 1]], gap], axis=1)
    axes.plot(*points.reshape(-1, positions.shape[1]).T, **style)
