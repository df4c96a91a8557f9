# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph data`: show, check and convert recordings."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slam_graph.cli.console import echo_json, echo_table
from slam_graph.cli.options import (
    Calibration,
    Data,
    Format,
    Groundtruth,
    Json,
    NoImu,
    Progress,
    Sources,
    open_recording,
)

if TYPE_CHECKING:
    from slam_graph.datasets import Sequence
    from slam_graph.diagnosis import Diagnosis

app = typer.Typer(
    help="Show, check and convert recordings.", no_args_is_help=True, rich_markup_mode="rich"
)


@app.command()
def info(
    data: Data,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    no_imu: NoImu = False,
    as_json: Json = False,
) -> None:
    """Show what a recording holds, without reading all of it."""
    sequence = open_recording(data, format_, calibration, groundtruth, sources, no_imu=no_imu)
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
    no_imu: NoImu = False,
    images: Annotated[bool, typer.Option("--images", help="Also read every image.")] = False,
    as_json: Json = False,
) -> None:
    """Read a recording and report faults in it; the exit code is 1 if it is unusable.

    With --images also what slam-graph doctor finds without tracks: units, exposure, sharpness.
    """
    from slam_graph.datasets import check_sequence
    from slam_graph.diagnosis import Diagnosis

    sequence = open_recording(data, format_, calibration, groundtruth, sources, no_imu=no_imu)
    findings = [asdict(finding) for finding in check_sequence(sequence, read_images=images)]
    if images:
        findings = _joined(findings, Diagnosis.quick(sequence))
    errors = sum(finding["severity"] == "error" for finding in findings)
    if as_json:
        echo_json({"errors": errors, "findings": findings})
    else:
        echo_table((found["severity"], found["where"], found["what"]) for found in findings)
        typer.echo(f"{sequence.info().name}: {'unusable' if errors else 'ok'}")
    if errors:
        raise typer.Exit(1)


_ALSO_CHECKED = {"imu_rate", "imu_gaps", "imu_missing", "frame_pauses", "frames_missing"}
"""Kinds of findings of a diagnosis that the check of a recording has, too."""


def _joined(findings: list[dict[str, Any]], diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """The findings of the check and the faults of a diagnosis, errors first."""
    further = [
        {"severity": f.severity, "what": f"{f.what}; {f.fix}", "where": f.kind}
        for f in diagnosis.faults
        if f.kind not in _ALSO_CHECKED
    ]
    order = ("error", "warning", "info")
    return sorted([*findings, *further], key=lambda found: order.index(found["severity"]))


@app.command()
def convert(
    data: Data,
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="New folder to write.")],
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    no_imu: NoImu = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace OUTPUT if it is an EuRoC folder.")
    ] = False,
    progress: Progress = True,
) -> None:
    """Write a recording of images as an EuRoC folder, whole or not at all."""
    from slam_graph.cli.console import ProgressBar
    from slam_graph.datasets import EurocWriter

    EurocWriter.refuse_existing(output, force)
    sequence = open_recording(data, format_, calibration, groundtruth, sources, no_imu=no_imu)
    info = sequence.info()
    with ProgressBar(info.start_ns, info.end_ns) if progress else nullcontext() as bar:
        report = None if bar is None else lambda stamp_ns: bar.advance(stamp_ns, True)
        EurocWriter.convert(sequence, output, force, report)
    for kind, count in sequence.diagnostics.counts.items():
        typer.echo(f"warning: {kind} {count}", err=True)
    typer.echo(str(output))


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
            "readout_s": mounted.readout_s,
        }
        for index, mounted in enumerate(sequence.rig.cameras)
    ]
    depth = sequence.rig.depth
    if depth is not None:
        table["depth"] = (
            f"of camera {depth.camera}, {depth.min_m:g} to {depth.max_m:g} m, sigma "
            f"{depth.noise_constant_m:g} m + {depth.noise_square_per_m:g} z²/m, "
            + ("registered" if depth.lens is None else "of a camera of its own")
        )
    return table
