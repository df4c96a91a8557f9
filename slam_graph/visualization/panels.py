# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of panels: curves with bounds, paths to one scale, and bars or boxes of samples."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.visualization.style import GREY, LineStyle, Picture, drawing, line_styles

_CELL_INCHES = (5.2, 2.9)
_COLUMNS = 2

_LOGARITHMIC_RANGE = 30.0
"""Curves whose medians differ by more than this factor are drawn on a logarithmic scale."""

_REFERENCES = ("ground truth",)
"""Curves that the others are compared with: drawn wide, and below them."""

_MOST_DOTS = 4000
"""Of more points an even selection is drawn."""

_ROW_INCHES, _FRAME_INCHES = 0.36, 0.85
"""Height of a bar or box with the space around it, and of the axis and its labels below them."""

_ROOM_FOR_NUMBER = 0.2
"""Part of a panel of bars that is kept free for the number behind the longest."""

_WIDEST: dict[str, float] = {"path": 3.4, "errors": 1.8}
_NARROWEST = 1.0
"""Widths in points between which the lines of a panel fall in their order, so that one which covers
another leaves its edges to be seen."""

_BOUNDS_REACH = 3.0
"""Bounds are shown as far as this many times the largest value, or their own median."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One diagram.

    Attributes:
        xlabel, ylabel: labels of its axes.
        curves: its lines by their labels: x and y (N,) each, NaN where there is a gap; one label
            has one colour in all panels of a picture.
        kind: `curves` from zero on, logarithmic where they differ much; `series` of any values;
            `errors` with a sign, around zero; `path` with the same scale on both axes.
        band: lower and upper bound of a shaded band, if there is one.
        band_label: label of the band.
        bounds: by the label of a curve x and the half width (N,) of what is shaded around zero.
        samples: values (N,) by their labels: a bar where all have one value, else boxes.
        ideal: the value that samples or curves should have, if there is one.
        dots: (N, 2) points in the background, if there are any.
        title: above the panel.
    """

    xlabel: str
    ylabel: str
    curves: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    kind: Literal["curves", "series", "errors", "path"] = "curves"
    band: tuple[float, float] | None = None
    band_label: str = ""
    bounds: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    samples: Mapping[str, FloatArray] = field(default_factory=dict)
    ideal: float | None = None
    dots: FloatArray | None = None
    title: str = ""


def panel_figure(
    title: str,
    panels: Sequence[Panel],
    columns: Sequence[str] = (),
    widths_inches: Sequence[float] = (),
    height_inches: float = 0.0,
) -> Picture:
    """A picture of panels with one legend below.

    Args:
        title: of the picture; further lines say more.
        panels: one or more.
        columns: the panels of each column from above, as letters that are repeated for height:
            `("AAB", "CCC")` has the second panel below the first, half as high, and the third
            beside both. Two columns if not given.
        widths_inches: of the columns.
        height_inches: of the columns.
    """
    letters = [chr(ord("A") + index) for index in range(len(panels))]
    columns = columns or ["".join(letters[k::_COLUMNS]) for k in range(min(_COLUMNS, len(letters)))]
    height_inches = height_inches or _cell_height(panels) * max(map(len, columns))
    widths_inches = widths_inches or [_CELL_INCHES[0]] * len(columns)
    styles = line_styles(_labels(panels))
    drawn: list[Any] = []
    with drawing(title, (sum(widths_inches), height_inches + 0.5)) as figure:
        outer = figure.add_gridspec(1, len(columns), width_ratios=widths_inches)
        for k, column in enumerate(columns):
            heights = [column.count(letter) for letter in dict.fromkeys(column)]
            inner = outer[k].subgridspec(len(heights), 1, height_ratios=heights)
            shown = [panels[letters.index(letter)] for letter in dict.fromkeys(column)]
            axes = [figure.add_subplot(inner[row]) for row in range(len(shown))]
            for place, panel in zip(axes, shown, strict=True):
                _draw(place, panel, styles)
            _share_x(axes, shown)
            figure.align_ylabels(axes)
            drawn += axes
        _legend(figure, drawn)
    return figure


def _cell_height(panels: Sequence[Panel]) -> float:
    """Height of a panel in inches; panels of samples alone are as high as these need."""
    if not all(panel.samples for panel in panels):
        return _CELL_INCHES[1]
    return _FRAME_INCHES + _ROW_INCHES * max(len(panel.samples) for panel in panels)


