# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The layout of the viewer for each kind of result, so that the first look shows what matters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.visualization.rerun_series import (
    ERROR_PLOTS,
    IMU_PLOTS,
    STATE_PLOTS,
    WORK_PLOTS,
    Plot,
)
from slam_graph.visualization.rerun_stream import FRAME, SENSOR_TIME

_GRID = (75, 75, 75, 110)
_BACKGROUND = (13, 16, 23)
_SPREAD_PERCENT = (8.0, 92.0)
TAIL_FRAMES, TAIL_S = 12, 0.6
"""How long the way of a feature stays behind it, on either timeline."""

KNOWN_MAP = "known_map"
"""Entity of the world of a map in which a run is located."""

WINDOW_BOUNDS = ((-140.0, 2040.0), (-390.0, 330.0))
"""Ranges of x and y in which the graph of a window is drawn."""

_LEAST_TICK = 0.12
"""Part of a plot's height by which ticks are apart at least, so that numbers stand beside them."""

_BEHIND_BODY = ((-4.0, -3.0, 3.0), (0.0, 0.0, 0.0))
"""Where the eye is, and what it looks at, when it begins to follow the body, m."""

_HALF_VIEW = float(np.tan(np.deg2rad(55.0) / 2))
"""Half the height of what Rerun's eye sees, at the distance 1."""

WIDE, SQUARE = 1.8, 1.0
"""Width over height of views: one with cameras below it, and one that is about as high as wide."""

_MARGIN = 1.12

RIG_M = 0.3
"""Size of the cameras at the end of a path, as they are drawn."""


@dataclass(frozen=True, slots=True)
class Eye:
    """From where a 3D view is seen.

    Attributes:
        position: (3,) of the eye, m.
        target: (3,) what it looks at and turns around.
    """

    position: tuple[float, ...]
    target: tuple[float, ...]

    @staticmethod
    def on(
        path: FloatArray,
        points: FloatArray | None = None,
        aspect: float = WIDE,
        around: float = 0.0,
    ) -> Eye | None:
        """From above at an angle, so that a path and most points are in view.

        Args:
            path: (N, 3) m.
            points: (M, 3) m.
            aspect: width of the view over its height.
            around: what is in view around each place of the path, m.
        """
        if len(path) == 0:
            return None
        low, high = path.min(axis=0), path.max(axis=0)
        if points is not None and len(points) > 0:
            size = max(0.7 * float(np.linalg.norm(high - low)), 1.0)
            near = points[np.all((points > low - size) & (points < high + size), axis=1)]
            if len(near):
                bounds = np.percentile(near, _SPREAD_PERCENT, axis=0)
                low, high = np.minimum(low, bounds[0]), np.maximum(high, bounds[1])
                path = np.concatenate([path, near[np.all((near > low) & (near < high), axis=1)]])
        centre = (low + high) / 2
        # along the longer horizontal side, so that this one is seen across the screen
        wide = high[0] - low[0] > high[1] - low[1]
        direction = np.array([0.35, -1.0, 0.75] if wide else [-1.0, -0.35, 0.75])
        direction /= np.linalg.norm(direction)
        distance = _distance(path - centre, direction, aspect) + around / _HALF_VIEW
        position = centre + distance * direction
        return Eye(tuple(position.tolist()), tuple(centre.tolist()))


def _distance(offsets: FloatArray, direction: FloatArray, aspect: float) -> float:
    """How far away an eye sees all points.

    Args:
        offsets: (N, 3) of the points from what it looks at, m.
        direction: (3,) to the eye, of length 1.
        aspect: width of the view over its height.
    """
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    towards = offsets @ direction
    across = np.abs(offsets @ right) / (aspect * _HALF_VIEW)
    upwards = np.abs(offsets @ np.cross(direction, right)) / _HALF_VIEW
    return max(_MARGIN * float(np.max(towards + np.maximum(across, upwards))), 0.5)


def _controls(eye: Eye | None, tracked: str | None = None) -> Any:
    import rerun.blueprint as rrb

    if eye is None:
        position, target = _BEHIND_BODY
        return rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=position,
            look_target=target,
            eye_up=(0, 0, 1),
            tracking_entity=tracked,
        )
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=eye.position, look_target=eye.target, eye_up=(0, 0, 1)
    )


