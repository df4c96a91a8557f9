# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph optimize` for bundle adjustment: a BAL problem in, its optimum out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from slam_graph.cli.console import collected_log, echo_json, echo_table
from slam_graph.cli.loading import loading
from slam_graph.cli.options import timed, write_result
from slam_graph.cli.watching import Watching, keep_serving

if TYPE_CHECKING:
    from slam_graph.bundle_adjustment import BalPolicy
    from slam_graph.results import BalResult


def optimize_bal(
    file: Path,
    policy: BalPolicy,
    save: Path | None,
    output: Path,
    as_json: bool,
    watching: Watching,
) -> None:
    """Estimate all cameras and points, write the results and print what was reached."""
    with loading():
        from slam_graph.bundle_adjustment import adjust_bundle, read_bal
        from slam_graph.diagnostics import Diagnostics
        from slam_graph.results import BalResult

    diagnostics = Diagnostics()
    seconds: dict[str, float] = {}
    with collected_log() as log:
        with timed(seconds, "read"):
            problem = read_bal(file)
        with timed(seconds, "optimize"):
            solution = adjust_bundle(problem, policy, diagnostics)
        result = BalResult(policy, solution, seconds, diagnostics.counts)
        folder, files = _write(result, save, output, log)
        files += watching.show(folder, result.name, lambda r: r.show_bundle(solution))
    _show(result, folder, files, as_json)
    keep_serving(watching.mode)


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
    parts = (
        f"{problem['used_' + what]} {what}"
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
    yield "seconds", ", ".join(f"{part} {s:.2f}" for part, s in metrics["timing_s"].items())
    if metrics["warnings"]:
        yield "warnings", ", ".join(f"{kind} {n}" for kind, n in metrics["warnings"].items())