def _labels(panels: Sequence[Panel]) -> list[str]:
    """All labels, in the order in which they come."""
    return [label for panel in panels for label in (*panel.curves, *panel.samples, *panel.bounds)]


def _draw(axes: Any, panel: Panel, styles: Mapping[str, LineStyle]) -> None:
    if panel.title:
        axes.set_title(panel.title, loc="left")
    axes.set(xlabel=panel.xlabel, ylabel=panel.ylabel)
    if panel.samples:
        _draw_samples(axes, panel, styles)
        return
    if not panel.curves and not panel.bounds:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "nothing to show", ha="center", color=GREY, transform=axes.transAxes)
        return
    if panel.band is not None:
        axes.axhspan(*panel.band, color="0.88", label=panel.band_label, zorder=0.5)
    if panel.dots is not None:
        dots = panel.dots[:: 1 + len(panel.dots) // _MOST_DOTS]
        axes.plot(*dots.T, ".", markersize=1.2, color="0.72", label="features", zorder=1)
    for label, (x, half) in panel.bounds.items():
        colour = styles[label].color
        axes.fill_between(
            x, -half, half, color=colour, alpha=0.16, linewidth=0, label=f"±3σ {label}"
        )
        axes.plot(x, half, x, -half, color=colour, alpha=0.5, linewidth=0.6)
    if panel.ideal is not None:
        axes.axhline(panel.ideal, color=GREY, linestyle="--", lw=1.0, zorder=1.5, label="ideal")
    _draw_curves(axes, panel, styles)
    if panel.kind == "path":
        axes.set_aspect("equal", adjustable="datalim")
        _mark_start(axes, panel.curves)
    elif panel.kind == "errors":
        _limit_errors(axes, panel)
    elif panel.kind == "series":
        return
    elif _spread([y for _, y in panel.curves.values()]) > _LOGARITHMIC_RANGE:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)


def _draw_curves(axes: Any, panel: Panel, styles: Mapping[str, LineStyle]) -> None:
    """All lines, the first the widest; a reference that others are compared with is below them."""
    compared = [label for label in panel.curves if label not in _REFERENCES] or list(panel.curves)
    widest = _WIDEST.get(panel.kind, 1.2) if len(compared) > 1 else 1.2
    widths = np.linspace(widest, min(_NARROWEST, widest), len(compared))
    if panel.kind not in _WIDEST:
        widths[:] = widest
    width_of = dict(zip(compared, widths.tolist(), strict=True))
    for label, (x, y) in panel.curves.items():
        reference = label not in width_of
        axes.plot(
            x,
            y,
            color=styles[label].color,
            linestyle=styles[label].dash,
            linewidth=width_of.get(label, 2.0 + widest),
            alpha=0.55 if reference else 1.0,
            solid_capstyle="round",
            label=label,
            zorder=2.0 if reference else 2.5,
        )


def _mark_start(axes: Any, curves: Mapping[str, tuple[FloatArray, FloatArray]]) -> None:
    """A ring where the first path that is no reference starts."""
    for label, (x, y) in curves.items():
        if label not in _REFERENCES and len(x):
            axes.plot(
                x[0], y[0], "o", ms=6, mfc="white", mec="black", mew=1.2, label="start", zorder=4
            )
            return


def _limit_errors(axes: Any, panel: Panel) -> None:
    """Show all errors and, if they are not far wider, their bounds."""
    axes.axhline(0.0, color=GREY, linewidth=0.6, zorder=1.5)
    errors = _largest(y for _, y in panel.curves.values())
    bounds = [half[np.isfinite(half)] for _, half in panel.bounds.values()]
    widest = _largest(bounds)
    typical = max((float(np.median(half)) for half in bounds if len(half)), default=0.0)
    reach = max(errors, min(widest, _BOUNDS_REACH * max(errors, typical)))
    if reach > 0.0:
        axes.set_ylim(-1.08 * reach, 1.08 * reach)


def _largest(arrays: Iterable[FloatArray]) -> float:
    """The largest finite magnitude; 0 if there is none."""
    return max((float(np.nanmax(np.abs(a))) for a in arrays if np.isfinite(a).any()), default=0.0)


