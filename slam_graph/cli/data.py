# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph data`: what a recording holds, and what is wrong with it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slam_graph.cli.output import echo_json, echo_table

if TYPE_CHECKING:
    from slam_graph.datasets.base import Sequence

app = typer.Typer(
    help="Look at recordings and check them.", no_args_is_help=True, rich_markup_mode=None
)

Data = Annotated[
    str,
    typer.Argument(
        metavar="DATA", help="Recording: a folder or file; `demo` for the one that comes along."
    ),
]
Format = Annotated[
    str | None, typer.Option("--format", help="Format of the data; guessed if not said.")
]
Calibration = Annotated[
    Path | None, typer.Option("--calibration", help="Kalibr YAML to use instead of the data's.")
]
Groundtruth = Annotated[
    Path | None, typer.Option("--groundtruth", help="True trajectory to use instead of the data's.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def info(
    data: Data,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    as_json: Json = False,
) -> None:
    """Show what a recording holds, without reading it whole."""
    from slam_graph.datasets.registry import open_dataset

    sequence = open_dataset(data, format=format_, calibration=calibration, groundtruth=groundtruth)
    table = _describe(sequence)
    if as_json:
        echo_json(table)
        return
    for camera in table.pop("camera_models"):
        name = camera.pop("name")
        table[name] = ", ".join(f"{key} {value}" for key, value in camera.items())
    echo_table((name, str(value)) for name, value in table.items())


@app.command()
def check(
    data: Data,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    images: Annotated[bool, typer.Option("--images", help="Read every image too.")] = False,
    as_json: Json = False,
) -> None:
    """Read a recording and report what is wrong with it; the exit code is 1 if it is unusable."""
    from slam_graph.datasets.checks import check_sequence
    from slam_graph.datasets.registry import open_dataset

    sequence = open_dataset(data, format=format_, calibration=calibration, groundtruth=groundtruth)
    findings = check_sequence(sequence, read_images=images)
    errors = sum(finding.severity == "error" for finding in findings)
    if as_json:
        echo_json({"errors": errors, "findings": [asdict(finding) for finding in findings]})
    else:
        echo_table((finding.severity, finding.where, finding.what) for finding in findings)
        typer.echo(f"{sequence.info().name}: {'unusable' if errors else 'ok'}")
    if errors:
        raise typer.Exit(1)


def _describe(sequence: Sequence) -> dict[str, Any]:
    """What a sequence holds, as a table."""
    info = sequence.info()
    table = asdict(info)
    table["duration_s"] = (info.end_ns - info.start_ns) * 1e-9
    table["camera_models"] = [
        {
            "name": mounted.name or f"cam{index}",
            "width": mounted.camera.width,
            "height": mounted.camera.height,
            "fx": mounted.camera.fx,
            "fy": mounted.camera.fy,
            "distortion": mounted.camera.distortion,
            "time_offset_s": mounted.time_offset_s,
        }
        for index, mounted in enumerate(sequence.rig.cameras)
    ]
    return table
