# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of results: a comparison's curves, a trajectory, a pose graph, a bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.geometry import Trajectory

_PANEL_INCHES = (5.6, 3.3)
_PANELS_DPI = 100
_COLUMNS = 2

_LOGARITHMIC_RANGE = 30.0
"""Curves whose medians differ by more than this factor are drawn on a logarithmic scale."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One diagram.

    Attributes:
        xlabel, ylabel: labels of its axes.
        curves: its lines by their labels: x and y (N,) each, NaN where there is a gap; one label
            has one colour in all panels of a picture.
        band: lower and upper bound of a shaded band, if there is one.
        band_label: label of the band.
    """

    xlabel: str
    ylabel: str
    curves: Mapping[str, tuple[FloatArray, FloatArray]]
    band: tuple[float, float] | None = None
    band_label: str = ""


def plot_panels(path: Path, title: str, panels: Sequence[Panel]) -> None:
    """Write a PNG with panels side by side, two in a row.

    Args:
        path: of the PNG.
        title: of the picture.
        panels: one or more.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    size = (_PANEL_INCHES[0] * columns, _PANEL_INCHES[1] * rows)
    figure = Figure(figsize=size, dpi=_PANELS_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    labels = list(dict.fromkeys(label for panel in panels for label in panel.curves))
    colours = {label: f"C{index % 10}" for index, label in enumerate(labels)}
    for index, panel in enumerate(panels):
        _plot_panel(figure.add_subplot(rows, columns, index + 1), panel, colours)
    figure.savefig(path, format="png")


def _plot_panel(axes: Any, panel: Panel, colours: dict[str, str]) -> None:
    if panel.band is not None:
        axes.axhspan(*panel.band, color="0.85", label=panel.band_label)
    for label, (x, y) in panel.curves.items():
        axes.plot(x, y, color=colours[label], linewidth=1.2, label=label)
    if _spread([y for _, y in panel.curves.values()]) > _LOGARITHMIC_RANGE:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set(xlabel=panel.xlabel, ylabel=panel.ylabel)
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="best", fontsize="small")


def _spread(curves: Sequence[FloatArray]) -> float:
    """Ratio of the largest to the smallest median."""
    known = [y[np.isfinite(y)] for y in curves]
    medians = [float(np.median(values)) for values in known if len(values)]
    if not medians or min(medians) <= 0.0:
        return 1.0
    return max(medians) / min(medians)


_TRAJECTORY_INCHES = (11.0, 4.5)
_PROBLEM_INCHES = (11.0, 5.2)
_RESULT_DPI = 110
_MOST_POINTS = 50_000
"""Of larger scenes an even selection of the points is drawn."""
_SHOWN_SPAN = 3.0
"""The scene is shown as far as this many times the distance within which 95 % of the points are."""
_SMALLEST_PX = 1e-9
"""Lower end of the logarithmic histogram of errors."""


def plot_errors(
    path: Path,
    title: str,
    truth: Trajectory,
    estimate: Trajectory,
    position_errors_m: FloatArray,
    rotation_errors_deg: FloatArray,
    stamps_ns: IntArray,
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
    figure = _figure(title, _TRAJECTORY_INCHES)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.2, 1.0))
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


def plot_pose_graph(
    path: Path,
    title: str,
    before: FloatArray,
    after: FloatArray,
    edges: IntArray,
    rejected: BoolArray,
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
    figure = _figure(title, _PROBLEM_INCHES)
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


def _draw_edges(axes: Any, positions: FloatArray, edges: IntArray, **style: Any) -> None:
    """All edges as one line with gaps."""
    if len(edges) == 0:
        return
    gap = np.full((len(edges), positions.shape[1]), np.nan)
    points = np.stack([positions[edges[:, 0]], positions[edges[:, 1]], gap], axis=1)
    axes.plot(*points.reshape(-1, positions.shape[1]).T, **style)


def plot_bundle(
    path: Path,
    title: str,
    points: FloatArray,
    centres: FloatArray,
    errors_px: Mapping[str, FloatArray],
) -> None:
    """Write a PNG with the scene along its flattest direction, and a histogram of the errors.

    Args:
        path: of the PNG.
        title: of the picture.
        points: (P, 3) in the world.
        centres: (C, 3) of the cameras.
        errors_px: lengths of the reprojection errors, by the name of the stage.
    """
    figure = _figure(title, _PROBLEM_INCHES)
    scene, histogram = figure.subplots(1, 2)
    flat, flat_centres = _flattened(points, centres)
    scene.plot(*flat[:: 1 + len(flat) // _MOST_POINTS].T, ".", markersize=1, color="0.5")
    scene.plot(*flat_centres.T, "^", markersize=4, color="tab:red")
    reach = _SHOWN_SPAN * max(
        float(np.quantile(np.abs(flat), 0.95)), float(np.quantile(np.abs(flat_centres), 0.95)) / 2
    )
    if 0 < reach < np.abs(flat).max():
        scene.set(xlim=(-reach, reach), ylim=(-reach, reach))
    scene.set_aspect("equal", adjustable="box")
    scene.set_title("points and cameras", fontsize="medium")
    shown = {stage: errors[np.isfinite(errors)] for stage, errors in errors_px.items()}
    bounds = np.concatenate([np.quantile(errors, (0.01, 1.0)) for errors in shown.values()])
    bins = np.geomspace(np.clip(bounds.min(), _SMALLEST_PX, 0.1), max(bounds.max(), 1.0), 80)
    for stage, errors in shown.items():
        histogram.hist(errors, bins=bins, histtype="step", label=stage)
    histogram.set(xscale="log", xlabel="reprojection error [px]", ylabel="observations")
    histogram.legend()
    histogram.grid(alpha=0.3)
    figure.savefig(path, format="png")


def _flattened(points: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points and cameras on the plane on which the cameras and most points spread widest."""
    middle = np.median(points, axis=0)
    away = points - middle
    near = np.linalg.norm(away, axis=1)
    inner = np.concatenate([away[near <= np.quantile(near, 0.9)], centres - middle])
    axes = np.linalg.eigh(inner.T @ inner)[1][:, :0:-1]
    return away @ axes, (centres - middle) @ axes


def _figure(title: str, size_inches: tuple[float, float]) -> Any:
    """An empty figure that needs no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_inches, dpi=_RESULT_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    return figure
