# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph localize`: a recording in the world of a map that was saved before."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from slam_graph.cli.logs import collected_log
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
    Seed,
    Sources,
    Start,
    open_recording,
)
from slam_graph.cli.run import execute, report


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
    from slam_graph.config import load_config
    from slam_graph.errors import EstimationError
    from slam_graph.results import find_map, load_map

    options: dict[str, Any] = {
        "algorithm": algorithm,
        "cameras": cameras,
        "start_s": start,
        "duration_s": duration,
    }
    if final_ba is not None or config is None:
        options["final_ba"] = {"enabled": bool(final_ba)}
    settings = load_config(config, set_ or (), **options, seed=seed)
    path = find_map(map_)
    known = load_map(path)
    with collected_log() as log:
        sequence = open_recording(
            data, format_, calibration, groundtruth, sources, settings.cameras
        )
        result, folder, files = execute(sequence, settings, output, rerun, progress, log, known)
    report(result, folder, files, as_json)
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
