# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A picture of a trajectory beside the truth: seen from above, and its errors over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.geometry.trajectory import Trajectory

SIZE_INCHES = (11.0, 4.5)
DPI = 110


def plot_errors(
    path: Path,
    title: str,
    truth: Trajectory,
    estimate: Trajectory,
    position_errors_m: FloatArray,
    rotation_errors_deg: FloatArray,
    stamps_ns: NDArray[np.int64],
) -> None:
    """Write a PNG with the view from above and the errors over time.

    Args:
        path: of the PNG.
        title: of the picture.
        truth: true poses.
        estimate: estimated poses, aligned with the truth.
        position_errors_m: (N,) absolute errors.
        rotation_errors_deg: (N,) absolute errors.
        stamps_ns: (N,) their times.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.2, 1.0))
    figure.suptitle(title)
    _plot_top_view(figure.add_subplot(grid[:, 0]), truth, estimate)
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    above, below = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    _plot_series(above, seconds, position_errors_m, "position error [m]")
    _plot_series(below, seconds, rotation_errors_deg, "rotation error [deg]")
    below.set_xlabel("time [s]")
    figure.savefig(path, format="png")


def _plot_top_view(axes: Any, truth: Trajectory, estimate: Trajectory) -> None:
    """Both paths on the ground plane, to the same scale."""
    axes.plot(*truth.positions[:, :2].T, color="0.6", linewidth=2.5, label="ground truth")
    axes.plot(*estimate.positions[:, :2].T, color="tab:blue", linewidth=1.2, label="estimate")
    axes.plot(*estimate.positions[0, :2], "o", color="tab:green", label="first estimate")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize="small")


def _plot_series(axes: Any, seconds: FloatArray, values: FloatArray, label: str) -> None:
    """One series of errors."""
    axes.plot(seconds, values, color="tab:red", linewidth=1.0)
    axes.set_ylabel(label)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
