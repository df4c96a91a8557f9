# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph run`: a recorded sequence in, a trajectory and a table of results out."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as SequenceOf
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slam_graph.cli.console import (
    ProgressBar,
    collected_log,
    echo_json,
    echo_table,
    number,
)
from slam_graph.cli.error_tables import accuracy_rows, segment_rows
from slam_graph.cli.loading import loading
from slam_graph.cli.options import (
    INTERRUPTED,
    SUSPECT,
    Algorithm,
    Calibration,
    Cameras,
    ConfigFile,
    Data,
    Duration,
    Format,
    Groundtruth,
    Inject,
    Json,
    NoImu,
    Objects,
    Output,
    Overrides,
    Progress,
    Rerun,
    RerunAddress,
    RerunDetail,
    RerunImages,
    SaveGraph,
    Seed,
    Sources,
    Start,
    graph_times,
    open_recording,
    run_settings,
)
from slam_graph.cli.watching import Watching, keep_serving
from slam_graph.interrupts import Interrupts

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from slam_graph.config import RunConfig
    from slam_graph.datasets import Sequence
    from slam_graph.maps import SlamMap
    from slam_graph.results import RunResult


_Table = dict[str, Any]


def echo_summary(result: RunResult, folder: Path, files: list[Path]) -> None:
    """Print the results of a run, and where its files are."""
    metrics = result.metrics
    echo_table(_overview(metrics))
    if metrics["accuracy"]:
        typer.echo("")
        echo_table(accuracy_rows(metrics["accuracy"]))
    if metrics["final_ba"] and metrics["final_ba"]["accuracy"]:
        typer.echo("")
        echo_table(accuracy_rows(metrics["final_ba"]["accuracy"], "smoothed"))
    if metrics["segments"]:
        typer.echo("")
        echo_table(segment_rows(metrics))
    loops = metrics["loop_closure"]
    if loops and loops["accepted"] and loops["accuracy"]:
        typer.echo("")
        echo_table(accuracy_rows(loops["accuracy"], "loops closed"))
    if metrics["localization"] and metrics["localization"]["accuracy"]:
        typer.echo("")
        echo_table(accuracy_rows(metrics["localization"]["accuracy"], "in the map"))
    if metrics["nees"] and "unavailable" not in metrics["nees"]:
        typer.echo("")
        echo_table(_consistency(metrics["nees"]))
    smoothed_nees = (metrics["final_ba"] or {}).get("nees")
    if smoothed_nees and "unavailable" not in smoothed_nees:
        typer.echo("")
        echo_table(_consistency(smoothed_nees, "NEES smoothed"))
    if metrics["nis"]:
        typer.echo("")
        echo_table(_innovations(metrics["nis"]))
    if metrics["calibration"]:
        typer.echo("")
        echo_table(_calibration(metrics["calibration"]))
    typer.echo("")
    typer.echo(f"{folder}/")
    typer.echo("  " + " ".join(path.name for path in files))


def _overview(metrics: _Table) -> Iterator[tuple[str, str]]:
    """Dataset, algorithm, extent, speed and sizes."""
    dataset, extent, timing = metrics["dataset"], metrics["extent"], metrics["timing"]
    cameras = f"{metrics['cameras']} camera{'s' if metrics['cameras'] > 1 else ''}"
    yield "dataset", f"{dataset['name']} ({dataset['format']}, {dataset['content']}, {cameras})"
    yield "algorithm", f"{metrics['algorithm']}, seed {metrics['seed']}"
    yield "status", metrics["status"]
    yield "read", f"{extent['frames']} frames of {extent['recorded_s']:.1f} s"
    if extent["initialization_s"] is not None:
        yield (
            "estimated",
            f"{extent['estimated_frames']} frames, {extent['coverage']:.1%} of the time, "
            f"from {extent['initialization_s']:.2f} s on",
        )
    if extent["scale"] == "unknown":
        yield "scale", "unknown: lengths are up to scale"
    if extent["world_breaks_ns"]:
        worlds = len(extent["world_breaks_ns"]) + 1
        yield "worlds", f"{worlds}, of which nothing joins one with another; errors are of each"
    if timing["frames_per_s"] is not None:
        yield (
            "speed",
            f"{timing['frames_per_s']:.0f} frames/s, {timing['real_time_factor']:.1f} x real time",
        )
    stages = {name: s for name, s in timing["stages"].items() if "." not in name}
    if stages:
        yield "ms a frame", ", ".join(f"{name} {s['mean_ms']:.2f}" for name, s in stages.items())
    if metrics["final_ba"]:
        yield "final BA", _final_ba(metrics["final_ba"])
        if metrics["final_ba"]["calibration_faults"]:
            yield "calibration", "; ".join(metrics["final_ba"]["calibration_faults"])
    if metrics["loop_closure"]:
        table = metrics["loop_closure"]
        found = f"{table['accepted']} accepted of {table['verified']} verified"
        yield "loop closures", f"{found}, {table['keyframes']} keyframes"
    if metrics["slam_map"]:
        table = metrics["slam_map"]
        yield "map", f"{table['keyframes']} keyframes, {table['features']} features"
    if metrics["localization"]:
        yield "located", _located(metrics["localization"])
    if metrics["moving_objects"]:
        yield from _objects(metrics["moving_objects"])
    if metrics["warnings"]:
        yield "warnings", ", ".join(f"{kind} {n}" for kind, n in metrics["warnings"].items())


