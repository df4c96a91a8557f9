# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A picture of a bundle adjustment: the scene, and the reprojection errors before and after."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from slam_graph.arrays import FloatArray

SIZE_INCHES = (11.0, 5.2)
DPI = 110
MOST_POINTS = 50_000
SHOWN_SPAN = 3.0
"""The scene is shown as far as this many times the distance within which 95 % of the points are."""
SMALLEST_PX = 1e-9
"""The histogram, which is logarithmic, begins here."""


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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    scene, histogram = figure.subplots(1, 2)
    flat, flat_centres = _flattened(points, centres)
    scene.plot(*flat[:: 1 + len(flat) // MOST_POINTS].T, ".", markersize=1, color="0.5")
    scene.plot(*flat_centres.T, "^", markersize=4, color="tab:red")
    reach = SHOWN_SPAN * max(
        float(np.quantile(np.abs(flat), 0.95)), float(np.quantile(np.abs(flat_centres), 0.95)) / 2
    )
    if 0 < reach < np.abs(flat).max():
        scene.set(xlim=(-reach, reach), ylim=(-reach, reach))
    scene.set_aspect("equal", adjustable="box")
    scene.set_title("points and cameras", fontsize="medium")
    shown = {stage: errors[np.isfinite(errors)] for stage, errors in errors_px.items()}
    bounds = np.concatenate([np.quantile(errors, (0.01, 1.0)) for errors in shown.values()])
    bins = np.geomspace(np.clip(bounds.min(), SMALLEST_PX, 0.1), max(bounds.max(), 1.0), 80)
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
