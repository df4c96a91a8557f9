# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A small picture of the path of a run from above, as SVG: a few hundred bytes, sharp at any size.

The colours are those of the other pictures (Okabe & Ito 2008), which colour-blind people can read.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.evaluation import ape
from slam_graph.geometry import Trajectory
from slam_graph.results import SavedRun

TRUE, CAUSAL, SMOOTHED = "#7F7F7F", "#0072B2", "#D55E00"

_WIDTH, _HEIGHT, _MARGIN = 170, 110, 8
_FOOT = 14
"""Height of the scale below the path, pixels."""
_POINTS = 150
_SHORTEST_M = 0.1
"""A path that is smaller is drawn as large as this: a standstill is a point."""


def thumbnail(run: SavedRun) -> str:
    """The paths of a run as an SVG element, x to the right, y up, with a scale.

    Raises:
        DataError: if a file of the run is damaged.
    """
    paths = [(color, path) for color, path in _paths(run) if len(path)]
    if not paths:
        return ""
    points = np.concatenate([path for _, path in paths])
    low, high = points.min(axis=0), points.max(axis=0)
    room = np.array([_WIDTH - 2 * _MARGIN, _HEIGHT - 2 * _MARGIN - _FOOT])
    scale = float(np.min(room / np.maximum(high - low, _SHORTEST_M)))
    middle = np.array([_WIDTH / 2, (_HEIGHT - _FOOT) / 2])
    lines = [
        _polyline(middle + scale * (path - (low + high) / 2) * [1, -1], color)
        for color, path in paths
    ]
    end = middle + scale * (paths[-1][1][0] - (low + high) / 2) * [1, -1]
    start = f'<circle cx="{end[0]:.1f}" cy="{end[1]:.1f}" r="2.6" fill="#000"/>'
    return (
        f'<svg width="{_WIDTH}" height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="path from above">{"".join(lines)}{start}{_ruler(scale)}</svg>'
    )


def _paths(run: SavedRun) -> list[tuple[str, FloatArray]]:
    """Colour and horizontal path of truth and estimates, in the world of the truth."""
    truth = run.groundtruth
    drawn = [] if truth is None else [(TRUE, _thinned(truth))]
    for color, estimate in ((CAUSAL, run.trajectory), (SMOOTHED, run.smoothed)):
        if estimate is None or not len(estimate):
            continue
        if truth is not None:
            try:
                breaks = run.metrics["extent"].get("world_breaks_ns", [])
                found = ape(truth, estimate, alignment=run.unmeasured, breaks_ns=breaks)
                estimate = found.alignment.apply(estimate)
            except DataError:  # no common time: the two cannot be shown in one world
                drawn = [path for path in drawn if path[0] != TRUE]
        drawn.append((color, _thinned(estimate)))
    return drawn


def _thinned(trajectory: Trajectory) -> FloatArray:
    """(P, 2) horizontal positions at evenly spread poses."""
    count = len(trajectory)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _POINTS)).round().astype(int))
    return np.asarray(trajectory.positions)[chosen, :2]


def _polyline(points: FloatArray, color: str) -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    width = 2.6 if color == TRUE else 1.3
    return (
        f'<polyline points="{text}" fill="none" stroke="{color}" stroke-width="{width}" '
        'stroke-linejoin="round" stroke-linecap="round"/>'
    )


def _ruler(scale: float) -> str:
    """A line of a round length at the lower left, and this length.

    Args:
        scale: pixels per metre.
    """
    most_m = 0.35 * _WIDTH / scale
    power = 10.0 ** np.floor(np.log10(most_m))
    length_m = max(step * power for step in (1, 2, 5) if step * power <= most_m)
    y, x = _HEIGHT - 5, _MARGIN
    return (
        f'<path d="M{x} {y - 3}v3h{scale * length_m:.1f}v-3" fill="none" stroke="#555"/>'
        f'<text x="{x + scale * length_m + 5:.1f}" y="{y + 1}" font-size="10" '
        f'font-family="system-ui,sans-serif" fill="#555">{length_m:g} m</text>'
    )
