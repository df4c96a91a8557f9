# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph optimize` for pose graphs: their optimum, its certificate and its covariances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from slam_graph.cli.console import collected_log, echo_json, echo_table
from slam_graph.cli.loading import loading
from slam_graph.cli.options import timed, write_result
from slam_graph.cli.watching import Watching, keep_serving

if TYPE_CHECKING:
    from slam_graph.diagnostics import Diagnostics
    from slam_graph.pose_graph import PoseGraph, PoseGraphPolicy
    from slam_graph.results import PoseGraphResult


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is asked for beside the poses.

    Attributes:
        certificate: whether the result is the global optimum.
        covariances: of every pose.
    """

    certificate: bool
    covariances: bool


def optimize_pose_graph_file(
    file: Path,
    information: Literal["angle", "quaternion"],
    repair: Literal["nearest", "isotropic"] | None,
    policy: PoseGraphPolicy,
    wanted: Wanted,
    save: Path | None,
    output: Path,
    as_json: bool,
    watching: Watching,
) -> None:
    """Estimate all poses, write the results and print what was reached."""
    with loading():
        from slam_graph.diagnostics import Diagnostics
        from slam_graph.pose_graph import read_pose_graph

    diagnostics = Diagnostics()
    seconds: dict[str, float] = {}
    with collected_log() as log:
        with timed(seconds, "read"):
            graph = read_pose_graph(file, diagnostics, information, repair)
        result = _solve(graph, policy, diagnostics, seconds, wanted)
        folder, files = write_result(result, graph.name, output, log)
        if save is not None:
            result.save_problem(save)
        files += watching.show(folder, graph.name, lambda r: r.show_pose_graph(result.solution))
    if as_json:
        echo_json({**result.metrics, "folder": str(folder), "files": [str(path) for path in files]})
    else:
        _report(result, folder, files)
    keep_serving(watching.mode)


def _solve(
    graph: PoseGraph,
    policy: PoseGraphPolicy,
    diagnostics: Diagnostics,
    seconds: dict[str, float],
    wanted: Wanted,
) -> PoseGraphResult:
    """Optimise, and find out what else is asked for."""
    with loading():
        from slam_graph.pose_graph import certify, optimize_pose_graph
        from slam_graph.results import PoseGraphResult

    with timed(seconds, "optimize"):
        solution = optimize_pose_graph(graph, policy, diagnostics)
    certificate = covariances = None
    if wanted.certificate:
        with timed(seconds, "certify"):
            certificate = certify(solution.weighted_graph(), solution.poses)
    if wanted.covariances:
        with timed(seconds, "covariances"):
            covariances = solution.covariances()
    return PoseGraphResult(policy, solution, certificate, covariances, seconds, diagnostics.counts)


def _report(result: PoseGraphResult, folder: Path, files: list[Path]) -> None:
    """Print what was reached, and where the files are."""
    metrics = result.metrics
    echo_table(_overview(metrics))
    typer.echo("")
    echo_table(_costs(metrics["chi2"]))
    typer.echo(f"\n{folder}/")
    typer.echo("  " + " ".join(path.name for path in files))


def _overview(metrics: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """What the problem was, and how it was solved."""
    graph, certificate = metrics["graph"], metrics["certificate"]
    parts = f", {graph['connected_parts']} parts" if graph["connected_parts"] > 1 else ""
    yield (
        "graph",
        f"{graph['name']}: {graph['dimension']}D, {graph['poses']} poses, {graph['edges']} edges, "
        f"{graph['loop_closures']} of them loop closures{parts}",
    )
    ended = "converged" if metrics["converged"] else "not converged"
    yield "method", f"{metrics['method']}, {metrics['steps']} steps, {ended}"
    if metrics["robust"] != "none":
        yield "robust", f"{metrics['robust']}, {metrics['rejected_edges']} edges rejected"
    if certificate is not None:
        verdict = "globally optimal" if certificate["certified"] else "NOT certified"
        yield (
            "certificate",
            f"{verdict}: SE-Sync's objective is {certificate['objective']:.8g} and cannot be below "
            f"{certificate['bound']:.8g}",
        )
        if not certificate["converged"]:
            steps = certificate["newton_steps"]
            yield "", f"Newton's method stopped after {steps} steps, before it had converged"
        yield (
            "",
            f"at {certificate['moved_m']:.3g} m, {certificate['moved_deg']:.3g} deg from the "
            "estimate, which minimises GTSAM's",
        )
    yield "seconds", ", ".join(f"{part} {s:.2f}" for part, s in metrics["timing_s"].items())
    if metrics["warnings"]:
        yield "warnings", ", ".join(f"{kind} {n}" for kind, n in metrics["warnings"].items())


def _costs(chi2: dict[str, dict[str, float]]) -> Iterator[tuple[str, ...]]:
    """The cost before, at the start and after, as three programs count it."""
    yield "", "GTSAM error", "GTSAM chi2", "g2o chi2", "SE-Sync F"
    for stage, values in chi2.items():
        yield stage, *(f"{value:.8g}" for value in values.values())
