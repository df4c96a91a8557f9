# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose graphs and bundle adjustments in Rerun, before and after, with the residuals of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.bundle_adjustment import BalSolution
from slam_graph.pose_graph import PoseGraphSolution
from slam_graph.visualization.rerun_blueprints import SQUARE, Eye, space, whole, whole_axis
from slam_graph.visualization.rerun_palette import (
    LIGHT_GREY,
    PURPLE,
    SKY,
    VERMILLION,
    YELLOW,
    scaled,
)
from slam_graph.visualization.rerun_stream import RerunStream

EDGE = "edge"
"""Timeline of pose graphs: the number of the edge."""

_LEAST_CHI2 = 1e-3
_RESIDUAL_COLOURS = {
    ("before", "odometry"): SKY,
    ("before", "loop_closures"): YELLOW,
    ("after", "odometry"): VERMILLION,
    ("after", "loop_closures"): PURPLE,
}
_FEWEST_BINS, _BINS = 10, 60
_ERROR_PERCENTILE = 98.0
_VIEWED_PERCENT = (2.0, 98.0)
_MANY_POINTS = 2000
_INDEX_LENGTH = 0.08
"""Length of the optical axes that are drawn, as a part of the scene."""


def show_pose_graph(
    stream: RerunStream, solution: PoseGraphSolution, titles: Mapping[str, str] | None = None
) -> None:
    """Log a pose graph before and after its optimisation, edges coloured by their residuals.

    Args:
        stream: where it goes.
        solution: the graph with its poses.
        titles: what `before` and `after` are, or one of the two, which is then shown alone.
    """
    if titles is None:
        start = "odometry alone" if solution.graph.estimates is None else "as in the file"
        titles = {"before": f"Before: {start}", "after": "After"}
    graph, weights = solution.graph, solution.weights
    before = replace(solution, minimum=replace(solution.minimum, poses=solution.before))
    stages = {name: {"before": before, "after": solution}[name] for name in titles}
    chi2 = {name: stage.chi2_of_edges() for name, stage in stages.items()}
    logs = {name: np.log10(np.maximum(values, _LEAST_CHI2)) for name, values in chi2.items()}
    # one scale for both, that of a good fit: most residuals before it are beyond its end
    best = logs["after"] if "after" in logs else logs["before"]
    low, high = np.percentile(best, 5.0), np.log10(4.0 * graph.tangent_size)
    loops, eyes = ~graph.is_odometry, []
    for name, stage in stages.items():
        stream.log(name, stream.rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        places = stage.poses.in_space().translations
        colours = scaled(logs[name], float(min(low, high - 1.0)), float(high))
        _log_edges(stream, name, places, graph.edges, colours, loops, weights < 0.5)
        _log_residuals(stream, name, titles[name], chi2[name], loops)
        eyes.append(_eye(places))
    text = _summary(solution, {titles[name]: float(v.sum()) for name, v in chi2.items()})
    stream.log("summary", stream.rr.TextDocument(text, media_type="text/markdown"), static=True)
    views = [
        space(title, f"/{name}", eye=eye)
        for (name, title), eye in zip(titles.items(), eyes, strict=True)
    ]
    stream.arrange(_pose_graph_layout(views))


def _log_edges(
    stream: RerunStream,
    name: str,
    places: FloatArray,
    edges: IntArray,
    colours: Any,
    loops: BoolArray,
    rejected: BoolArray,
) -> None:
    """Odometry, loop closures and rejected edges, each as one entity, and the poses."""
    rr = stream.rr
    kinds = {"odometry": ~loops & ~rejected, "loop_closures": loops & ~rejected}
    for kind, rows in kinds.items():
        radius = -0.9 if kind == "odometry" else -0.6
        lines = rr.LineStrips3D(places[edges[rows]], colors=colours[rows], radii=radius)
        stream.log(f"{name}/{kind}", lines, static=True)
    if rejected.any():
        lines = rr.LineStrips3D(places[edges[rejected]], colors=VERMILLION, radii=-1.2)
        stream.log(f"{name}/rejected", lines, static=True)
    points = rr.Points3D(places, colors=LIGHT_GREY, radii=-1.0)
    stream.log(f"{name}/poses", points, static=True)


def _log_residuals(
    stream: RerunStream, name: str, title: str, chi2: FloatArray, loops: BoolArray
) -> None:
    """log10 χ² (M,) of each edge over its number, but of those that fit exactly."""
    rr, numbers = stream.rr, np.arange(len(chi2))
    shown = chi2 > _LEAST_CHI2
    values = np.log10(chi2, out=np.zeros(len(chi2)), where=shown)
    for kind, rows in (("odometry", ~loops & shown), ("loop_closures", loops & shown)):
        entity = f"residuals/{name}/{kind}"
        label = f"{kind.replace('_', ' ')}, {title[0].lower()}{title[1:]}"
        colour = _RESIDUAL_COLOURS[name, kind]
        shape = "circle" if kind == "odometry" else "diamond"
        size = 1.2 if kind == "odometry" else 2.2
        style = rr.SeriesPoints(colors=colour, names=label, markers=shape, marker_sizes=size)
        if rows.any():
            stream.log(entity, style, static=True)
            columns = rr.Scalars.columns(scalars=values[rows])
            stream.send_along(entity, rr.TimeColumn(EDGE, sequence=numbers[rows]), columns)


def _summary(solution: PoseGraphSolution, chi2: dict[str, float]) -> str:
    graph = solution.graph
    loops = int(np.count_nonzero(~graph.is_odometry))
    rejected = int(np.count_nonzero(solution.weights < 0.5))
    rows = "\n".join(f"| χ², {t[0].lower()}{t[1:]} | {value:.6g} |" for t, value in chi2.items())
    both = ", on one scale for both" if len(chi2) > 1 else ""
    return f"""\
# {graph.name}

| | |
|---|---|
| poses | {len(graph.keys)} |
| edges | {len(graph.edges)}, {loops} of them loop closures |
| rejected | {rejected} |
{rows}

**Edges** by log χ²{both}: dark blue fits, yellow does not; red was rejected. Those that fit exactly
(χ² below {_LEAST_CHI2:g}) have no residual.
"""


def _pose_graph_layout(views: list[Any]) -> Any:
    import rerun.blueprint as rrb

    residuals = rrb.TimeSeriesView(
        name="log10 χ² of each edge",
        origin="/residuals",
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        axis_x=whole_axis(),
    )
    text = rrb.TextDocumentView(name="Summary", origin="/summary")
    return whole(
        rrb.Vertical(
            rrb.Horizontal(*views),
            rrb.Horizontal(residuals, text, column_shares=[72, 28]),
            row_shares=[66, 34],
        ),
        timeline=EDGE,
    )


def _eye(places: FloatArray) -> Eye | None:
    """From above where everything is level, else from the side and above."""
    low, high = np.percentile(places, _VIEWED_PERCENT, axis=0)
    size = max(float(np.linalg.norm(high - low)), 1e-3)
    if high[2] - low[2] > 0.02 * size:
        near = 0.2 * size
        inside = np.all((places >= low - near) & (places <= high + near), axis=1)
        return Eye.on(places[inside], aspect=SQUARE)
    centre = (low + high) / 2
    above = centre + np.array([0.0, -0.05 * size, 0.95 * size])
    return Eye(tuple(above.tolist()), tuple(centre.tolist()))


def show_bundle(stream: RerunStream, solution: BalSolution) -> None:
    """Log a bundle adjustment before and after, with the histogram of its reprojection errors.

    Of a problem that is not solved there is one scene, as it is in the file.
    """
    part = solution.part.problem
    scenes = {"before": part.estimates}
    titles = {"before": "Before" if solution.is_solved else "As in the file", "after": "After"}
    if solution.is_solved:
        scenes["after"] = solution.adjusted
    errors = solution.errors_px
    last = float(np.percentile(errors["before"], _ERROR_PERCENTILE))
    bins = int(np.clip(np.sqrt(len(errors["before"])), _FEWEST_BINS, _BINS))
    edges = np.linspace(0.0, max(last, 1e-6), bins + 1)
    rr = stream.rr
    worst = {name: _worst_of_points(part.point, part.points, errors[name]) for name in scenes}
    high = float(np.percentile(worst["before"], 90.0))
    radius = -1.1 if part.points > _MANY_POINTS else -3.0
    for name, scene in scenes.items():
        centres = scene.centres()
        axes = -scene.rotations[:, 2]  # BAL's cameras look along their negative z axis
        size = float(np.linalg.norm(np.ptp(np.percentile(centres, [5, 95], axis=0), axis=0)))
        colours = scaled(worst[name], 0.0, high)
        stream.log(
            f"{name}/points", rr.Points3D(scene.points, colors=colours, radii=radius), static=True
        )
        arrows = rr.Arrows3D(
            origins=centres, vectors=_INDEX_LENGTH * size * axes, colors=SKY, radii=-1.2
        )
        stream.log(f"{name}/cameras", arrows, static=True)
        stream.log(
            f"{name}/centres", rr.Points3D(centres, colors=LIGHT_GREY, radii=-1.8), static=True
        )
        counts, _ = np.histogram(errors[name], edges)
        colour = SKY if name == "before" else VERMILLION
        bars = rr.BarChart(counts, abscissa=edges[:-1], widths=np.diff(edges), color=colour)
        stream.log(f"errors/{name}", bars, static=True)
    rms = {name: float(np.sqrt(np.mean(errors[name] ** 2))) for name in scenes}
    titles = {name: titles[name] for name in scenes}
    text = _bundle_summary(solution, {titles[name]: value for name, value in rms.items()})
    stream.log("summary", rr.TextDocument(text, media_type="text/markdown"), static=True)
    after = solution.adjusted
    eye = _scene_eye(after.centres(), after.points)
    stream.arrange(_bundle_layout(eye, titles))


def _worst_of_points(point: IntArray, count: int, errors: FloatArray) -> FloatArray:
    """(P,) the largest error (px) of each point."""
    worst = np.zeros(count)
    np.maximum.at(worst, point, errors)
    return worst


def _scene_eye(centres: FloatArray, points: FloatArray) -> Eye:
    """From behind the cameras, so that they and most points are in view."""
    low, high = np.percentile(points, (10.0, 90.0), axis=0)
    low, high = (
        f(a, b)
        for f, a, b in ((np.minimum, low, centres.min(0)), (np.maximum, high, centres.max(0)))
    )
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    behind = np.median(centres, axis=0) - np.median(points, axis=0)
    behind /= max(float(np.linalg.norm(behind)), 1e-9)
    return Eye(tuple((centre + 0.9 * size * behind).tolist()), tuple(centre.tolist()))


def _bundle_summary(solution: BalSolution, rms: dict[str, float]) -> str:
    part, both = solution.part.problem, ", on one scale for both" if len(rms) > 1 else ""
    rows = "\n".join(
        f"| RMS error {name.lower()} | {value:.3f} px |" for name, value in rms.items()
    )
    return f"""\
# {solution.problem.name}

| | |
|---|---|
| cameras | {part.cameras} |
| points | {part.points} |
| observations | {len(part.camera)} |
{rows}

**Points** are coloured by their largest reprojection error{both}: dark blue fits, yellow does not.
Arrows show where the cameras look.
"""


def _bundle_layout(eye: Eye, titles: Mapping[str, str]) -> Any:
    import rerun.blueprint as rrb

    charts = [
        rrb.BarChartView(
            name=f"Errors {title.lower()} [px]",
            origin=f"/errors/{name}",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for name, title in titles.items()
    ]
    text = rrb.TextDocumentView(name="Summary", origin="/summary")
    views = [space(title, f"/{name}", eye=eye) for name, title in titles.items()]
    return whole(
        rrb.Vertical(
            rrb.Horizontal(*views),
            rrb.Horizontal(*charts, text),
            row_shares=[68, 32],
        ),
        timeline=None,
    )
