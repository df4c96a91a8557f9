# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph data`: what a recording holds, what is wrong with it, and its EuRoC form."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slam_graph.cli.output import echo_json, echo_table

if TYPE_CHECKING:
    from slam_graph.datasets.sequence import RecordedSequence, Sequence

app = typer.Typer(
    help="Look at recordings, check and convert them.", no_args_is_help=True, rich_markup_mode=None
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
Sources = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        "--source",
        metavar="SENSOR=WHERE",
        help="Where a sensor is, repeatable. Topics of a ROS bag: imu=/imu0, cam0=/cam0, "
        "groundtruth=/pose; files of a video or image folder: stamps=times.csv, imu=imu.csv, or "
        "rate=30 instead of stamps.",
    ),
]
Cameras = Annotated[
    str | None, typer.Option("--cameras", metavar="mono|stereo|N", help="Cameras to use.")
]
Start = Annotated[
    float | None, typer.Option("--start", help="Seconds after the first frame to start at.")
]
Duration = Annotated[
    float | None, typer.Option("--duration", help="Seconds to run; to the end if not said.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def info(
    data: Data,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    as_json: Json = False,
) -> None:
    """Show what a recording holds, without reading it whole."""
    sequence = open_recording(data, format_, calibration, groundtruth, sources)
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
    sources: Sources = None,
    images: Annotated[bool, typer.Option("--images", help="Read every image too.")] = False,
    as_json: Json = False,
) -> None:
    """Read a recording and report what is wrong with it; the exit code is 1 if it is unusable."""
    from slam_graph.datasets.data_checks import check_sequence

    sequence = open_recording(data, format_, calibration, groundtruth, sources)
    findings = check_sequence(sequence, read_images=images)
    errors = sum(finding.severity == "error" for finding in findings)
    if as_json:
        echo_json({"errors": errors, "findings": [asdict(finding) for finding in findings]})
    else:
        echo_table((finding.severity, finding.where, finding.what) for finding in findings)
        typer.echo(f"{sequence.info().name}: {'unusable' if errors else 'ok'}")
    if errors:
        raise typer.Exit(1)


@app.command()
def convert(
    data: Data,
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="New folder to write.")],
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace OUTPUT if it is an EuRoC folder.")
    ] = False,
    progress: Annotated[
        bool, typer.Option("--progress/--no-progress", help="Show progress on stderr.")
    ] = True,
) -> None:
    """Write a recording of images as an EuRoC folder, whole or not at all."""
    from slam_graph.cli.progress import ProgressBar
    from slam_graph.datasets.formats.euroc_writer import convert_to_euroc, refuse_existing

    refuse_existing(output, force)
    sequence = open_recording(data, format_, calibration, groundtruth, sources)
    info = sequence.info()
    with ProgressBar(info.start_ns, info.end_ns) if progress else nullcontext() as bar:
        told = None if bar is None else lambda stamp_ns: bar.advance(stamp_ns, True)
        convert_to_euroc(sequence, output, force, told)
    for kind, count in sequence.diagnostics.counts.items():
        typer.echo(f"warning: {kind} {count}", err=True)
    typer.echo(str(output))


def sources_from(texts: list[str] | None) -> dict[str, str]:
    """Where each sensor is, from texts ``sensor=where``."""
    pairs = [text.partition("=") for text in texts or []]
    for text, (sensor, _, where) in zip(texts or [], pairs, strict=True):
        if not sensor or not where:
            raise typer.BadParameter(f"'{text}' is not of the form SENSOR=WHERE")
    return {sensor: where for sensor, _, where in pairs}


def open_recording(
    data: str,
    format_: str | None,
    calibration: Path | None,
    groundtruth: Path | None,
    sources: list[str] | None,
    cameras: int | None = None,
) -> RecordedSequence:
    """The recording that the options of a command mean, with its first `cameras` cameras or all."""
    from slam_graph.datasets.dataset_registry import open_dataset

    return open_dataset(
        data,
        format=format_,
        cameras=cameras,
        calibration=calibration,
        groundtruth=groundtruth,
        sources=sources_from(sources),
    )


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
            "shutter": "rolling" if mounted.rolling_shutter else "global",
        }
        for index, mounted in enumerate(sequence.rig.cameras)
    ]
    return table
