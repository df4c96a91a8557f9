# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph view`: results, recordings, maps and graphs in Rerun, after the fact."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from slam_graph.cli.options import (
    Calibration,
    Format,
    Groundtruth,
    RerunAddress,
    Sources,
    open_recording,
    recording_options,
    refuse_ignored,
)
from slam_graph.cli.watching import Watching, keep_serving

if TYPE_CHECKING:
    from slam_graph.datasets import Sequence
    from slam_graph.visualization import RerunRecording

_Show = Callable[["RerunRecording"], None]
_Options = tuple[str | None, Path | None, Path | None, list[str] | None]
"""Format, calibration, ground truth and sources of a recording."""
_FOR_RECORDINGS = "is for recordings, and {} is none"
_RRD = ".rrd"


def view(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="WHAT...",
            help="Folder of results, .rrd file, map, pose graph, BAL problem or recording; several "
            "folders of runs are compared.",
        ),
    ],
    mode: Annotated[
        Literal["spawn", "save", "connect", "serve"],
        typer.Option("--rerun", help="Where it is shown; save writes --output."),
    ] = "spawn",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.rrd", help="Save a recording for Rerun here."),
    ] = None,
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", metavar="FILE.png", help="Save a picture, without a window."),
    ] = None,
    size: Annotated[
        str, typer.Option("--size", metavar="WxH", help="Size of the picture in pixels.")
    ] = "1600x1000",
    images: Annotated[
        bool, typer.Option("--images/--no-images", help="Whether images of a recording are shown.")
    ] = True,
    known_map: Annotated[
        Path | None,
        typer.Option("--map", metavar="MAP", help="Map that the run was located in."),
    ] = None,
    recording_of_run: Annotated[
        str | None,
        typer.Option(
            "--recording",
            metavar="DATA",
            help="Recording of the run: adds its images or tracks and its IMU samples.",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Let --output and --screenshot replace files.")
    ] = False,
    rerun_address: RerunAddress = None,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
) -> None:
    """Show a result, a recording, a map or a graph in Rerun.

    Everything is read from files, so runs that were not watched can be seen as well. With
    --screenshot no window is opened: a picture of it is written. A run that was watched is shown
    as it was then, unless --map, --recording or --no-images ask for its files.
    """
    from slam_graph.errors import ConfigError
    from slam_graph.results import ResultFolder

    if output is not None and output.suffix != _RRD:
        raise ConfigError(f"--output {output}: a recording for Rerun ends with {_RRD}")
    if mode == "save" and output is None:
        raise ConfigError("--rerun save needs --output FILE.rrd")
    pixels = _size(size)
    if screenshot is not None:
        _check_picture(screenshot)
    for path in (output, screenshot):
        if path is not None:
            ResultFolder.refuse_to_replace(path, force)
    if mode != "connect":
        refuse_ignored({"--rerun-address": rerun_address}, "is for --rerun connect")
    options = (format_, calibration, groundtruth, sources)
    wanted = {
        "--map": known_map,
        "--recording": recording_of_run,
        "--no-images": not images,
        **recording_options(*options),
    }
    existing = _recording_of(what, [option for option, value in wanted.items() if value])
    if existing is not None:
        _show_existing(existing, mode, output, screenshot, pixels, rerun_address)
        return
    name, show = _shown(what, images, known_map, recording_of_run, options)
    with tempfile.TemporaryDirectory(prefix="slam_graph_") as folder:
        files = output is not None or screenshot is not None
        path = output or Path(folder) / f"{name}{_RRD}"
        watching = Watching("save") if files else Watching(mode, address=rerun_address)
        with watching.recording(path, name) as recording:
            show(recording)
            if not files:
                keep_serving(mode)
        if screenshot is not None:
            recording.screenshot(path, screenshot, pixels)
    for written in (output, screenshot):
        if written is not None:
            typer.echo(str(written))


def _check_picture(path: Path) -> None:
    """Refuse a picture that cannot be written, before any work."""
    from slam_graph.errors import ConfigError
    from slam_graph.visualization import RerunRecording

    if path.suffix.lower() != ".png":
        raise ConfigError(f"--screenshot {path}: a picture ends with .png")
    RerunRecording.check_picture(path)