def _objects(table: _Table) -> Iterator[tuple[str, str]]:
    """How many objects move, and how well that is known."""
    if "directions" in table:
        directions = [
            f"{number} ({row['frames']} frames, {row['mean_rate_rad_s']:.2f} rad/s)"
            for number, row in table["directions"].items()
        ]
        found = f"{', '.join(directions) or 'nothing'}; {table['ms_per_frame']:.1f} ms a frame"
        yield "moving", f"{found}; one camera: directions only, the scale is not known"
        return
    each = [
        f"{number} ({row['moving_frames']} of {row['frames']} frames, "
        f"{row['mean_speed_m_s']:.2f} m/s)"
        for number, row in table["objects"].items()
    ]
    yield "moving", f"{', '.join(each) or 'nothing'}; {table['ms_per_frame']:.1f} ms a frame"
    errors = table["accuracy"]
    if errors and errors["steps"]:
        yield (
            "their motion",
            f"median error {errors['median_motion_rotation_deg']:.2f}°, "
            f"{errors['median_motion_translation_m']:.4f} m a frame, NEES {errors['nees']:.2f} "
            "where 1 is ideal",
        )
    smoothed = table["smoothed"]
    if smoothed and smoothed["steps"]:
        yield (
            "smoothed",
            f"median error of their motion {smoothed['median_motion_rotation_deg']:.2f}°, "
            f"{smoothed['median_motion_translation_m']:.4f} m a frame",
        )


def _final_ba(table: _Table) -> str:
    """Size of the final bundle adjustment, and its cost before and after."""
    return (
        f"{table['frames']} frames, {table['keyframes']} keyframes, {table['features']} features, "
        f"{table['iterations']} steps in {table['seconds']:.1f} s, "
        f"cost {table['cost_before']:.3g} to {table['cost_after']:.3g}"
    )


def _located(table: _Table) -> str:
    """How much of the run was located in a map."""
    if table["first_s"] is None:
        return f"never, in {table['queries']} comparisons with the map"
    return (
        f"{table['located']} frames, {table['located_share']:.1%} of all, from "
        f"{table['first_s']:.2f} s on; {table['accepted']} of {table['matches']} "
        f"matches accepted in {table['queries']} comparisons, "
        f"{table['ms_per_frame']:.1f} ms a frame"
    )


def _consistency(nees: _Table, title: str = "NEES") -> Iterator[tuple[str, ...]]:
    """Mean NEES beside its ideal."""
    if nees["left_out"]:
        title += f" (without {nees['left_out']} states whose place is not known)"
    yield title, "mean", "ideal", "inside 95% bounds"
    for name in ("orientation", "position", "pose"):
        row = nees[name]
        yield name, number(row["mean"], 2), str(row["ideal_mean"]), f"{row['inside_bounds']:.0%}"


def _innovations(nis: _Table) -> Iterator[tuple[str, ...]]:
    """NIS over its degrees of freedom, beside the mean expected after the gate."""
    yield "NIS / dof", "mean", "expected", "inside 95% bounds", "rejected"
    shares = (f"{nis['inside_bounds']:.0%}", f"{nis['rejected']:.1%}")
    yield "images", number(nis["mean"], 2), number(nis["expected_mean"], 2), *shares


def _calibration(parameters: _Table) -> Iterator[tuple[str, ...]]:
    """Estimated parameters of the rig beside their initial values."""
    yield "calibration", "start", "estimate", "1 sigma"
    for name, row in parameters.items():
        values = (f"{row[column]:.6g}" for column in ("start", "value"))
        yield name, *values, f"{row['sigma']:.2g}"


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
    rerun_images: RerunImages = "all",
    rerun_detail: RerunDetail = "normal",
    rerun_address: RerunAddress = None,
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
    save_graph: SaveGraph = None,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    no_imu: NoImu = False,
    inject: Inject = None,
    objects: Objects = None,
    as_json: Json = False,
) -> None:
    """Estimate the trajectory of a recording and write the results.

    The newest results are also found under OUTPUT/<dataset>/latest.
    """
    settings = run_settings(
        config,
        set_,
        {"final_ba": final_ba, "loop_closure": loop_closure, "map": save_map, "objects": objects},
        algorithm=algorithm,
        cameras=cameras,
        start_s=start,
        duration_s=duration,
        seed=seed,
    )
    with collected_log() as log:
        sequence = open_recording(
            data, format_, calibration, groundtruth, sources, settings.cameras, inject, no_imu
        )
        result, folder, files = execute(
            sequence,
            settings,
            output,
            Watching(rerun, rerun_images, rerun_detail, rerun_address),
            progress,
            log,
            graph_times=graph_times(save_graph),
        )
    try:
        report(result, folder, files, as_json)
    finally:
        keep_serving(rerun)


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
    if result.status == "suspect":
        typer.echo(f"error: {result.message}", err=True)
        raise typer.Exit(SUSPECT)
    result.check()


def execute(
    sequence: Sequence,
    settings: RunConfig,
    output: Path,
    watching: Watching,
    progress: bool,
    log: list[str],
    known_map: SlamMap | None = None,
    graph_times: SequenceOf[int | float] = (),
) -> tuple[RunResult, Path, list[Path]]:
    """Run, and write the result, whole or cut short."""
    with loading():
        from slam_graph.pipeline import run as run_pipeline
        from slam_graph.results import ResultFolder

    with Interrupts.completed() as begin, ResultFolder.of_run(output, sequence.info().name) as made:
        recording = made.folder / "recording.rrd"
        with (
            watching.viewer(recording, sequence.info().name, known_map) as viewer,
            _progress(sequence, settings, progress) as bar,
        ):
            result = run_pipeline(
                sequence,
                settings,
                viewer=viewer,
                progress=bar,
                known_map=known_map,
                graph_times=graph_times,
                so_far=made.folder,
            )
        begin()
        made.files += result.save(made.folder)
        if recording.is_file():
            made.path(recording.name)
        made.text("run.log", log)
    return result, made.folder, made.files


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
