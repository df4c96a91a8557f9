# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The factor graph of a window and its information matrix, before and after marginalization.

Circles are variables, lines are factors: a projection joins a landmark and a pose, the dynamics
join the states of two frames, and the prior, the purple circle below, is joined to all that it
knows something of. What is red leaves in this step. A matrix shows |Λᵢⱼ| / √(Λᵢᵢ Λⱼⱼ) on a
logarithmic scale; what is exactly zero is left dark, so that marginalization is seen to fill it.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.backend import Estimator, WindowGraph
from slam_graph.visualization.rerun_palette import (
    GREEN,
    LIGHT_GREY,
    PURPLE,
    SKY,
    VERMILLION,
    YELLOW,
    Colour,
    scaled,
)
from slam_graph.visualization.rerun_stream import RerunStream

_WIDTH, _ROW, _LANDMARK_ROWS = 1900.0, 34.0, 7
_LEAST = -4.0
"""Logarithm of the smallest normalised information that has a colour of its own."""

_LEVELS = 48
"""Of the scale of colours."""

_EMPTY = (24, 28, 38)
_KINDS = {"x": "poses", "v": "velocity", "b": "biases", "l": "features"}
_COLOURS: dict[str, Colour] = {"x": SKY, "v": YELLOW, "b": YELLOW, "l": GREEN}


@dataclass(frozen=True, eq=False)
class _Window:
    """The variables of a step in the order in which they are shown, and what becomes of them."""

    graph: WindowGraph
    stays: frozenset[int]

    @cached_property
    def keys(self) -> list[int]:
        """What leaves, then what stays: features, calibration, states in the order of time."""
        return sorted(self.graph.values.keys(), key=self._rank)

    def _rank(self, key: int) -> tuple[int, int, int]:
        kind, index = _kind(key), gtsam.Symbol(key).index()
        stays = 3 * (key in self.stays)
        if kind == "l":
            return stays, index, 0
        return (stays + 2, index, "xvb".index(kind)) if kind in "xvb" else (stays + 1, index, 0)

    def group(self, key: int) -> tuple[str, Colour]:
        """Name and colour of the block that a variable belongs to."""
        kind = _kind(key)
        if key not in self.stays:
            return f"{'states' if kind in 'xvb' else 'features'} that leave", VERMILLION
        if kind in "xvb":
            return "states", SKY
        return _KINDS.get(kind, "calibration"), _COLOURS.get(kind, PURPLE)


def show_window(stream: RerunStream, estimator: Estimator) -> None:
    """Log the cost of the last step as a graph, and its information before and after it.

    Args:
        stream: where it goes, at the time that was set.
        estimator: after a step.
    """
    window = estimator.window
    if window is None:
        return
    after = window.prior
    shown = _Window(estimator.factor_graph(), frozenset(window.state.estimate.keys()))
    _log_graph(stream, shown)
    linear = shown.graph.linearize()
    ordering = gtsam.Ordering()
    for key in shown.keys:
        ordering.push_back(key)
    before = np.asarray(linear.hessian(ordering)[0])
    dims = _dims(shown.graph.values, shown.keys)
    _log_matrix(stream, "window/before", before, shown, dims)
    # what no factor of the prior knows of has its factors still: it comes with the next window
    kept = [key for key in shown.keys if key in after.layout]
    R = after.R[:, after.layout.indices(kept)]
    _log_matrix(stream, "window/after", R.T @ R, shown, {key: dims[key] for key in kept})


def _kind(key: int) -> str:
    return chr(gtsam.Symbol(key).chr())


def _dims(values: gtsam.Values, keys: list[int]) -> dict[int, int]:
    """Dimensions of the tangents of variables."""
    single, dims = {"x": 6, "v": 3, "b": 6, "l": 3, "e": 6}, {}
    for key in keys:
        kind = _kind(key)
        dims[key] = single[kind] if kind in single else len(values.atVector(key))
    return dims


