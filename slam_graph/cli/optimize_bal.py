# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph optimize` for bundle adjustment: a BAL problem or a map in, its optimum out."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from slam_graph.cli.logs import collected_log
from slam_graph.cli.optimize_common import timed, write_result
from slam_graph.cli.printing import echo_json, echo_table

if TYPE_CHECKING:
    from slam_graph.bundle_adjustment.bal_policy import BalPolicy
    from slam_graph.maps.map_config import MapBalPolicy
    from slam_graph.maps.map_model import SlamMap
    from slam_graph.results.bundle_result import BalResult

__all__ = ["optimize_bal", "optimize_map"]

_MOST_LETTERS = 100
"""The name of a recording is cut to this length in the name of a folder."""


def optimize_bal(
    file: Path, policy: BalPolicy, save: Path | None, output: Path, as_json: bool
) -> None:
    """Estimate all cameras and points, write the results and print what was reached."""
    from slam_graph.bundle_adjustment.bal_file import read_bal
    from slam_graph.bundle_adjustment.bal_solve import adjust_bundle
    from slam_graph.diagnostics import Diagnostics
    from slam_graph.results.bundle_result import BalResult

    diagnostics = Diagnostics()
    seconds: dict[str, float] = {}
    with collected_log() as log:
        with timed(seconds, "read"):
            problem = read_bal(file)
        with timed(seconds, "optimize"):
            solution = adjust_bundle(problem, policy, diagnostics)
        result = BalResult(policy, solution, seconds, diagnostics.counts)
        folder, files = _write(result, save, output, log)
    _show(result, folder, files, as_json)


def optimize_map(
    path: Path, policy: MapBalPolicy, save: Path | None, output: Path, as_json: bool
) -> None:
    """Estimate all keyframes and features of a map, write the results and print them."""
    from slam_graph.diagnostics import Diagnostics
    from slam_graph.maps.map_adjustment import adjust_map
    from slam_graph.results.map_adjustment_result import MapBalResult
    from slam_graph.results.map_output import find_map, load_map

    diagnostics = Diagnostics()
    seconds: dict[str, float] = {}
    with collected_log() as log:
        with timed(seconds, "read"):
            file = find_map(path)
            content = load_map(file)
        with timed(seconds, "optimize"):
            done = adjust_map(content, policy, diagnostics, _name(content, file))
        counts = diagnostics.counts
        result = MapBalResult(policy, done.solution, seconds, counts, adjustment=done)
        folder, files = _write(result, save, output, log)
    _show(result, folder, files, as_json)


def _name(content: SlamMap, file: Path) -> str:
    """Of a map: that of its file, or that of its recording if the file is that of a run.

    A name out of a file must not lead out of the folder of results.
    """
    from slam_graph.results.map_output import MAP_NAME

    if file.name != MAP_NAME:
        return file.stem
    return re.sub(r"[^\w.-]+", "_", content.recordings[0].name)[:_MOST_LETTERS] + "_map"


def _write(
    result: BalResult, save: Path | None, output: Path, log: list[str]
) -> tuple[Path, list[Path]]:
    """Write all files, and the optimised problem where it is wanted too."""
    folder, files = write_result(result, result.name, output, log)
    if save is not None:
        result.save_problem(save)
    return folder, files


def _show(result: BalResult, folder: Path, files: list[Path], as_json: bool) -> None:
    """Print what was reached."""
    if as_json:
        echo_json({**result.metrics, "folder": str(folder), "files": [str(path) for path in files]})
        return
    echo_table(_overview(result.metrics))
    typer.echo(f"\n{folder}/")
    typer.echo("  " + " ".join(path.name for path in files))


def _overview(metrics: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """What the problem was, how it was solved, and how well it fits."""
    problem = metrics["problem"]
    words = {"cameras": "keyframes", "points": "features"} if "map" in metrics else {}
    parts = (
        f"{problem['used_' + what]} {words.get(what, what)}"
        + (f" (of {problem[what]})" if problem["used_" + what] < problem[what] else "")
        for what in ("cameras", "points", "observations")
    )
    yield "problem", f"{problem['name']}: {', '.join(parts)}"
    ended = "converged" if metrics["converged"] else "not converged"
    robust = "" if metrics["robust"] == "none" else f", loss {metrics['robust']}"
    yield "method", f"{metrics['steps']} steps, {ended}; {metrics['intrinsics']} intrinsics{robust}"
    cost = metrics["cost"]
    yield "cost", f"{cost['before']:.8g} before, {cost['after']:.8g} after"
    rmse, median = (
        " before, ".join(f"{metrics['reprojection_px'][stage][what]:.4g}" for stage in cost)
        for what in ("rmse", "median")
    )
    yield "error [px]", f"RMSE {rmse} after; median {median} after"
    if "map" in metrics:
        yield "moved", _moved(metrics["map"])
    yield "seconds", ", ".join(f"{part} {s:.2f}" for part, s in metrics["timing_s"].items())
    if metrics["warnings"]:
        yield "warnings", ", ".join(f"{kind} {n}" for kind, n in metrics["warnings"].items())


def _moved(table: dict[str, Any]) -> str:
    """By how much a map has changed."""
    way, turn = table["keyframes_moved_m"]["rms"], table["keyframes_turned_deg"]["rms"]
    features = table["features_moved_m"]["median"]
    return f"keyframes {way:.4f} m and {turn:.3f} deg (rms), features {features:.4f} m (median)"