def growing(entities: Iterable[str]) -> Any:
    """Overrides that show everything that was logged to some entities up to the time shown."""
    import rerun.blueprint as rrb

    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    ranges = [rrb.VisibleTimeRange(name, start=start, end=end) for name in (FRAME, SENSOR_TIME)]
    return {entity: [rrb.VisibleTimeRanges(ranges)] for entity in entities}


def _dark() -> Any:
    """The background for colours that are light, also where the viewer itself is light."""
    import rerun.blueprint as rrb

    return rrb.Background(color=_BACKGROUND, kind=rrb.BackgroundKind.SolidColor)


def space(
    name: str,
    origin: str,
    contents: Sequence[str] = ("$origin/**",),
    grown: Iterable[str] = (),
    eye: Eye | None = None,
    tracked: str | None = None,
) -> Any:
    """A 3D view."""
    import rerun.blueprint as rrb

    return rrb.Spatial3DView(
        name=name,
        origin=origin,
        contents=list(contents),
        overrides=growing(grown),
        background=_dark(),
        line_grid=rrb.LineGrid3D(visible=True, color=_GRID, stroke_width=0.7),
        eye_controls=_controls(eye, tracked),
    )


def plot_view(plot: Plot, span: tuple[float, float] | None = None) -> Any:
    """A view of time series; `span` is the range of its values, if it is known."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=plot.title,
        origin=plot.entity,
        contents="$origin/**",
        axis_x=whole_axis(),
        axis_y=None if span is None else rrb.ScalarAxis(range=with_ticks(*span)),
        # with bounds it would have nine lines, and colours are those of the plot of the velocity
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=len(plot.bounds) < 6),
    )


def with_ticks(low: float, high: float) -> tuple[float, float]:
    """The range of an axis, widened so that two numbers stand beside it.

    Rerun writes multiples of powers of ten only, and leaves out what would be too dense.
    """
    size = high - low
    if not size > 0.0:
        return low - 1.0, high + 1.0
    step = 10.0 ** np.ceil(np.log10(_LEAST_TICK * size))
    first, last = np.ceil(low / step), np.floor(high / step)
    if last - first < 1.0:
        low, high = float(step * np.floor(low / step)), float(step * np.ceil(high / step))
    margin = 0.05 * (high - low)
    return low - margin, high + margin


def whole_axis() -> Any:
    """An axis of time that shows all of it, also while the view follows the end."""
    import rerun.blueprint as rrb

    ends = rrb.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=ends, end=ends))


def whole(*views: Any, timeline: str | None = SENSOR_TIME) -> Any:
    """A layout with the panels out of the way, which opens at the end of a timeline, if any."""
    import rerun.blueprint as rrb

    time = rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following")
    return rrb.Blueprint(
        *views,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="hidden") if timeline is None else time,
        auto_views=False,
    )


@dataclass(frozen=True, slots=True)
class Shown:
    """What there is to be shown of a run.

    Attributes:
        world: entity under which all of its 3D data is.
        cameras: number of cameras with images or features.
        plots: entities of the plots that have values.
        log: whether there is a log.
        window: whether the factor graph of every window is shown.
        in_map: whether the run is located in a map.
        map_path: (N, 3) poses in that map and of its keyframes, if they are known already.
        spans: least and largest values of plots, by their entities, once they are known.
        title: of the 3D view.
    """

    world: str = "world"
    cameras: int = 0
    plots: frozenset[str] = frozenset()
    log: bool = False
    window: bool = False
    in_map: bool = False
    map_path: FloatArray | None = None
    spans: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    title: str = "Run"


GROWING = (
    "path/causal",
    "path/smoothed",
    "path/loop_closed",
    "path/groundtruth",
    "map/points",
    "keyframes",
    "objects/trails",
    "fixes",
    "fixes/sigma",
    "known_poses",
    "known_poses/axes",
    "known_poses/sigma",
)
"""What accumulates in the world of a run."""

_STACKS = (STATE_PLOTS, ERROR_PLOTS, WORK_PLOTS)
"""The tiles of plots of a run; those of one tile are its tabs."""


def odometry(shown: Shown, eye: Eye | None = None) -> Any:
    """The layout of a run: space, cameras below it, and plots beside it.

    Args:
        shown: what there is.
        eye: where the view is seen from; without it, it follows the body.
    """
    import rerun.blueprint as rrb

    root = f"/{shown.world}"
    body = f"{root}/body"
    flat = [
        f"- {body}/cam{number}/{what}/**"
        for number in range(shown.cameras)
        for what in ("tails", "features", "residuals", "rejected", "objects")
    ]
    grown = [f"{root}/{name}" for name in GROWING]
    spaces = [space(shown.title, root, ["$origin/**", *flat], grown, eye, body)]
    if shown.in_map:
        aspect = WIDE if shown.cameras else SQUARE
        place = None if shown.map_path is None else Eye.on(shown.map_path, aspect=aspect)
        view = space("In the map", f"/{KNOWN_MAP}", grown=[f"/{KNOWN_MAP}/path"], eye=place)
        spaces.insert(0, view)
    if shown.window:
        spaces.append(window())
    stacks = [views for plots in _STACKS if (views := _views(plots, shown))]
    right = [rrb.Tabs(*views, active_tab=0) for views in stacks]
    samples = _views(IMU_PLOTS, shown)
    if right and samples:
        # beside the space, where its two plots are wide and seen at once
        aside = [rrb.Vertical(*samples, name="IMU")]
    else:
        aside, right = [], [*right, *samples]
    three = rrb.Tabs(
        *spaces, *aside, *_texts(shown), active_tab=len(spaces) - 1 if shown.window else 0
    )
    cameras = [_camera(f"cam{number}", f"{body}/cam{number}") for number in range(shown.cameras)]
    left = rrb.Vertical(three, rrb.Horizontal(*cameras), row_shares=[67, 33]) if cameras else three
    if not right:
        return whole(left)
    return whole(
        rrb.Horizontal(left, rrb.Vertical(*right), column_shares=[66, 34]),
    )


def _camera(name: str, entity: str) -> Any:
    """The view of a camera, with the last pieces of the tracks as their tails."""
    import rerun.blueprint as rrb

    start = rrb.TimeRangeBoundary.cursor_relative(seq=-TAIL_FRAMES)
    tails = [
        rrb.VisibleTimeRange(FRAME, start=start, end=rrb.TimeRangeBoundary.cursor_relative()),
        rrb.VisibleTimeRange(
            SENSOR_TIME,
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TAIL_S),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        ),
    ]
    overrides: Any = {f"{entity}/tails": [rrb.VisibleTimeRanges(tails)]}
    return rrb.Spatial2DView(name=name, origin=entity, overrides=overrides, background=_dark())


def _views(plots: Iterable[Plot], shown: Shown) -> list[Any]:
    """Views of those plots that have values."""
    return [
        plot_view(plot, shown.spans.get(plot.entity))
        for plot in plots
        if plot.entity in shown.plots
    ]


def _texts(shown: Shown) -> list[Any]:
    """What colours mean, and the log of the run."""
    import rerun.blueprint as rrb

    log = [rrb.TextLogView(name="Log", origin="/log")] if shown.log else []
    return [*log, rrb.TextDocumentView(name="Legend", origin="/legend")]


def window() -> Any:
    """The factor graph of the window, and its information before and after marginalization."""
    import rerun.blueprint as rrb

    across, down = WINDOW_BOUNDS
    bounds = rrb.VisualBounds2D(x_range=across, y_range=down)

    return rrb.Vertical(
        rrb.Spatial2DView(
            name="Factor graph of the window",
            origin="/window/graph",
            visual_bounds=bounds,
            background=_dark(),
        ),
        rrb.Horizontal(
            rrb.Spatial2DView(name="Information before marginalization", origin="/window/before"),
            rrb.Spatial2DView(name="After: the prior of the next window", origin="/window/after"),
        ),
        row_shares=[45, 55],
        name="Window",
    )
