# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Where the panels of a picture lie: as large as their labels, the title and the legend leave room.

The constrained layout of Matplotlib does this for anything that can be drawn, and lays out all text
a dozen times; it took more time than all drawing. Here heights follow from the sizes of the fonts,
and only widths that depend on the numbers are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.layout_engine import LayoutEngine
from matplotlib.ticker import ScalarFormatter

_POINT = 1.0 / 72.0
"""One point in inches."""

_LINE, _NUMBER_LINE = 1.2, 1.1
"""Height of a line of text, in its font size, and of numbers."""

_TICK_PT, _LABEL_PAD_PT, _TITLE_PAD_PT = 7.0, 4.0, 6.0
"""Points from an axis to the numbers at its ticks, from these to its label; below a title."""

_HALF_TICK_PT = 3.5
"""Length of a tick in points, where there are no numbers."""

_BESIDE_INCHES, _ABOVE_INCHES = 0.07, 0.04
"""Free on both sides of each panel with its labels, and above and below."""

_FIRST_GUESS = (0.65, 0.1)
"""Left and right of the panels in inches, as a start."""

_MOST_ROUNDS, _SAME_INCHES = 3, 0.05
"""Which numbers are at the ticks depends a little on the size of the panel; it is placed again
until no side changes by more."""

_SMALLEST_INCHES = 0.4
"""A panel is at least as wide and high, whatever its labels need."""

_MOST_FILLED = 0.88
"""Part of the width of an axis that its numbers may fill, so that they stay apart."""


@dataclass(frozen=True)
class Column:
    """Panels above one another.

    Attributes:
        axes: from above.
        heights: (N,) of these, relative to each other.
        width: relative to those of other columns.
    """

    axes: Sequence[Any]
    heights: Sequence[float]
    width: float


class PanelLayout(LayoutEngine):
    """Columns of panels between a title and a legend.

    Args:
        columns: from the left.
        above_inches: kept free for the title.
        below_inches: kept free for the legend.
    """

    _adjust_compatible = False
    _colorbar_gridspec = False

    def __init__(self, columns: Sequence[Column], above_inches: float, below_inches: float) -> None:
        super().__init__()
        self._columns = columns
        self._above, self._below = above_inches, below_inches
        self._sides = [_FIRST_GUESS] * len(columns)

    def execute(self, fig: Any) -> None:
        """Place all panels; Matplotlib calls this before it draws."""
        self._place(fig)
        for _ in range(_MOST_ROUNDS):
            before = np.array(self._sides)
            self._sides = [self._room_beside(column, fig.dpi) for column in self._columns]
            self._place(fig)
            if np.abs(before - self._sides).max() < _SAME_INCHES:
                return

    def _place(self, figure: Any) -> None:
        """Give all panels their places, with the present room beside them."""
        width, height = figure.get_size_inches().tolist()
        shares = np.array([column.width for column in self._columns])
        free = width - sum(map(sum, self._sides))
        widths = np.maximum(free * shares / shares.sum(), _SMALLEST_INCHES)
        x = 0.0
        for column, (left, right), inner in zip(
            self._columns, self._sides, widths.tolist(), strict=True
        ):
            rooms = [_room_above_and_below(axes) for axes in column.axes]
            shares = np.asarray(column.heights, float)
            free = height - self._above - self._below - sum(map(sum, rooms))
            heights = np.maximum(free * shares / shares.sum(), _SMALLEST_INCHES)
            x += left
            y = height - self._above
            for axes, (above, below), tall in zip(
                column.axes, rooms, heights.tolist(), strict=True
            ):
                y -= above + tall
                axes.set_position((x / width, y / height, inner / width, tall / height))
                axes.apply_aspect()
                _place_labels(axes, left, inner, tall)
                y -= below
            x += inner + right

    def _room_beside(self, column: Column, dpi: float) -> tuple[float, float]:
        """Inches left and right of the panels of a column: numbers, labels, and what sticks out."""
        left = right = 0.0
        for axes in column.axes:
            numbers = _size(_numbers(axes.yaxis), dpi)[0]
            label = _label_inches(axes.yaxis)
            left = max(left, _TICK_PT * _POINT * (numbers > 0.0) + numbers + label)
            if not _has_numbers_below(axes):
                continue
            shown = _numbers(axes.xaxis)
            widest = _size(shown, dpi)[0]
            _thin_out(axes, len(shown), widest, dpi)
            left, right = max(left, widest / 2.0), max(right, widest / 2.0)
            for text in axes.texts:
                right = max(right, (text.get_window_extent().x1 - axes.bbox.x1) / dpi)
        return left + _BESIDE_INCHES, right + _BESIDE_INCHES