def _size(text: str) -> tuple[int, int]:
    """Width and height."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise typer.BadParameter(f"'{text}' is not of the form WxH", param_hint="--size")
    return int(width), int(height)


def _recording_of(what: list[str], options: list[str]) -> Path | None:
    """The recording for Rerun that is meant: a file, or that of a run that was watched.

    Args:
        what: is to be shown.
        options: that were given and need other files than the recording.

    Raises:
        ConfigError: if it is a file, for which there are no such options.
    """
    from slam_graph.errors import ConfigError

    if len(what) != 1:
        return None
    path = Path(what[0])
    if path.suffix == _RRD:
        if options:
            raise ConfigError(f"{path}: shown as it was recorded; {options[0]} changes nothing")
        return path
    if options:
        return None
    for folder in (path, path / "latest"):
        if (folder / "recording.rrd").is_file():
            return folder / "recording.rrd"
    return None


def _show_existing(
    path: Path,
    mode: str,
    output: Path | None,
    screenshot: Path | None,
    pixels: tuple[int, int],
    address: str | None,
) -> None:
    """Show a recording for Rerun."""
    from slam_graph.errors import ConfigError
    from slam_graph.visualization import RerunRecording

    if output is not None:
        raise ConfigError(f"{path} is a recording for Rerun already; copy it to {output}")
    if screenshot is not None:
        RerunRecording.screenshot(path, screenshot, pixels)
        typer.echo(str(screenshot))
    elif mode == "serve":
        with RerunRecording.serve(path) as url:
            typer.echo(f"open {url} in a browser", err=True)
            keep_serving("serve")
    elif mode == "connect":
        RerunRecording.send(path, address)
    else:
        RerunRecording.open(path)


def _shown(
    what: list[str],
    images: bool,
    known_map: Path | None,
    recording_of_run: str | None,
    options: _Options,
) -> tuple[str, _Show]:
    """The name of what is meant, and what logs it.

    Raises:
        ConfigError: if options do not fit what is to be shown.
        DataError: if it cannot be read.
    """
    from slam_graph.cli import view_files as files
    from slam_graph.errors import ConfigError

    given = recording_options(*options)
    of_run = known_map is not None or recording_of_run is not None
    misplaced = "--map and --recording are for the folder of one run"
    if len(what) > 1:
        from slam_graph.cli.view_runs import runs_compared

        if of_run:
            raise ConfigError(misplaced)
        refuse_ignored(given, "is for recordings, and these are results of runs")
        return "comparison", runs_compared([Path(path) for path in what])
    path = Path(what[0])
    for folder in (path, path / "latest"):
        if not folder.is_dir():
            continue
        wanted = None
        if files.is_run(folder):
            sequence = _recording_of_run(folder, recording_of_run, options)
            wanted = files.RunOptions(known_map, sequence, images)
        elif of_run and files.of_folder(folder) is not None:
            raise ConfigError(f"{folder}: {misplaced}")
        if (found := files.of_folder(folder, wanted)) is not None:
            if wanted is None:
                refuse_ignored(given, _FOR_RECORDINGS.format(folder))
            return folder.resolve().parent.name or path.name, found
    if of_run:
        raise ConfigError(f"{path}: {misplaced}")
    if path.is_file() and options[0] is None and (found := files.of_file(path)) is not None:
        refuse_ignored(given, _FOR_RECORDINGS.format(path))
        return path.stem, found
    sequence = open_recording(what[0], *options)
    return sequence.info().name, lambda recording: recording.show_recording(sequence, images)


def _recording_of_run(folder: Path, data: str | None, options: _Options) -> Sequence | None:
    """The recording of a run, if it was named.

    Raises:
        ConfigError: if options would change nothing.
        DataError: if it cannot be opened.
    """
    given = recording_options(*options)
    truth = {"--groundtruth": given.get("--groundtruth")}
    refuse_ignored(truth, f"changes nothing: {folder} is shown with the ground truth of the run")
    if data is None:
        refuse_ignored(given, f"is for the recording of {folder}: name it by --recording DATA")
        return None
    return open_recording(data, *options)
