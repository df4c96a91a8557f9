# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How all pictures look: colours that colour-blind people can read, lines, fonts, and figures.

The palette is that of Okabe & Ito 2008, "Color Universal Design", without its yellow, which is too
pale on white. A name has one colour in all pictures.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image  # a requirement of matplotlib

BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
SKY, ORANGE, BLACK, GREY = "#56B4E9", "#E69F00", "#000000", "#7F7F7F"

COLOUR_NAMES = {
    BLUE: "blue",
    VERMILION: "red",
    GREEN: "green",
    PURPLE: "purple",
    SKY: "light blue",
    ORANGE: "orange",
    BLACK: "black",
    GREY: "grey",
}
"""What they are called in text."""

_PALETTE = (BLUE, VERMILION, GREEN, PURPLE, SKY, ORANGE, BLACK)

_KNOWN = {
    "ground truth": GREY,
    "causal": BLUE,
    "smoothed": VERMILION,
    "loops closed": GREEN,
    "in the map": PURPLE,
    "causal − smoothed": BLUE,
    "msckf": BLUE,
    "swf": VERMILION,
    "okvis": GREEN,
    "ekf": PURPLE,
    "iekf": ORANGE,
    "before": SKY,
    "after": VERMILION,
}
"""Colours of names that many pictures share."""

_VARIANT = "_no_fej"
"""What ends with this has the colour of the name before it, and is dashed."""

_FILE_DPI, _NOTEBOOK_DPI = 150, 100
_COMPRESSION = 3
"""Of a file: as small as with 6 and an opacity, in half the time."""
_COLOURS = 224
"""Of a light picture: as many as antialiased lines and letters need."""

_LOOK: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "axes.labelcolor": "0.15",
    "axes.edgecolor": "0.45",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.color": "0.35",
    "ytick.color": "0.35",
    "lines.linewidth": 1.3,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "figure.titlesize": 10.5,
}


@dataclass(frozen=True)
class LineStyle:
    """How the line of one name is drawn.

    Attributes:
        color: as matplotlib takes it.
        dash: as matplotlib takes it.
    """

    color: str
    dash: str = "-"


def line_styles(names: Iterable[str]) -> dict[str, LineStyle]:
    """A style for each name, no two alike: that of all pictures where it has one.

    Args:
        names: in order; those without a style of their own take what is left of the palette, and
            further dashes when it is used up.
    """
    names = list(dict.fromkeys(names))
    styles = {name: LineStyle(_KNOWN[name]) for name in names if name in _KNOWN}
    used = {style.color for style in styles.values()}
    left = [colour for colour in _PALETTE if colour not in used]
    free = [LineStyle(colour) for colour in left]
    free += [LineStyle(colour, dash) for dash in (":", "-.") for colour in _PALETTE]
    for name in names:
        base = name.removesuffix(_VARIANT)
        if name not in styles and base in styles:
            styles[name] = LineStyle(styles[base].color, "--")
        elif name not in styles:
            styles[name] = free.pop(0) if len(free) > 1 else free[0]
    return styles


class Picture(Figure):
    """A figure that needs no window, and shows itself in Jupyter without `%matplotlib`."""

    def png(self, dpi: int = _FILE_DPI) -> bytes:
        """The picture as a PNG file."""
        buffer = io.BytesIO()
        whole = self._drawn(dpi).convert("RGB")  # nothing is transparent
        whole.save(buffer, "PNG", dpi=(dpi, dpi), compress_level=_COMPRESSION)
        return buffer.getvalue()

    def _drawn(self, dpi: int) -> Image.Image:
        """The pixels, as `savefig` has them; that would draw everything twice."""
        before = self.dpi
        self.dpi = dpi
        try:
            canvas: Any = FigureCanvasAgg(self)
            canvas.draw()
            return Image.fromarray(np.asarray(canvas.buffer_rgba()))
        finally:
            self.dpi = before

    def light_png(self, dpi: int = _NOTEBOOK_DPI) -> bytes:
        """The picture as a PNG file with a palette, which keeps a notebook light."""
        whole = self._drawn(dpi).convert("RGB")
        reduced = whole.quantize(_COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        buffer = io.BytesIO()
        reduced.save(buffer, "PNG", optimize=True)
        return buffer.getvalue()

    def write(self, path: Path) -> None:
        """Write the picture as a PNG file, whatever its name ends with."""
        path.write_bytes(self.png())

    def _repr_png_(self) -> bytes:
        return self.light_png()


@contextmanager
def drawing(title: str, size_inches: tuple[float, float]) -> Iterator[Picture]:
    """An empty picture; what is drawn into it within the block has the common look.

    Args:
        title: above the picture, in one or more lines; none if empty.
        size_inches: width and height.
    """
    with rc_context(_LOOK):
        figure = Picture(figsize=size_inches, dpi=_NOTEBOOK_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        engine: Any = figure.get_layout_engine()
        engine.set(w_pad=0.07, h_pad=0.06)
        if title:
            figure.suptitle(title, x=0.012, ha="left", linespacing=1.35)
        yield figure