def _numbers(axis: Any) -> list[Any]:
    """The texts at the ticks of an axis that are in view."""
    low, high = sorted(axis.get_view_interval())
    margin = 1e-9 * (high - low)
    which = "major" if axis.get_scale() == "linear" else "both"
    return [
        label
        for label in axis.get_ticklabels(which=which)
        if label.get_text()
        and low - margin <= label.get_position()[axis.axis_name == "y"] <= high + margin
    ]


def _size(texts: Sequence[Any], dpi: float) -> tuple[float, float]:
    """Largest width and height in inches."""
    extents = [text.get_window_extent() for text in texts]
    sizes = [(extent.width / dpi, extent.height / dpi) for extent in extents] or [(0.0, 0.0)]
    return max(width for width, _ in sizes), max(height for _, height in sizes)


def _has_numbers_below(axes: Any) -> bool:
    """Whether there are numbers at the ticks of its x axis."""
    return bool(axes.xaxis.get_tick_params().get("labelbottom", True))


def _label_inches(axis: Any) -> float:
    """What the label of an axis takes, with the space between it and the numbers."""
    if not axis.get_label_text():
        return 0.0
    return float(_LABEL_PAD_PT + _LINE * axis.label.get_fontsize()) * _POINT


def _number_inches(axis: Any) -> float:
    """Height of the numbers at the ticks."""
    return float(_NUMBER_LINE * axis.get_major_ticks(1)[0].label1.get_fontsize()) * _POINT


def _offset_inches(axis: Any) -> float:
    """Height of what all numbers are multiplied by or added to, which is above a y axis."""
    if not axis.get_major_formatter().get_offset():
        return 0.0
    return float(3.0 + _LINE * axis.get_offset_text().get_fontsize()) * _POINT


def _room_above_and_below(axes: Any) -> tuple[float, float]:
    """Inches above and below a panel: title, numbers, label."""
    above = _offset_inches(axes.yaxis)
    title = axes.get_title(loc="left")
    if title:
        size = axes.title.get_fontsize()
        pad_pt = _TITLE_PAD_PT + above / _POINT
        # Matplotlib looks for no place where it is given one
        axes.set_title(title, loc="left", y=1.0, pad=pad_pt, fontsize=size)
        above += (_TITLE_PAD_PT + _LINE * size) * _POINT
    above = max(above, _number_inches(axes.yaxis) / 2.0)
    if not _has_numbers_below(axes):
        return above + _ABOVE_INCHES, _HALF_TICK_PT * _POINT + _ABOVE_INCHES
    below = _TICK_PT * _POINT + _number_inches(axes.xaxis) + _label_inches(axes.xaxis)
    return above + _ABOVE_INCHES, below + _ABOVE_INCHES


def _place_labels(axes: Any, left: float, width: float, height: float) -> None:
    """Labels of the axes: those of a column in one line, without looking at each number again."""
    away = left - _BESIDE_INCHES - _label_inches(axes.yaxis) + _LABEL_PAD_PT * _POINT
    axes.yaxis.set_label_coords(-away / width, 0.5)
    away = _TICK_PT * _POINT + _number_inches(axes.xaxis) + _LABEL_PAD_PT * _POINT
    axes.xaxis.set_label_coords(0.5, -away / height)


def _thin_out(axes: Any, count: int, widest: float, dpi: float) -> None:
    """Fewer ticks where their numbers would touch."""
    room = _MOST_FILLED * axes.bbox.width / dpi
    if isinstance(axes.xaxis.get_major_formatter(), ScalarFormatter) and count * widest > room:
        axes.locator_params(axis="x", nbins=max(1, int(room / widest) - 1))
