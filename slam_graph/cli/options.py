# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and what all problems of `slam-graph optimize` share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeVar

import typer

from slam_graph.cli.loading import loading
from slam_graph.interrupts import Interrupts

if TYPE_CHECKING:
    from pydantic import BaseModel

    from slam_graph.config import RunConfig
    from slam_graph.datasets import RecordedSequence


_SETTINGS, _RECORDING, _VIEWER = "Settings", "Recording", "Rerun"
"""Panels of the help."""

ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="YAML file of settings, which replace the defaults.",
        rich_help_panel=_SETTINGS,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change one setting; may be repeated.",
        rich_help_panel=_SETTINGS,
    ),
]
Algorithm = Annotated[
    str | None,
    typer.Option(
        "--algorithm",
        help="Name of an algorithm, or its YAML file.",
        rich_help_panel=_SETTINGS,
    ),
]
Data = Annotated[
    str,
    typer.Argument(
        metavar="DATA",
        help="Recording: a folder or file; `demo` for the recording that comes with GTSAM.",
    ),
]
Format = Annotated[
    str | None,
    typer.Option(
        "--format", help="Format of the data; detected by default.", rich_help_panel=_RECORDING
    ),
]
Calibration = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        help="Kalibr YAML to use instead of the data's.",
        rich_help_panel=_RECORDING,
    ),
]
Groundtruth = Annotated[
    Path | None,
    typer.Option(
        "--groundtruth",
        help="True trajectory to use instead of the data's.",
        rich_help_panel=_RECORDING,
    ),
]
Sources = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        "--source",
        metavar="SENSOR=WHERE",
        help="Where a sensor is, repeatable. Topics of a ROS bag: imu=/imu0, cam0=/cam0, "
        "depth=/depth, groundtruth=/pose; files of a video or image folder: stamps=times.csv, "
        "imu=imu.csv, or rate=30 instead of stamps; anywhere gnss=fixes.csv, poses=poses.csv, "
        "odometry=wheels.csv.",
        rich_help_panel=_RECORDING,
    ),
]
Cameras = Annotated[
    str | None,
    typer.Option(
        "--cameras",
        metavar="mono|stereo|N",
        help="Cameras to use; all by default.",
        rich_help_panel=_RECORDING,
    ),
]
NoImu = Annotated[
    bool,
    typer.Option("--no-imu", help="Read it as if it had no IMU.", rich_help_panel=_RECORDING),
]
Inject = Annotated[
    list[str] | None,
    typer.Option(
        "--inject",
        metavar="FAULT[:SETTING=VALUE,…]",
        help="Put a fault into the recording, repeatable, e.g. imu_missing:at_s=6,duration_s=1.",
        show_default=False,
        rich_help_panel=_RECORDING,
    ),
]
Objects = Annotated[
    bool | None,
    typer.Option(
        "--objects/--no-objects",
        help="Estimate moving objects, too (off by default).",
        show_default=False,
    ),
]
Start = Annotated[
    float | None,
    typer.Option(
        "--start", help="Seconds after the first frame to start at.", rich_help_panel=_RECORDING
    ),
]
Duration = Annotated[
    float | None,
    typer.Option(
        "--duration", help="Seconds to run; to the end by default.", rich_help_panel=_RECORDING
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
RerunMode = Literal["off", "save", "spawn", "connect", "serve"]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of random numbers.")]
Output = Annotated[
    Path, typer.Option("--output", help="Folder of results: OUTPUT/<dataset>/<UTC time>/.")
]
Rerun = Annotated[
    RerunMode,
    typer.Option(
        "--rerun",
        help="Watch the run in Rerun: save a recording, spawn a window, connect to a viewer that "
        "is open, or serve to a browser.",
        rich_help_panel=_VIEWER,
    ),
]
RerunImages = Annotated[
    Literal["none", "keyframes", "all"],
    typer.Option(
        "--rerun-images", help="Of which frames Rerun is given images.", rich_help_panel=_VIEWER
    ),
]
RerunDetail = Annotated[
    Literal["normal", "graph"],
    typer.Option(
        "--rerun-detail",
        help="graph adds the factor graph of every window, and its information matrix before and "
        "after marginalization.",
        rich_help_panel=_VIEWER,
    ),
]
RerunAddress = Annotated[
    str | None,
    typer.Option(
        "--rerun-address",
        metavar="URL",
        help="Viewer to connect to; rerun+http://127.0.0.1:9876/proxy by default.",
        show_default=False,
        rich_help_panel=_VIEWER,
    ),
]
SaveGraph = Annotated[
    list[str] | None,
    typer.Option(
        "--save-graph",
        metavar="STAMP",
        help="Save the factor graph of the back end at this time, repeatable: seconds after "
        "the first frame, or a stamp in ns. Files for GTSAM and Graphviz.",
        show_default=False,
    ),
]
Progress = Annotated[
    bool, typer.Option("--progress/--no-progress", help="Show progress on stderr.")
]

INTERRUPTED = 130
"""Exit code after Ctrl-C."""
SUSPECT = 4
"""Exit code of a run that came to its end, but may be wrong."""


def sources_from(texts: list[str] | None) -> dict[str, str]:
    """Where each sensor is, from texts ``sensor=where``."""
    pairs = [text.partition("=") for text in texts or []]
    for text, (sensor, _, where) in zip(texts or [], pairs, strict=True):
        if not sensor or not where:
            raise typer.BadParameter(f"'{text}' is not of the form SENSOR=WHERE")
    return {sensor: where for sensor, _, where in pairs}


def recording_options(
    format_: str | None,
    calibration: Path | None,
    groundtruth: Path | None,
    sources: list[str] | None,
) -> dict[str, object]:
    """Options for recordings, by their names, as far as they were given."""
    options = {
        "--format": format_,
        "--calibration": calibration,
        "--groundtruth": groundtruth,
        "--topic": sources,
    }
    return {name: value for name, value in options.items() if value}


def refuse_ignored(given: Mapping[str, object], why: str) -> None:
    """Refuse options that would change nothing.

    Args:
        given: values by the names of the options.
        why: for the message, after the name of the first one.

    Raises:
        ConfigError: if any was given.
    """
    from slam_graph.errors import ConfigError

    for name, value in given.items():
        if value:
            raise ConfigError(f"{name} {why}")


def open_recording(
    data: str,
    format_: str | None,
    calibration: Path | None,
    groundtruth: Path | None,
    sources: list[str] | None,
    cameras: int | None = None,
    faults: list[str] | None = None,
    no_imu: bool = False,
) -> RecordedSequence:
    """Open the recording that the options name, with its first `cameras` cameras or all.

    Faults are put into it as far as `--inject` asks for them; its IMU is left out by `--no-imu`.
    """
    with loading(f"opening {data}"):
        from slam_graph.datasets import open_dataset

        return open_dataset(
            data,
            format=format_,
            cameras=cameras,
            calibration=calibration,
            groundtruth=groundtruth,
            sources=sources_from(sources),
            faults=faults or (),
            imu=not no_imu,
        )


def run_settings(
    config: Path | None,
    overrides: list[str] | None,
    parts: Mapping[str, bool | None],
    **options: Any,
) -> RunConfig:
    """The settings of a run.

    Args:
        config: YAML file, if there is one.
        overrides: `key=value` each.
        parts: whether each part of a run is enabled, by its table; None changes nothing.
        options: top-level settings; None changes nothing.
    """
    tables = {name: {"enabled": on} for name, on in parts.items() if on is not None}
    with loading():
        from slam_graph.config import load_config

        return load_config(config, overrides or (), **options, **tables)


_Policy = TypeVar("_Policy", bound="BaseModel")


class _Result(Protocol):
    """The result of an optimisation."""

    def save(self, folder: Path) -> list[Path]:
        """Write all files into a folder."""
        ...


TlsCaFile = Annotated[
    Path | None,
    typer.Option("--tls-ca-file", metavar="PEM", help="Authority that the scheduler is proved by."),
]
TlsCert = Annotated[
    Path | None, typer.Option("--tls-cert", metavar="PEM", help="Certificate of this client.")
]
TlsKey = Annotated[
    Path | None, typer.Option("--tls-key", metavar="PEM", help="Key of that certificate.")
]


def tls_files(ca_file: Path | None, cert: Path | None, key: Path | None) -> dict[str, Path]:
    """The files for TLS that are given, by name."""
    given = {"ca_file": ca_file, "cert": cert, "key": key}
    return {name: path for name, path in given.items() if path is not None}


def read_policy(
    kind: type[_Policy],
    file: Path | None,
    overrides: list[str],
    options: Mapping[tuple[str, str], Any],
) -> _Policy:
    """The settings: the file, then options, then overrides.

    Args:
        kind: of policy.
        file: YAML, if there is one.
        overrides: `key=value` each.
        options: values by table and name; None changes nothing.
    """
    from slam_graph.settings import ConfigTree

    tree = ConfigTree() if file is None else ConfigTree.read(file)
    for (table, name), value in options.items():
        if value is not None:
            where = f"option {name}"
            places: dict[tuple[str | int, ...], str] = {(table,): where, (table, name): where}
            tree.merge(ConfigTree({table: {name: value}}, places))
    for text in overrides:
        tree.merge(ConfigTree.override(text))
    return tree.validated(kind)


def write_result(
    result: _Result, name: str, output: Path, log: list[str]
) -> tuple[Path, list[Path]]:
    """Write all files into a new folder, named after the problem, or nothing if that fails."""
    from slam_graph.results import ResultFolder

    with Interrupts.completed() as begin, ResultFolder.of_run(output, name) as made:
        begin()
        try:
            made.files += result.save(made.folder)
            made.text("run.log", log)
        except BaseException:
            made.discard()  # a part of the files would look like a result
            raise
    return made.folder, made.files


@contextmanager
def timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Note how long a block takes."""
    start = perf_counter()
    yield
    seconds[part] = perf_counter() - start


def graph_times(texts: list[str] | None) -> list[int | float]:
    """The times of `--save-graph`: seconds, or stamps in ns, which a float could not hold."""
    times: list[int | float] = []
    for text in texts or ():
        try:
            times.append(int(text) if text.isdecimal() else float(text))
        except ValueError as error:
            raise typer.BadParameter(
                f"'{text}' is neither seconds nor a stamp in ns", param_hint="--save-graph"
            ) from error
    return times
