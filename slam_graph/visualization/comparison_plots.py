# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of many curves, for the comparison of algorithms over time or distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray

_PANEL_INCHES = (5.6, 3.3)
_DPI = 100
_COLUMNS = 2

_LOGARITHMIC_RANGE = 30.0
"""Curves whose medians differ by more than this factor are drawn on a logarithmic scale."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One line: N points, NaN where there is a gap."""

    label: str
    x: FloatArray
    y: FloatArray


@dataclass(frozen=True, eq=False)
class Panel:
    """One diagram.

    Attributes:
        xlabel, ylabel: labels of its axes.
        curves: its lines; one label has one colour in all panels of a picture.
        band: lower and upper bound of a shaded band, if there is one.
        band_label: label of the band.
    """

    xlabel: str
    ylabel: str
    curves: Sequence[Curve]
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
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    colours = {label: f"C{index % 10}" for index, label in enumerate(labels)}
    for index, panel in enumerate(panels):
        _plot_panel(figure.add_subplot(rows, columns, index + 1), panel, colours)
    figure.savefig(path, format="png")


def _plot_panel(axes: Any, panel: Panel, colours: dict[str, str]) -> None:
    if panel.band is not None:
        axes.axhspan(*panel.band, color="0.85", label=panel.band_label)
    for curve in panel.curves:
        axes.plot(curve.x, curve.y, color=colours[curve.label], linewidth=1.2, label=curve.label)
    if _spread(panel.curves) > _LOGARITHMIC_RANGE:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set(xlabel=panel.xlabel, ylabel=panel.ylabel)
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="best", fontsize="small")


def _spread(curves: Sequence[Curve]) -> float:
    """Ratio of the largest to the smallest median."""
    known = [curve.y[np.isfinite(curve.y)] for curve in curves]
    medians = [float(np.median(values)) for values in known if len(values)]
    if not medians or min(medians) <= 0.0:
        return 1.0
    return max(medians) / min(medians)
