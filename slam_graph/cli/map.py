# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph map` shows, exports and merges maps; `slam-graph localize` runs in one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slam_graph.cli.console import collected_log, echo_json, echo_table
from slam_graph.cli.options import (
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
    RerunAddress,
    RerunDetail,
    RerunImages,
    Seed,
    Sources,
    Start,
    open_recording,
    run_settings,
)
from slam_graph.cli.run import execute, report
from slam_graph.cli.watching import Watching, keep_serving

if TYPE_CHECKING:
    from slam_graph.maps import MapRecording, SlamMap


def localize(
    data: Data,
    map_: Annotated[
        Path,
        typer.Option("--map", metavar="MAP", help="Map file, or the folder of a run with one."),
    ],
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
            help="Also bundle adjust the whole recording at the end (off unless --config sets it).",
            show_default=False,
        ),
    ] = None,
    format_: Format = None,
    calibration: Calibration = None,
    groundtruth: Groundtruth = None,
    sources: Sources = None,
    as_json: Json = False,
) -> None:
    """Estimate the trajectory of a recording in the world of a map.

    Runs like `slam-graph run`, and also writes the causal pose of every frame in the map to
    trajectory_map.tum, once the place is recognised. The exit code is 3 if it never is.
    """
    from slam_graph.errors import EstimationError
    from slam_graph.results import ResultFolder, load_map

    settings = run_settings(
        config,
        set_,
        {"final_ba": bool(final_ba) if config is None else final_ba},
        algorithm=algorithm,
        cameras=cameras,
        start_s=start,
        duration_s=duration,
        seed=seed,
    )
    path = ResultFolder.find_map(map_)
    known = load_map(path)
    with collected_log() as log:
        sequence = open_recording(
            data, format_, calibration, groundtruth, sources, settings.cameras
        )
        watching = Watching(rerun, rerun_images, rerun_detail, rerun_address)
        result, folder, files = execute(sequence, settings, output, watching, progress, log, known)
    try:
        report(result, folder, files, as_json)
    finally:
        keep_serving(rerun)
    if result.localization is None or result.localization.located.any():
        return
    if result.localization.counts["queries"] == 0:
        raise EstimationError(
            f"{result.input.info.name}: has neither images nor descriptors of tracks, so no place "
            "can be recognised; the trajectory in its own world is written"
        )
    raise EstimationError(
        f"{result.input.info.name}: no frame was recognised in {path}; is it the same place, seen "
        "from similar directions? The trajectory in its own world is written"
    )


app = typer.Typer(
    help="Show, export and merge maps.", no_args_is_help=True, rich_markup_mode="rich"
)

_MapPath = Annotated[
    Path, typer.Argument(metavar="MAP", help="Map file, or the folder of a run with one.")
]
_Force = Annotated[bool, typer.Option("--force", help="Replace files that exist.")]


@app.command()
def info(path: _MapPath, as_json: Json = False) -> None:
    """Show what a map holds."""
    from slam_graph.results import ResultFolder, load_map

    file = ResultFolder.find_map(path)
    table = _describe(load_map(file), file)
    if as_json:
        echo_json(table)
        return
    recordings = table.pop("recordings")
    table["extent_m"] = " x ".join(f"{length:.2f}" for length in table["extent_m"])
    table["path_m"] = f"{table['path_m']:.2f}"
    table["size_mb"] = f"{table['size_mb']:.2f}"
    echo_table((name, str(value)) for name, value in table.items())
    for recording in recordings:
        typer.echo("")
        cameras = recording.pop("cameras")
        echo_table((name, str(value)) for name, value in recording.items())
        for name, camera in cameras.items():
            echo_table([(name, ", ".join(f"{key} {value}" for key, value in camera.items()))])


@app.command()
def export(
    path: _MapPath,
    ply: Annotated[
        Path | None, typer.Option("--ply", help="Points, and keyframes in red, as a point cloud.")
    ] = None,
    tum: Annotated[
        Path | None,
        typer.Option("--tum", help="Poses of the keyframes; one file for each recording."),
    ] = None,
    force: _Force = False,
) -> None:
    """Write a map in formats of other programs."""
    from slam_graph.errors import ConfigError
    from slam_graph.results import export_map, load_map

    if ply is None and tum is None:
        raise ConfigError("nothing to write: give --ply FILE, --tum FILE, or both")
    for file in export_map(load_map(path), ply, tum, force):
        typer.echo(str(file))


@app.command()
def merge(
    first: Annotated[Path, typer.Argument(metavar="MAP", help="The result keeps its world.")],
    second: Annotated[Path, typer.Argument(metavar="OTHER", help="Map of the same place.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write.")],
    config: ConfigFile = None,
    set_: Overrides = None,
    force: _Force = False,
    as_json: Json = False,
) -> None:
    """Merge two maps of the same place; nothing is written if they do not overlap."""
    from dataclasses import asdict

    from slam_graph.config import load_config
    from slam_graph.maps import merge_maps
    from slam_graph.results import ResultFolder, load_map, save_map

    settings = load_config(config, set_ or ())
    ResultFolder.refuse_to_replace(output, force)
    merged = merge_maps(
        load_map(first), load_map(second), settings.loop_closure, settings.localization
    )
    save_map(merged.content, output, force)
    table = {**asdict(merged.summary), **merged.content.summary(), "file": str(output)}
    if as_json:
        echo_json(table)
        return
    summary = merged.summary
    rows = {
        "file": str(output),
        "map": f"{table['keyframes']} keyframes, {table['features']} features",
        "links": f"{summary.accepted} accepted of {summary.verified} verified between the maps",
        "fused": f"{summary.fused} features that both maps had",
        "fit": f"{summary.link_rmse_m:.3f} m, {summary.link_rmse_deg:.2f} deg rmse of the links",
        "moved": f"keyframes of the first map by {summary.first_moved_m:.3f} m on average",
    }
    echo_table(rows.items())


def _describe(content: SlamMap, file: Path) -> dict[str, Any]:
    """A map as a table."""
    import numpy as np

    table: dict[str, Any] = {"file": str(file), "size_mb": file.stat().st_size * 1e-6}
    table |= content.summary()
    counts = np.bincount(content.recording_of, minlength=len(content.recordings)).tolist()
    table["recordings"] = [
        _recording(recording, count)
        for recording, count in zip(content.recordings, counts, strict=True)
    ]
    return table


def _recording(recording: MapRecording, keyframes: int) -> dict[str, Any]:
    """A recording as a table."""
    return {
        "recording": recording.name,
        "keyframes": keyframes,
        "poses": recording.poses,
        "cameras": {
            mounted.name or f"cam{index}": {
                "width": mounted.camera.width,
                "height": mounted.camera.height,
                "fx": mounted.camera.fx,
                "fy": mounted.camera.fy,
                "distortion": mounted.camera.distortion,
            }
            for index, mounted in enumerate(recording.rig.cameras)
        },
    }
