# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Several runs in Rerun over one another: their paths, and their errors over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.visualization.rerun_blueprints import (
    SQUARE,
    Eye,
    space,
    whole,
    whole_axis,
    with_ticks,
)
from slam_graph.visualization.rerun_palette import TRUTH, line_colours
from slam_graph.visualization.rerun_stream import RerunStream

_SINCE_START = "since_start"
"""Timeline of comparisons."""

_RADII = (-2.6, -1.0)
"""Of the first and the last path, pixels: paths lie on one another, and each is to be seen."""


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """One of several runs that are shown together.

    Attributes:
        name: of the algorithm or the folder.
        path: (S, 3) positions of all states in the world of the truth, or of the first run, m.
        time_s: (N,) since the first frame, of the states that have a true pose.
        errors: (N,) at these times, by the title of a plot.
    """

    name: str
    path: FloatArray
    time_s: FloatArray
    errors: Mapping[str, FloatArray]


def show_comparison(
    stream: RerunStream,
    runs: Iterable[ComparedRun],
    true_paths: Mapping[str, FloatArray],
    note: str = "",
) -> None:
    """Log several runs over one another.

    Args:
        stream: where it goes.
        runs: to compare.
        true_paths: (M, 3) in the same world by their labels.
        note: what else is to be known of the errors.
    """
    import rerun.blueprint as rrb

    rr, titles, runs = stream.rr, dict[str, str](), list(runs)
    stream.log("paths", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    colours, rows = line_colours(run.name for run in runs), []
    largest = dict[str, float]()
    for run, radius in zip(runs, np.linspace(*_RADII, len(runs)), strict=True):
        (colour, said), name = colours[run.name], rr.escape_entity_path_part(run.name)
        line = rr.LineStrips3D(
            [run.path], colors=colour, radii=radius, labels=[run.name], show_labels=False
        )
        stream.log(f"paths/{name}", line, static=True)
        row = [run.name, said]
        for index, (title, values) in enumerate(run.errors.items()):
            entity = titles.setdefault(title, f"errors/{index}")
            style = rr.SeriesLines(colors=colour, names=run.name, widths=1.5)
            stream.log(f"{entity}/{name}", style, static=True)
            columns = rr.Scalars.columns(scalars=values)
            times = rr.TimeColumn(_SINCE_START, duration=run.time_s)
            stream.send_along(f"{entity}/{name}", times, columns)
            row.append(f"{np.sqrt(np.mean(values**2)):.4g}")
            largest[title] = max(largest.get(title, 0.0), float(np.max(values, initial=0.0)))
        rows.append("| " + " | ".join(row) + " |")
    for label, path in true_paths.items():
        line = rr.LineStrips3D([path], colors=TRUTH, radii=-0.5, labels=[label], show_labels=False)
        stream.log(f"paths/{rr.escape_entity_path_part(label)}", line, static=True)
    head = "| RMSE | " + " | ".join(["colour", *titles]) + " |\n" + "|---" * (2 + len(titles))
    grey = "\n\nThin, light grey: ground truth." if true_paths else ""
    text = "# Comparison\n\n" + head + "|\n" + "\n".join(rows) + grey + f"\n\n{note}"
    stream.log("summary", rr.TextDocument(text, media_type="text/markdown"), static=True)
    plots: list[Any] = [
        rrb.TimeSeriesView(
            name=title,
            origin=f"/{entity}",
            plot_legend=rrb.Corner2D.LeftTop,
            axis_x=whole_axis(),
            axis_y=rrb.ScalarAxis(range=with_ticks(0.0, largest[title])),
        )
        for title, entity in titles.items()
    ]
    plots.append(rrb.TextDocumentView(name="Summary", origin="/summary"))
    places = [*(run.path for run in runs), *true_paths.values(), np.zeros((0, 3))]
    view = space("Paths", "/paths", eye=Eye.on(np.concatenate(places), aspect=SQUARE))
    stream.arrange(
        whole(
            rrb.Horizontal(view, rrb.Vertical(*plots), column_shares=[60, 40]),
            timeline=_SINCE_START if titles else None,
        )
    )
