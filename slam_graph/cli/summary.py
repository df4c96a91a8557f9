# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The last lines of a run: a table of results and the files that hold them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from slam_graph.cli.printing import echo_table, number

if TYPE_CHECKING:
    from slam_graph.results import RunResult

_Table = dict[str, Any]


def echo_summary(result: RunResult, folder: Path, files: list[Path]) -> None:
    """Print the results of a run, and where its files are."""
    metrics = result.metrics
    echo_table(_overview(metrics))
    if metrics["accuracy"]:
        typer.echo("")
        echo_table(_accuracy(metrics["accuracy"]))
    if metrics["final_ba"] and metrics["final_ba"]["accuracy"]:
        typer.echo("")
        echo_table(_accuracy(metrics["final_ba"]["accuracy"], "smoothed"))
    if metrics["loop_closure"] and metrics["loop_closure"]["accuracy"]:
        typer.echo("")
        echo_table(_accuracy(metrics["loop_closure"]["accuracy"], "loops closed"))
    if metrics["localization"] and metrics["localization"]["accuracy"]:
        typer.echo("")
        echo_table(_accuracy(metrics["localization"]["accuracy"], "in the map"))
    if metrics["nees"] and "unavailable" not in metrics["nees"]:
        typer.echo("")
        echo_table(_consistency(metrics["nees"]))
    if metrics["nis"]:
        typer.echo("")
        echo_table(_innovations(metrics["nis"]))
    if metrics["calibration"]:
        typer.echo("")
        echo_table(_calibration(metrics["calibration"]))
    typer.echo("")
    typer.echo(f"{folder}/")
    typer.echo("  " + " ".join(path.name for path in files))


def _overview(metrics: _Table) -> Iterator[tuple[str, str]]:
    """Dataset, algorithm, extent, speed and sizes."""
    dataset, extent, timing = metrics["dataset"], metrics["extent"], metrics["timing"]
    cameras = f"{metrics['cameras']} camera{'s' if metrics['cameras'] > 1 else ''}"
    yield "dataset", f"{dataset['name']} ({dataset['format']}, {dataset['content']}, {cameras})"
    yield "algorithm", f"{metrics['algorithm']}, seed {metrics['seed']}"
    yield "status", metrics["status"]
    yield "read", f"{extent['frames']} frames of {extent['recorded_s']:.1f} s"
    if extent["initialization_s"] is not None:
        yield (
            "estimated",
            f"{extent['estimated_frames']} frames, {extent['coverage']:.1%} of the time, "
            f"from {extent['initialization_s']:.2f} s on",
        )
    if timing["frames_per_s"] is not None:
        yield (
            "speed",
            f"{timing['frames_per_s']:.0f} frames/s, {timing['real_time_factor']:.1f} x real time",
        )
    stages = {name: s for name, s in timing["stages"].items() if "." not in name}
    if stages:
        yield "ms a frame", ", ".join(f"{name} {s['mean_ms']:.2f}" for name, s in stages.items())
    if metrics["final_ba"]:
        yield "final BA", _final_ba(metrics["final_ba"])
    if metrics["loop_closure"]:
        table = metrics["loop_closure"]
        found = f"{table['accepted']} accepted of {table['verified']} verified"
        yield "loop closures", f"{found}, {table['keyframes']} keyframes"
    if metrics["slam_map"]:
        table = metrics["slam_map"]
        yield "map", f"{table['keyframes']} keyframes, {table['features']} features"
    if metrics["localization"]:
        yield "located", _located(metrics["localization"])
    if metrics["warnings"]:
        yield "warnings", ", ".join(f"{kind} {n}" for kind, n in metrics["warnings"].items())


def _final_ba(table: _Table) -> str:
    """Size of the final bundle adjustment, and its cost before and after."""
    return (
        f"{table['frames']} frames, {table['keyframes']} keyframes, {table['features']} features, "
        f"{table['iterations']} steps in {table['seconds']:.1f} s, "
        f"cost {table['cost_before']:.3g} to {table['cost_after']:.3g}"
    )


def _located(table: _Table) -> str:
    """How much of the run was located in a map."""
    if table["first_s"] is None:
        return f"never, in {table['queries']} comparisons with the map"
    return (
        f"{table['located']} frames, {table['located_share']:.1%} of all, from "
        f"{table['first_s']:.2f} s on; {table['accepted']} of {table['matches']} "
        f"matches accepted in {table['queries']} comparisons, "
        f"{table['ms_per_frame']:.1f} ms a frame"
    )


def _accuracy(accuracy: _Table, title: str = "alignment") -> Iterator[tuple[str, ...]]:
    """Absolute and relative errors under each alignment."""
    yield title, "ATE rmse [m]", "[deg]", "RPE rmse, 1 m [m]", "[deg]", "scale"
    for mode, table in accuracy.items():
        if "unavailable" in table:
            yield mode, table["unavailable"]
            continue
        steps = table["rpe"]
        yield (
            mode,
            number(table["ate"]["translation_m"]["rmse"]),
            number(table["ate"]["rotation_deg"]["rmse"], 3),
            number(steps["translation_m"]["rmse"] if "delta_m" in steps else None),
            number(steps["rotation_deg"]["rmse"] if "delta_m" in steps else None, 3),
            number(table["scale"]),
        )


def _consistency(nees: _Table) -> Iterator[tuple[str, ...]]:
    """Mean NEES beside its ideal."""
    yield "NEES", "mean", "ideal", "inside 95% bounds"
    for name in ("orientation", "position", "pose"):
        row = nees[name]
        yield name, number(row["mean"], 2), str(row["ideal_mean"]), f"{row['inside_bounds']:.0%}"


def _innovations(nis: _Table) -> Iterator[tuple[str, ...]]:
    """NIS over its degrees of freedom, beside the mean expected after the gate."""
    yield "NIS / dof", "mean", "expected", "inside 95% bounds", "rejected"
    shares = (f"{nis['inside_bounds']:.0%}", f"{nis['rejected']:.1%}")
    yield "images", number(nis["mean"], 2), number(nis["expected_mean"], 2), *shares


def _calibration(parameters: _Table) -> Iterator[tuple[str, ...]]:
    """Estimated parameters of the rig beside their initial values."""
    yield "calibration", "start", "estimate", "1 sigma"
    for name, row in parameters.items():
        values = (f"{row[column]:.6g}" for column in ("start", "value"))
        yield name, *values, f"{row['sigma']:.2g}"
