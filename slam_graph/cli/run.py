# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph run`: a recorded sequence in, a trajectory out."""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slam_graph.cli.logs import collected_log, remove_if_empty
from slam_graph.cli.options import (
    INTERRUPTED,
    Algorithm,
    Calibration,
    Cameras,
    ConfigFile,
    Data,
    Duration,
    Format,
    Groundtruth,
    Json,
    Output,
    Overrides,
    Progress,
    Rerun,
    RerunMode,
    Seed,
    Sources,
    Start,
    open_recording,
)
from slam_graph.cli.printing import echo_json
from slam_graph.cli.progress import ProgressBar
from slam_graph.cli.summary import echo_summary

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from slam_graph.config import RunConfig
    from slam_graph.datasets import Sequence
    from slam_graph.maps import SlamMap
    from slam_graph.results import RunResult


def run(
    data: Data,
    algorithm: Algorithm = None,
    config: ConfigFile = None,
    set_: Overrides = None,
    cameras: Cameras = None,
    start: Start = None,
    duration: Duration = None,
    seed: Seed = None,
    output: Output = Path("results"),
    rerun: Rerun = "off",
    progress: Progress = True,
    final_ba: Annotated[
        bool | None,
        typer.Option(
            "--final-ba/--no-final-ba",
            help="Bundle adjust the whole recording at the end (on by default).",
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
            help="Save a map for `slam-graph localize` at the end (off by default).",
            show_default=False,
        ),
    ] = None,
    save_graph: Annotated[
        list[str] | None,
        typer.Option(
            "--save-graph",
            metavar="STAMP",
            help="Save the factor graph of the back end at this time, repeatable: seconds after "
            "the first frame, or a stamp in ns. Files for GTSAM and Graphviz.",
            show_default=False,
        ),
    ] = None,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    as_json: Json = False,
) -> None:
    """Estimate the trajectory of a recording and write the results.

    The newest results are also found under OUTPUT/<dataset>/latest.
    """
    from slam_graph.config import load_config

    options: dict[str, Any] = {
        "algorithm": algorithm,
        "cameras": cameras,
        "start_s": start,
        "duration_s": duration,
    }
    if final_ba is not None:
        options["final_ba"] = {"enabled": final_ba}
    if loop_closure is not None:
        options["loop_closure"] = {"enabled": loop_closure}
    if save_map is not None:
        options["map"] = {"enabled": save_map}
    settings = load_config(config, set_ or (), **options, seed=seed)
    with collected_log() as log:
        sequence = open_recording(
            data, format_, calibration, groundtruth, sources, settings.cameras
        )
        result, folder, files = execute(
            sequence,
            settings,
            output,
            rerun,
            progress,
            log,
            graph_times=[_time(text) for text in save_graph or ()],
        )
    report(result, folder, files, as_json)


def _time(text: str) -> int | float:
    """Seconds, or a stamp in ns, which a float could not hold."""
    try:
        return int(text) if text.isdecimal() else float(text)
    except ValueError as error:
        raise typer.BadParameter(
            f"'{text}' is neither seconds nor a stamp in ns", param_hint="--save-graph"
        ) from error


def report(result: RunResult, folder: Path, files: list[Path], as_json: bool) -> None:
    """Print the result, and exit with the code for the run's status."""
    if as_json:
        names = [str(path) for path in files]
        echo_json({**result.metrics, "folder": str(folder), "files": names})
    else:
        echo_summary(result, folder, files)
    if result.status == "interrupted":
        typer.echo(f"{result.message}; what was done so far is written", err=True)
        raise typer.Exit(INTERRUPTED)
    result.check()


def execute(
    sequence: Sequence,
    settings: RunConfig,
    output: Path,
    rerun: RerunMode,
    progress: bool,
    log: list[str],
    known_map: SlamMap | None = None,
    graph_times: SequenceOf[int | float] = (),
) -> tuple[RunResult, Path, list[Path]]:
    """Run, and write the result, whole or cut short."""
    from slam_graph.pipeline import run as run_pipeline
    from slam_graph.results import create_run_folder, link_latest, write_text

    folder = create_run_folder(output, sequence.info().name)
    try:
        viewer = _viewer(rerun, folder, sequence.info().name)
        with _progress(sequence, settings, progress) as bar:
            result = run_pipeline(
                sequence,
                settings,
                viewer=viewer,
                progress=bar,
                known_map=known_map,
                graph_times=graph_times,
            )
        files = result.save(folder)
        if rerun == "save":
            files.append(folder / "recording.rrd")
        files.append(folder / "run.log")
        write_text(files[-1], log)
        link_latest(folder)
    except BaseException:
        remove_if_empty(folder)
        raise
    return result, folder, files


def _viewer(mode: RerunMode, folder: Path, name: str) -> Any:
    """The viewer that was asked for, or None."""
    if mode == "off":
        return None
    from slam_graph.visualization import RerunViewer

    return RerunViewer(mode, folder / "recording.rrd" if mode == "save" else None, name)


def _progress(
    sequence: Sequence, settings: RunConfig, wanted: bool
) -> AbstractContextManager[ProgressBar | None]:
    """A progress bar over the part that is asked for, or None."""
    if not wanted:
        return nullcontext()
    info = sequence.info()
    start_ns = info.start_ns + round(settings.start_s * 1e9)
    end_ns = info.end_ns
    if settings.duration_s is not None:
        end_ns = min(end_ns, start_ns + round(settings.duration_s * 1e9))
    return ProgressBar(start_ns, end_ns)
