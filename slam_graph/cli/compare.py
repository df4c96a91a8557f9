# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph compare`: several algorithms on the tracks of one front end."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam_graph.cli.console import echo_json, echo_rich_table
from slam_graph.cli.options import (
    INTERRUPTED,
    ConfigFile,
    Json,
    Overrides,
    Sources,
    TlsCaFile,
    TlsCert,
    TlsKey,
    sources_from,
    tls_files,
)


def compare(
    data: Annotated[
        list[str],
        typer.Argument(
            metavar="DATA...",
            help="Recordings, or simulations: sim:figure8, sim:rooms, sim:random, or sim:PATH of a "
            "recorded flight with its IMU.",
        ),
    ],
    algorithms: Annotated[
        str, typer.Option("--algorithms", help="Names or YAML files, with commas between.")
    ] = "msckf,swf,okvis,ekf,iekf",
    without_fej: Annotated[
        bool,
        typer.Option(
            "--without-fej",
            help="Run each algorithm also without first-estimates Jacobians, as NAME_no_fej.",
        ),
    ] = False,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, help="How many seeds to run everything with.")
    ] = 1,
    output: Annotated[
        Path, typer.Option("--output", help="Folder of tracks, results and report.")
    ] = Path("results/comparison"),
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes at a time; all cores if not said."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler to do the work."),
    ] = None,
    tls_ca_file: TlsCaFile = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    duration: Annotated[
        float | None, typer.Option("--duration", help="Seconds to run; all if not said.")
    ] = None,
    cameras: Annotated[
        str | None, typer.Option("--cameras", metavar="mono|stereo|N", help="Cameras to use.")
    ] = None,
    config: ConfigFile = None,
    set_: Overrides = None,
    sim_set: Annotated[
        list[str] | None,
        typer.Option(
            "--sim-set", metavar="KEY=VALUE", help="Set one value of all simulations; repeatable."
        ),
    ] = None,
    groundtruth: Annotated[
        list[str] | None,
        typer.Option(
            "--groundtruth", metavar="DATA=PATH", help="True trajectory of a recording; repeatable."
        ),
    ] = None,
    sources: Sources = None,
    progress: Annotated[
        bool, typer.Option("--progress/--no-progress", help="Show progress on stderr.")
    ] = True,
    as_json: Json = False,
) -> None:
    """Run several algorithms on the same feature tracks, and report how they compare.

    Given the same OUTPUT again, only what has not been done yet is done.
    """
    from slam_graph.experiment import compare as run_comparison

    try:
        comparison = run_comparison(
            data,
            algorithms,
            seeds=seeds,
            output=output,
            config=config,
            overrides=set_ or (),
            simulation=sim_set or (),
            groundtruth=_truths(groundtruth or []),
            sources=sources_from(sources),
            without_fej=without_fej,
            workers=workers,
            scheduler=scheduler,
            tls=tls_files(tls_ca_file, tls_cert, tls_key),
            progress=_print_task if progress else None,
            duration_s=duration,
            cameras=cameras,
        )
    except KeyboardInterrupt:
        typer.echo(
            f"interrupted; finished tasks are kept in {output}: give the same command to go on",
            err=True,
        )
        raise typer.Exit(INTERRUPTED) from None
    if as_json:
        files = [str(file) for file in comparison.files]
        echo_json({"rows": comparison.rows, "failures": comparison.failures, "files": files})
    else:
        _echo(comparison.table)
        if comparison.skipped:
            typer.echo(f"\n{comparison.skipped} tasks had been done before")
        typer.echo(f"\n{comparison.folder}/")
        typer.echo("  " + " ".join(file.name for file in comparison.files))
    _raise_failures(comparison.failures)


def _truths(texts: list[str]) -> dict[str, str]:
    """The paths of ground truth, by the data that they belong to."""
    pairs = [text.rpartition("=") for text in texts]
    for text, (name, _, path) in zip(texts, pairs, strict=True):
        if not name or not path:
            raise typer.BadParameter(f"'{text}' is not of the form DATA=PATH")
    return {name: path for name, _, path in pairs}


def _print_task(task: str, failure: str | None, count: int, total: int) -> None:
    """Print on stderr that a task has ended."""
    ending = "" if failure is None else f": failed: {failure}"
    typer.echo(f"{count}/{total} {task}{ending}", err=True)


_SHOWN = {
    "algorithm": "algorithm",
    "aligned in": "aligned in",
    "ATE [m]": "ATE [m]",
    "orientation [deg]": "rot. [°]",
    "ATE world of fixes [m]": "of fixes [m]",
    "NEES pose": "NEES",
    "NIS / expected": "NIS",
    "steps": "steps",
    "ms a frame": "ms/frame",
    "peak MB": "MB",
    "status": "status",
}
"""Columns of the table that are printed, and their titles there; the report has more."""

_MEANINGS = {
    "ATE [m]": "ATE, rot.: root mean square errors, aligned in what nothing measured.",
    "of fixes [m]": "of fixes: ATE in the world of the fixes, not aligned.",
    "NEES": "NEES of the pose (ideal 6).",
    "NIS": "NIS over its expected value (ideal 1).",
}
"""What is said of printed columns, by their titles."""


def _echo(table: list[tuple[str, ...]]) -> None:
    """Print a table for each data set, of rows under a row of titles."""
    titles, *rows = table
    names = list(dict.fromkeys(row[0] for row in rows))
    tables = [_informative([titles, *(row for row in rows if row[0] == name)]) for name in names]
    printed = {title for shown in tables for title in shown[0]}
    meanings = [text for title, text in _MEANINGS.items() if title in printed]
    caption = " ".join([*meanings, "The report has more columns."])
    for name, shown in zip(names, tables, strict=True):
        echo_rich_table(shown[0], shown[1:], name, caption=caption if name == names[-1] else "")


def _informative(table: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The columns that are printed and have any number."""
    columns = [
        (_SHOWN[values[0]], *values[1:])
        for values in zip(*table, strict=True)
        if values[0] in _SHOWN and set(values[1:]) != {"-"}
    ]
    return list(zip(*columns, strict=True))


def _raise_failures(failures: dict[str, str]) -> None:
    """Exit with code 1 if a task failed; a run that diverged is a result."""
    from slam_graph.errors import DataError

    if failures:
        name, reason = next(iter(failures.items()))
        several = f"{len(failures)} tasks could not be done; the first: "
        raise DataError(f"{several if len(failures) > 1 else ''}{name}: {reason}")
