# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph batch`: many recordings, one run for each, and a summary of all."""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from slam_graph.cli.console import collected_log, echo_json, echo_rich_table, number
from slam_graph.cli.loading import loading
from slam_graph.cli.options import (
    INTERRUPTED,
    Algorithm,
    Calibration,
    Cameras,
    ConfigFile,
    Duration,
    Format,
    Json,
    Overrides,
    Progress,
    RerunImages,
    SaveGraph,
    Seed,
    Sources,
    Start,
    TlsCaFile,
    TlsCert,
    TlsKey,
    graph_times,
    sources_from,
    tls_files,
)

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from slam_graph.cli.batch_progress import BatchProgress

_Row = dict[str, Any]

_EXPLANATION = (
    "ATE, rot.: root mean square errors of the causal estimate, aligned in what nothing measured; "
    "smoothed: ATE after the final bundle adjustment. Speed: times real time."
)
_MOST_REASONS = 10
"""Reasons that are printed; the summary has all."""


def batch(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="PATTERN|LIST.yaml...",
            help="Folders to search for recordings, recordings, patterns (quoted), or lists.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", help="Folder of all results: OUTPUT/<recording>/.")
    ] = Path("results/batch"),
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=1, help="Runs at a time; all cores if not said."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler to do the runs."),
    ] = None,
    tls_ca_file: TlsCaFile = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    algorithm: Algorithm = None,
    config: ConfigFile = None,
    set_: Overrides = None,
    cameras: Cameras = None,
    start: Start = None,
    duration: Duration = None,
    seed: Seed = None,
    final_ba: Annotated[
        bool | None,
        typer.Option(
            "--final-ba/--no-final-ba",
            help="Bundle adjust each whole recording at the end (on by default).",
            show_default=False,
        ),
    ] = None,
    loop_closure: Annotated[
        bool | None,
        typer.Option(
            "--loop-closure/--no-loop-closure",
            help="Recognise places at the end and correct the drift (off by default).",
            show_default=False,
        ),
    ] = None,
    save_map: Annotated[
        bool | None,
        typer.Option(
            "--save-map/--no-save-map",
            help="Save a map of each recording (off by default).",
            show_default=False,
        ),
    ] = None,
    save_graph: SaveGraph = None,
    rerun: Annotated[
        Literal["off", "save"],
        typer.Option("--rerun", help="save: write recording.rrd for Rerun beside each result."),
    ] = "off",
    rerun_images: RerunImages = "all",
    format_: Format = None,
    calibration: Calibration = None,
    sources: Sources = None,
    progress: Progress = True,
    as_json: Json = False,
) -> None:
    """Run all recordings of a folder, of a pattern or of a list, and summarize them.

    Given the same OUTPUT again, only what is left is done. A recording that fails stops no other.
    """
    with loading():
        from slam_graph.experiment import batch as run_batch

    options: dict[str, Any] = {
        "algorithm": algorithm,
        "cameras": cameras,
        "start_s": start,
        "duration_s": duration,
        "seed": seed,
    }
    for name, on in (("final_ba", final_ba), ("loop_closure", loop_closure), ("map", save_map)):
        if on is not None:
            options[name] = {"enabled": on}
    try:
        with _progress(progress) as shown, collected_log():
            done = run_batch(
                what,
                output=output,
                config=config,
                overrides=set_ or (),
                format=format_,
                calibration=calibration,
                sources=sources_from(sources),
                jobs=jobs,
                scheduler=scheduler,
                tls=tls_files(tls_ca_file, tls_cert, tls_key),
                progress=None if shown is None else shown.ended,
                watch=None if shown is None else shown.running,
                rerun=rerun,
                rerun_images=rerun_images,
                graph_times=graph_times(save_graph),
                **options,
            )
    except KeyboardInterrupt:
        typer.echo(
            f"interrupted; finished runs are kept in {output}: give the same command to go on",
            err=True,
        )
        raise typer.Exit(INTERRUPTED) from None
    if as_json:
        files = [str(file) for file in done.files]
        echo_json({"rows": done.rows, "failures": done.failures, "files": files})
    else:
        _echo(done.rows)
        if done.skipped:
            typer.echo(f"{done.skipped} recordings had been done before")
        typer.echo(f"{output}/\n  " + " ".join(file.name for file in done.files))
    _check(done.rows)


def _progress(wanted: bool) -> AbstractContextManager[BatchProgress | None]:
    """Progress on stderr, if it is wanted: live in a terminal, a line for each run in a log."""
    if not wanted:
        return nullcontext()
    from slam_graph.cli.batch_progress import BatchProgress

    return BatchProgress(live=sys.stderr.isatty())


def _echo(rows: list[_Row]) -> None:
    """Print the table, and why recordings did not end well."""
    titles = (
        "recording",
        "status",
        "coverage",
        "aligned in",
        "ATE [m]",
        "rot. [°]",
        "smoothed",
        "speed",
        "warnings",
    )
    columns = list(zip(titles, *map(_cells, rows), strict=True))
    chosen = [column for column in columns if set(column[1:]) != {"-"}]
    table = list(zip(*chosen, strict=True))
    counts = Counter(row["status"] for row in rows)
    states = ", ".join(f"{count} {state}" for state, count in counts.most_common())
    echo_rich_table(table[0], table[1:], f"{len(rows)} recordings: {states}", _EXPLANATION)
    wrong = [row for row in rows if row["status"] != "ok"]
    typer.echo("")
    for row in wrong[:_MOST_REASONS]:
        reason = (row["message"] or row["status"]).removeprefix(f"{row['name']}: ")
        typer.echo(f"  {row['name']}: {reason}")
    if len(wrong) > _MOST_REASONS:
        typer.echo(f"  and {len(wrong) - _MOST_REASONS} more, in summary.csv")


def _cells(row: _Row) -> tuple[str, ...]:
    """A row of the printed table."""
    coverage, speed = row["coverage"], row["real_time_factor"]
    return (
        row["name"],
        row["status"],
        "-" if coverage is None else f"{coverage:.1%}",
        row["alignment"] or "-",
        number(row["ate_m"]),
        number(row["rotation_deg"], 2),
        number(row["smoothed_ate_m"]),
        number(speed, 1),
        "-" if row["warnings"] is None else str(row["warnings"]),
    )


def _check(rows: list[_Row]) -> None:
    """Exit with 1 if a recording could not be run, with 3 if a run did not end well."""
    from slam_graph.errors import DataError, EstimationError

    wrong = [row for row in rows if row["status"] != "ok"]
    lost = [row for row in wrong if row["status"] in ("not_done", "failed")]
    if lost:
        raise DataError(
            f"{len(lost)} of {len(rows)} recordings could not be run; the same command tries "
            "these again"
        )
    if wrong:
        raise EstimationError(f"{len(wrong)} of {len(rows)} runs did not end well")
