# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph optimize`: a pose graph in, its optimum out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from slam_graph.cli.config import ConfigFile, Overrides
from slam_graph.cli.data import Json
from slam_graph.cli.logs import collected_log, remove_if_empty
from slam_graph.cli.output import echo_json, echo_table

if TYPE_CHECKING:
    from slam_graph.diagnostics import Diagnostics
    from slam_graph.mapping.pose_graph import PoseGraph
    from slam_graph.mapping.pose_graph_policy import PoseGraphPolicy
    from slam_graph.output.pose_graph_result import PoseGraphResult

Method = Literal["gauss_newton", "levenberg_marquardt", "dogleg", "isam2"]
Initial = Literal["auto", "chordal", "lago", "odometry", "file"]
Robust = Literal["none", "gnc", "huber", "cauchy", "geman_mcclure", "dcs", "truncated"]


def optimize(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Pose graph: g2o or TORO, 2D or 3D.")
    ],
    method: Annotated[Method | None, typer.Option("--method", help="How steps are taken.")] = None,
    initialization: Annotated[
        Initial | None, typer.Option("--init", help="Where the first estimates come from.")
    ] = None,
    robust: Annotated[
        Robust | None, typer.Option("--robust", help="How false loop closures are held back.")
    ] = None,
    information: Annotated[
        Literal["angle", "quaternion"],
        typer.Option(
            "--information", help="What the information of 3D rotations is for: GTSAM's or g2o's."
        ),
    ] = "angle",
    certify: Annotated[
        bool, typer.Option("--certify", help="Say whether the result is the global optimum.")
    ] = False,
    covariances: Annotated[
        bool, typer.Option("--covariances", help="Write the covariance of every pose.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="G2O", help="Write the optimised graph here too."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Let --save replace a file that is there.")
    ] = False,
    config: ConfigFile = None,
    set_: Overrides = None,
    output: Annotated[
        Path, typer.Option("--output", help="Folder of results: OUTPUT/<graph>/<UTC time>/.")
    ] = Path("results"),
    as_json: Json = False,
) -> None:
    """Estimate the poses of a pose graph and write the results.

    The newest results are also found under OUTPUT/<graph>/latest; nothing is overwritten.
    """
    from slam_graph.diagnostics import Diagnostics
    from slam_graph.errors import DataError
    from slam_graph.mapping.pose_graph_file import g2o_lines, read_pose_graph
    from slam_graph.output.files import write_text

    if save is not None and save.exists() and not force:
        raise DataError(f"{save}: is there already; say --force to replace it")
    if save is not None and (save.is_dir() or not save.parent.is_dir()):
        raise DataError(f"{save}: cannot be written; name a file in a folder that is there")
    said = {"method": method, "initialization": initialization, "robust": robust}
    policy, diagnostics = _policy(config, set_ or [], said), Diagnostics()
    seconds: dict[str, float] = {}
    with collected_log() as log:
        with _timed(seconds, "read"):
            graph = read_pose_graph(file, diagnostics, information)
        result = _solve(graph, policy, diagnostics, seconds, certify, covariances)
        folder, files = _write(result, output, log)
        if save is not None:
            write_text(save, g2o_lines(graph, result.solution.poses))
    if as_json:
        echo_json({**result.metrics, "folder": str(folder), "files": [str(path) for path in files]})
    else:
        _report(result, folder, files)


def _policy(file: Path | None, overrides: list[str], options: dict[str, Any]) -> PoseGraphPolicy:
    """The settings: file under options under overrides."""
    from slam_graph.config_tree import ConfigTree, KeyPath, override, read_tree, validate
    from slam_graph.mapping.pose_graph_policy import PoseGraphPolicy

    tree = ConfigTree() if file is None else read_tree(file)
    for name, value in options.items():
        table = "gauss_newton" if name == "method" else "cost"
        if value is not None:
            where = f"option {name}"
            places: dict[KeyPath, str] = {(table,): where, (table, name): where}
            tree.merge(ConfigTree({table: {name: value}}, places))
    for text in overrides:
        tree.merge(override(text))
    return validate(PoseGraphPolicy, tree)


def _solve(
    graph: PoseGraph,
    policy: PoseGraphPolicy,
    diagnostics: Diagnostics,
    seconds: dict[str, float],
    certified: bool,
    with_covariances: bool,
) -> PoseGraphResult:
    """Optimise, and find out what else is asked for."""
    from slam_graph.mapping.pose_graph_certificate import certify
    from slam_graph.mapping.pose_graph_covariance import marginal_covariances
    from slam_graph.mapping.pose_graph_optimization import optimize_pose_graph
    from slam_graph.output.pose_graph_result import PoseGraphResult

    with _timed(seconds, "optimize"):
        solution = optimize_pose_graph(graph, policy, diagnostics)
    certificate = covariances = None
    if certified:
        with _timed(seconds, "certify"):
            certificate = certify(solution.weighted_graph(), solution.poses)
    if with_covariances:
        with _timed(seconds, "covariances"):
            covariances = marginal_covariances(solution)
    return PoseGraphResult(policy, solution, certificate, covariances, seconds, diagnostics.counts)


def _write(result: PoseGraphResult, output: Path, log: list[str]) -> tuple[Path, list[Path]]:
    """Write all files into a new folder."""
    from slam_graph.output.files import create_run_folder, link_latest, write_text

    folder = create_run_folder(output, result.solution.graph.name)
    try:
        files = [*result.save(folder), folder / "run.log"]
        write_text(files[-1], log)
        link_latest(folder)
    except BaseException:
        remove_if_empty(folder)
        raise
    return folder, files


@contextmanager
def _timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Note how long a block takes."""
    start = perf_counter()
    yield
    seconds[part] = perf_counter() - start


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
