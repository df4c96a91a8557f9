# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The colours of the viewer: those of Okabe and Ito, which colour-blind people can tell apart."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray

Colour = tuple[int, int, int]
Colours = NDArray[np.uint8]

_LIGHTER = 0.45
"""How much of white is mixed into a colour that stands for a dashed line: Rerun has no dashes."""

ORANGE: Colour = (230, 159, 0)
SKY: Colour = (86, 180, 233)
GREEN: Colour = (0, 158, 115)
YELLOW: Colour = (240, 228, 66)
BLUE: Colour = (0, 114, 178)
VERMILLION: Colour = (213, 94, 0)
PURPLE: Colour = (204, 121, 167)
GREY: Colour = (150, 150, 150)
LIGHT_GREY: Colour = (205, 205, 205)
WHITE: Colour = (255, 255, 255)

CAUSAL, SMOOTHED, TRUTH, LOOP, IN_MAP = SKY, VERMILLION, LIGHT_GREY, GREEN, PURPLE
"""Colours of the paths of a run."""

AXES = (VERMILLION, GREEN, SKY)
"""Colours of the axes x, y and z in series."""

CYCLE = (ORANGE, SKY, GREEN, PURPLE, YELLOW, VERMILLION, BLUE, LIGHT_GREY)
"""Colours of things of which there is any number."""

OBJECTS: tuple[Colour, ...] = (
    (68, 68, 255),
    (255, 255, 0),
    (0, 255, 136),
    (221, 0, 68),
    (85, 221, 238),
    (238, 187, 34),
    (68, 102, 204),
    (153, 68, 153),
    (170, 255, 102),
    (85, 238, 170),
)
"""Colours of moving objects. Okabe and Ito have too few: these were chosen one after another, each
as far as possible in CIELAB from the background, from what else is beside objects (green, grey,
purple, white, light blue, red) and from one another, also as people without red or green cones see
them (Machado et al. 2009)."""

_VIRIDIS: Colours = np.ascontiguousarray(
    cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS)[:, 0, ::-1], np.uint8
)

_DARKEST = 55
"""Where the scale begins: darker colours cannot be seen on the background."""

_ROBUST_PERCENT = (3.0, 97.0)
"""What is below or above these percentiles gets the colour at the end of the scale."""


def scaled(values: FloatArray, low: float, high: float) -> Colours:
    """Colours (N, 3) of values (N,) on the scale viridis, from dark blue (low) to yellow (high)."""
    part = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    return _VIRIDIS[(_DARKEST + (255 - _DARKEST) * part).astype(np.uint8)]


def line_colours(names: Iterable[str]) -> dict[str, tuple[Colour, str]]:
    """Colours of lines by their names, those of all pictures, and what these are called.

    On the dark background black is white, and what is dashed in pictures is lighter.
    """
    # matplotlib takes long to load, and only comparisons need it here
    from matplotlib.colors import to_rgb

    from slam_graph.visualization.style import BLACK, COLOUR_NAMES, line_styles

    found = {}
    for name, style in line_styles(names).items():
        colour, said = np.array(to_rgb(style.color)), COLOUR_NAMES[style.color]
        if style.color == BLACK:
            colour, said = 1.0 - colour, "white"
        if style.dash != "-":
            colour, said = colour + _LIGHTER * (1.0 - colour), f"lighter {said}"
        red, green, blue = np.rint(255 * colour).astype(int).tolist()
        found[name] = ((red, green, blue), said)
    return found


def robust_range(values: FloatArray) -> tuple[float, float]:
    """The range of most of the values (N,); (0, 1) where there are none."""
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return 0.0, 1.0
    low, high = np.percentile(values, _ROBUST_PERCENT)
    return float(low), float(high)


def by_height(points: FloatArray) -> Colours:
    """Colours (N, 3) of points (N, 3) by their height, over the range of most of them."""
    return scaled(points[:, 2], *robust_range(points[:, 2]))
