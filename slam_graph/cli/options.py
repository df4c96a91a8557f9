# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Options and arguments that several commands share, and what they mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from slam_graph.datasets import RecordedSequence

ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="YAML file of settings, which replace the defaults."),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting; may be repeated."),
]
Algorithm = Annotated[
    str | None, typer.Option("--algorithm", help="Name of an algorithm, or its YAML file.")
]
Data = Annotated[
    str,
    typer.Argument(
        metavar="DATA",
        help="Recording: a folder or file; `demo` for the recording that comes with GTSAM.",
    ),
]
Format = Annotated[
    str | None, typer.Option("--format", help="Format of the data; detected by default.")
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
    str | None,
    typer.Option("--cameras", metavar="mono|stereo|N", help="Cameras to use; all by default."),
]
Start = Annotated[
    float | None, typer.Option("--start", help="Seconds after the first frame to start at.")
]
Duration = Annotated[
    float | None, typer.Option("--duration", help="Seconds to run; to the end by default.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
RerunMode = Literal["off", "save", "spawn", "connect"]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of random numbers.")]
Output = Annotated[
    Path, typer.Option("--output", help="Folder of results: OUTPUT/<dataset>/<UTC time>/.")
]
Rerun = Annotated[
    RerunMode, typer.Option("--rerun", help="Show the run in Rerun, or save it for Rerun.")
]
Progress = Annotated[
    bool, typer.Option("--progress/--no-progress", help="Show progress on stderr.")
]

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def _sources_from(texts: list[str] | None) -> dict[str, str]:
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
    """Open the recording that the options name, with its first `cameras` cameras or all."""
    from slam_graph.datasets import open_dataset

    return open_dataset(
        data,
        format=format_,
        cameras=cameras,
        calibration=calibration,
        groundtruth=groundtruth,
        sources=_sources_from(sources),
    )
