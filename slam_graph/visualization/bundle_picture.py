# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a bundle adjustment: three projections of the scene, and its errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from slam_graph.arrays import FloatArray
from slam_graph.visualization.style import VERMILION, Picture, drawing, line_styles

_WIDTH_INCHES = 6.4
"""Of the projection on the two longest axes."""
_LOWEST_INCHES, _HIGHEST_INCHES = 2.4, 6.0
"""Between these are the heights of projections, so that a flat scene has room for labels."""
_BORDER_INCHES = (1.6, 2.3)
_MOST_POINTS = 50_000
"""Of larger scenes an even selection of the points is drawn."""
_SHOWN_SHARE = 0.96
"""The scene is shown as far as this share of its points reaches along each axis, and all cameras
but the same share of outliers."""
_MARGIN = 0.06
_SMALLEST_PX = 1e-9
"""Lower end of the logarithmic histogram of errors."""
_AXES = ("first", "second", "third")


def bundle_figure(
    title: str,
    points: FloatArray,
    centres: FloatArray,
    errors_px: Mapping[str, FloatArray],
) -> Picture:
    """Three projections of the scene along its principal axes, and a histogram of the errors.

    Args:
        title: of the picture.
        points: (P, 3) in the world, in the unit of the problem.
        centres: (C, 3) of the cameras.
        errors_px: lengths of the reprojection errors, by the name of the stage, if they are known.
    """
    scene, cameras = _along_principal_axes(points, centres)
    low, high = _shown(scene, cameras)
    inside = ((scene >= low) & (scene <= high)).all(axis=1)
    hidden = len(scene) - int(inside.sum())
    drawn = scene[inside][:: 1 + int(inside.sum()) // _MOST_POINTS]
    size = float(np.clip(130.0 / np.sqrt(max(len(drawn), 1)), 0.8, 6.0))
    scale = _WIDTH_INCHES / (high - low)[0]
    upper, lower = np.clip(scale * (high - low)[1:], _LOWEST_INCHES, _HIGHEST_INCHES)
    right = max(float(lower), 3.0) if errors_px else float(lower)
    inches = (_WIDTH_INCHES + right + _BORDER_INCHES[0], upper + lower + _BORDER_INCHES[1])
    with drawing(title, inches) as figure:
        grid = figure.add_gridspec(
            2, 2, width_ratios=(_WIDTH_INCHES, right), height_ratios=(upper, lower)
        )
        for cell, (a, b) in {(0, 0): (0, 1), (1, 0): (0, 2), (0, 1): (2, 1)}.items():
            axes = figure.add_subplot(grid[cell])
            axes.plot(*drawn[:, (a, b)].T, ".", ms=size, color="0.35", alpha=0.6, mew=0)
            axes.plot(*cameras[:, (a, b)].T, "^", ms=5, color=VERMILION, mec="white", mew=0.4)
            axes.set(
                xlabel=f"{_AXES[a]} axis",
                ylabel=f"{_AXES[b]} axis",
                xlim=(low[a], high[a]),
                ylim=(low[b], high[b]),
            )
            axes.set_aspect("equal", adjustable="box", anchor="W")
        if errors_px:
            _draw_histogram(figure.add_subplot(grid[1, 1]), errors_px)
        _legend(figure, hidden)
    return figure


def _draw_histogram(axes: Any, errors_px: Mapping[str, FloatArray]) -> None:
    """The errors of each stage on a logarithmic axis, with their root mean squares."""
    shown = {stage: errors[np.isfinite(errors)] for stage, errors in errors_px.items()}
    bounds = np.concatenate([np.quantile(errors, (0.01, 1.0)) for errors in shown.values()])
    bins = np.geomspace(np.clip(bounds.min(), _SMALLEST_PX, 0.1), max(bounds.max(), 1.0), 80)
    styles = line_styles(shown)
    for stage, errors in shown.items():
        label = f"{stage}: RMS {np.sqrt(np.mean(errors**2)):.3g} px"
        colour = styles[stage].color
        axes.hist(errors, bins=bins, color=colour, alpha=0.25)
        axes.hist(errors, bins=bins, color=colour, histtype="step", linewidth=1.4, label=label)
    axes.set(xscale="log", xlabel="reprojection error [px]", ylabel="observations")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=1)


def _legend(figure: Picture, hidden: int) -> None:
    """Points and cameras, and how many points are too far away to be shown."""
    style = {"linestyle": "", "mew": 0}
    entries = {
        "points": Line2D([], [], marker=".", ms=7, color="0.35", **style),  # type: ignore[arg-type]
        "cameras": Line2D([], [], marker="^", ms=6, color=VERMILION, **style),  # type: ignore[arg-type]
    }
    if hidden:
        entries[f"{hidden} points are farther away"] = Line2D([], [], linestyle="")
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=len(entries)
    )


def _along_principal_axes(points: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points and cameras in the axes along which the cameras and most points spread widest."""
    middle = np.median(points, axis=0)
    away = points - middle
    distance = np.linalg.norm(away, axis=1)
    inner = np.concatenate([away[distance <= np.quantile(distance, 0.9)], centres - middle])
    axes = np.linalg.eigh(inner.T @ inner)[1][:, ::-1]
    return away @ axes, (centres - middle) @ axes


def _shown(scene: FloatArray, cameras: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner (3,) of what is shown: nearly all points, and the cameras."""
    tail = (1.0 - _SHOWN_SHARE) / 2.0
    low, high = np.quantile(scene, (tail, 1.0 - tail), axis=0)
    near, far = np.quantile(cameras, (tail, 1.0 - tail), axis=0)
    low, high = np.minimum(low, near), np.maximum(high, far)
    margin = _MARGIN * np.max(high - low)
    return low - margin, high + margin