def _spread(curves: Sequence[FloatArray]) -> float:
    """Ratio of the largest to the smallest median."""
    known = [y[np.isfinite(y)] for y in curves]
    medians = [float(np.median(values)) for values in known if len(values)]
    if not medians or min(medians) <= 0.0:
        return 1.0
    return max(medians) / min(medians)


def _draw_samples(axes: Any, panel: Panel, styles: Mapping[str, LineStyle]) -> None:
    """Bars with their values, or boxes with samples and median; the first label is at the top."""
    samples = panel.samples
    places = [float(place) for place in range(len(samples), 0, -1)]
    middles = [float(np.median(values)) if len(values) else np.nan for values in samples.values()]
    single = all(len(values) <= 1 for values in samples.values())
    for place, (label, values), middle in zip(places, samples.items(), middles, strict=True):
        colour = styles[label].color
        if single and len(values):
            axes.barh(place, middle, height=0.62, color=colour, alpha=0.85)
        elif len(values):
            _draw_box(axes, place, values, colour)
        end = float(values.max()) if len(values) else 0.0
        text = f" {middle:.3g}" if len(values) else " no run ended well"
        axes.annotate(
            text, (end, place), xytext=(4, 0), textcoords="offset points", va="center", size=8
        )
    if panel.ideal is not None:
        axes.axvline(panel.ideal, color=GREY, linestyle="--", linewidth=1.0, zorder=0.5)
    axes.set_yticks(places, list(samples))
    axes.set_ylim(0.4, len(samples) + (0.6 if panel.ideal is None else 1.0))
    if panel.ideal is not None:
        top = axes.get_ylim()[1]
        axes.annotate(" ideal", (panel.ideal, top), va="top", color="0.4", size=8)
    _limit_samples(axes, panel, middles)
    axes.grid(visible=False, axis="y")


def _limit_samples(axes: Any, panel: Panel, middles: Sequence[float]) -> None:
    """Show all samples, the ideal, and the number behind the longest."""
    shown = [values for values in panel.samples.values() if len(values)]
    shown += [] if panel.ideal is None else [np.array([panel.ideal])]
    if not shown:
        return
    everything = np.concatenate(shown)
    low, high = float(everything.min()), float(everything.max())
    if low > 0.0 and _spread([np.array([middle]) for middle in middles]) > _LOGARITHMIC_RANGE:
        axes.set_xscale("log")
        low /= 2.0  # where bars start
        axes.set_xlim(low, high * (high / low) ** (_ROOM_FOR_NUMBER / (1.0 - _ROOM_FOR_NUMBER)))
    elif high > 0.0:
        axes.set_xlim(0.0, high / (1.0 - _ROOM_FOR_NUMBER))


def _draw_box(axes: Any, place: float, values: FloatArray, colour: str) -> None:
    """A box from quartile to quartile, whiskers to the ends, and a dot for each sample."""
    axes.boxplot(
        values,
        positions=[place],
        orientation="horizontal",
        widths=0.55,
        whis=(0, 100),
        patch_artist=True,
        boxprops={"facecolor": colour, "alpha": 0.35, "edgecolor": colour},
        medianprops={"color": colour, "linewidth": 2.0},
        whiskerprops={"color": colour},
        capprops={"color": colour},
        manage_ticks=False,
    )
    axes.plot(values, np.full(len(values), place), "o", ms=3, color=colour, zorder=3)


def _share_x(axes: Sequence[Any], panels: Sequence[Panel]) -> None:
    """Series above one another with the same x get one axis, labelled at the lowest."""
    for k in range(len(panels) - 1):
        upper, lower = panels[k], panels[k + 1]
        if (
            upper.kind == lower.kind != "curves"
            and upper.kind != "path"
            and upper.xlabel == lower.xlabel
        ):
            axes[k].sharex(axes[k + 1])
            axes[k].tick_params(labelbottom=False)
            axes[k].set_xlabel("")


def _legend(figure: Picture, cells: Iterable[Any]) -> None:
    """One legend for all panels, below them, with as many columns as there is room for."""
    entries: dict[str, Any] = {}
    for axes in cells:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if len(set(entries) - {"start"}) <= 1:
        return
    for ncols in range(min(len(entries), 8), 0, -1):
        legend = figure.legend(
            entries.values(),
            entries.keys(),
            loc="outside lower center",
            ncols=ncols,
            columnspacing=1.6,
            handlelength=1.8,
        )
        if ncols == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()
