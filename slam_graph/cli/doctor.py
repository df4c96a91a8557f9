# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph doctor`: what is wrong with a recording, how sure that is, and what mends it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from slam_graph.cli.console import echo_json
from slam_graph.cli.options import (
    Calibration,
    Cameras,
    Data,
    Format,
    Inject,
    Json,
    NoImu,
    Sources,
    open_recording,
)

if TYPE_CHECKING:
    from slam_graph.diagnosis import Diagnosis


def doctor(
    data: Data,
    format_: Format = None,
    calibration: Calibration = None,
    sources: Sources = None,
    no_imu: NoImu = False,
    cameras: Cameras = None,
    inject: Inject = None,
    as_json: Json = False,
) -> None:
    """Say what is wrong with a recording: units, axes, clocks, calibration, images.

    Each finding says how sure it is and what mends it. The exit code is 1 if there is an error,
    which would make the result of a run worthless, and 0 otherwise.
    """
    from slam_graph.config import load_config
    from slam_graph.diagnosis import Diagnosis

    count = load_config(cameras=cameras).cameras
    sequence = open_recording(data, format_, calibration, None, sources, count, inject, no_imu)
    diagnosis = Diagnosis.of(sequence)
    if as_json:
        echo_json({"recording": sequence.name, **diagnosis.as_dict()})
    else:
        _report(diagnosis, sequence.name)
    if diagnosis.errors:
        raise typer.Exit(1)


def _report(diagnosis: Diagnosis, name: str) -> None:
    """Print the findings, and what to do about each."""
    for finding in diagnosis.findings:
        sure = "" if finding.severity == "info" else f", {finding.sure}"
        typer.echo(f"{finding.severity}{sure}: {finding.what}")
        if finding.fix:
            typer.echo(f"  to do: {finding.fix}")
    faults = len(diagnosis.faults)
    said = "nothing wrong was found" if not faults else f"{faults} fault{'s' * (faults > 1)} found"
    typer.echo(f"{name}: {said}")