def _log_graph(stream: RerunStream, shown: _Window) -> None:
    """Variables as points, factors as lines."""
    rr, lines = stream.rr, defaultdict[str, list[list[FloatArray]]](list)
    seen = defaultdict[int, list[int]](list)
    graph = shown.graph.graph
    factors = [list(graph.at(k).keys()) for k in range(graph.size())]
    for keys in factors:
        kinds = [_kind(key) for key in keys]
        if "l" in kinds and len(keys) <= 4 and "x" in kinds:
            seen[keys[kinds.index("l")]].append(keys[kinds.index("x")])
    places = _places(shown, seen)
    low = max(float(place[1]) for place in places.values()) + 2.5 * _ROW
    for number, keys in enumerate(factors):
        first = number == 0 and len(keys) > 2
        if first:
            prior = np.array([_WIDTH / 2, low])
            lines["prior"] += [[prior, places[key]] for key in keys if _kind(key) != "l"]
            known = [places[key] for key in keys if _kind(key) == "l"]
            lines["prior"] += [[prior, place] for place in known]
            mark = rr.Points2D([prior], colors=PURPLE, radii=13.0, labels=["prior"])
            stream.log("window/graph/prior_factor", mark)
            continue
        name = "projections" if any(_kind(key) == "l" for key in keys) else "dynamics"
        lines[name] += [[places[a], places[b]] for a, b in pairwise(keys)]
    styles = {
        "prior": ((*PURPLE, 90), 0.5),
        "projections": ((*LIGHT_GREY, 70), 0.4),
        "dynamics": ((*YELLOW, 255), 1.6),
    }
    for name, (colour, radius) in styles.items():
        strips = rr.LineStrips2D(lines[name], colors=colour, radii=radius, draw_order=1.0)
        stream.log(f"window/graph/{name}", strips)
    keys = shown.keys
    colours = [VERMILLION if k not in shown.stays else _COLOURS.get(_kind(k), PURPLE) for k in keys]
    radii = [8.0 if _kind(key) == "l" else 13.0 for key in keys]
    labels = [gtsam.DefaultKeyFormatter(key) for key in keys]
    named = [key for key in keys if _kind(key) != "l"]
    points = rr.Points2D(
        [places[key] for key in keys],
        colors=colours,
        radii=radii,
        labels=labels,
        show_labels=False,
        draw_order=3.0,
    )
    stream.log("window/graph/variables", points)
    texts = rr.Points2D(
        [places[key] + [0.0, 1.0] for key in named],
        colors=(255, 255, 255),
        radii=0.1,
        labels=[gtsam.DefaultKeyFormatter(key) for key in named],
        show_labels=len(named) < 60,
        draw_order=4.0,
    )
    stream.log("window/graph/names", texts)


def _places(shown: _Window, seen: dict[int, list[int]]) -> dict[int, FloatArray]:
    """Where variables are drawn: landmarks above the poses that see them, states in columns."""
    frames = sorted({gtsam.Symbol(key).index() for key in shown.keys if _kind(key) in "xvb"})
    across = np.linspace(0.0, _WIDTH, len(frames)) if len(frames) > 1 else [_WIDTH / 2]
    columns = dict(zip(frames, across, strict=True))
    places: dict[int, FloatArray] = {}
    rest = [key for key in shown.keys if _kind(key) not in "xvbl"]
    for number, key in enumerate(rest):
        places[key] = np.array([-2.5 * _ROW, number * _ROW])
    for key in shown.keys:
        kind = _kind(key)
        if kind in "xvb":
            x = columns[gtsam.Symbol(key).index()]
            places[key] = np.array([x, 2.4 * _ROW * "xvb".index(kind)])
    landmarks = [key for key in shown.keys if _kind(key) == "l"]
    centres = {
        key: float(np.mean([places[pose][0] for pose in seen[key]])) if seen[key] else _WIDTH / 2
        for key in landmarks
    }
    ordered = sorted(landmarks, key=lambda key: centres[key])
    step = _WIDTH / max(len(ordered), 1)
    for number, key in enumerate(ordered):
        # half way between its poses and an even spread, so that none lies on another
        x = 0.5 * centres[key] + 0.5 * (number + 0.5) * step
        row = number % _LANDMARK_ROWS
        places[key] = np.array([x, -(4.0 + row) * _ROW])
    return places


def _log_matrix(
    stream: RerunStream, entity: str, information: FloatArray, shown: _Window, dims: dict[int, int]
) -> None:
    """An information matrix as an image, with a frame around the block of each kind."""
    rr = stream.rr
    if not len(information):
        return
    levels = [
        rr.AnnotationInfo(id=number, color=colour)
        for number, colour in enumerate([_EMPTY, *scaled(np.linspace(0.0, 1.0, _LEVELS), 0.0, 1.0)])
    ]
    stream.log(f"{entity}/matrix", rr.AnnotationContext(levels), static=True)
    stream.log(f"{entity}/matrix", rr.SegmentationImage(_levels(information), opacity=1.0))
    starts: dict[str, tuple[int, int, Colour]] = {}
    column = 0
    for key, dim in dims.items():
        name, colour = shown.group(key)
        first = starts[name][0] if name in starts else column
        column += dim
        starts[name] = first, column, colour
    corners = np.array([(low, low) for low, _, _ in starts.values()], np.float64)
    sizes = np.array([(high - low,) * 2 for low, high, _ in starts.values()], np.float64)
    boxes = rr.Boxes2D(
        mins=corners,
        sizes=sizes,
        colors=[colour for _, _, colour in starts.values()],
        radii=-1.4,
        draw_order=10.0,
    )
    stream.log(f"{entity}/blocks", boxes)
    names = rr.Points2D(
        corners + sizes / 2,
        colors=(255, 255, 255),
        radii=0.01,
        labels=[f"{name} ({high - low})" for name, (low, high, _) in starts.items()],
        draw_order=11.0,
    )
    stream.log(f"{entity}/names", names)


def _levels(information: FloatArray) -> NDArray[np.uint8]:
    """Levels (n, n) of the entries by their normalised size, from 1; those of zeros are 0."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    size = np.abs(information) / np.outer(scale, scale)
    with np.errstate(divide="ignore"):
        logs = np.log10(size)
    levels = 1 + np.rint((_LEVELS - 1) * np.clip(1.0 - logs / _LEAST, 0.0, 1.0))
    return np.where(size == 0.0, 0, levels).astype(np.uint8)
