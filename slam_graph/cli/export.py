# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph export`: a result in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from slam_graph.cli.options import (
    Calibration,
    Format,
    Sources,
    open_recording,
    recording_options,
    refuse_ignored,
)

if TYPE_CHECKING:
    from slam_graph.geometry import Trajectory
    from slam_graph.results import SavedRun

Which = Literal["best", "causal", "smoothed", "loop"]


def export(
    result: Annotated[
        Path,
        typer.Argument(metavar="RESULT", help="Folder of a run, or of the runs of a recording."),
    ],
    tum: Annotated[
        Path | None, typer.Option("--tum", metavar="FILE", help="Trajectory in TUM's format.")
    ] = None,
    kitti: Annotated[
        Path | None,
        typer.Option("--kitti", metavar="FILE", help="Poses in KITTI's format, without times."),
    ] = None,
    euroc: Annotated[
        Path | None,
        typer.Option("--euroc", metavar="FILE", help="States as EuRoC's CSV of ground truth."),
    ] = None,
    which: Annotated[
        Which,
        typer.Option(
            "--which",
            help="Poses to write. best: of a trajectory smoothed if there is one, else causal; of "
            "images those of the map, else loop, smoothed, causal, the first that there is.",
        ),
    ] = "best",
    colmap: Annotated[
        Path | None,
        typer.Option(
            "--colmap", metavar="FOLDER", help="Images, and a model in COLMAP's text format."
        ),
    ] = None,
    nerfstudio: Annotated[
        Path | None,
        typer.Option(
            "--nerfstudio", metavar="FOLDER", help="Images, transforms.json and points.ply."
        ),
    ] = None,
    recording: Annotated[
        str | None,
        typer.Option(
            "--recording", metavar="DATA", help="The recording that was run, for its images."
        ),
    ] = None,
    spacing: Annotated[
        float, typer.Option("--spacing", min=0.0, help="Metres between keyframes with images.")
    ] = 0.1,
    force: Annotated[
        bool, typer.Option("--force", help="Let --tum, --kitti and --euroc replace files.")
    ] = False,
    format_: Format = None,
    calibration: Calibration = None,
    sources: Sources = None,
) -> None:
    """Write a result for other programs: trajectories, or keyframes with images and points.

    After a run with --save-map the keyframes and points of its map are exported too, with the
    observations of the points.
    """
    from slam_graph.errors import ConfigError
    from slam_graph.results import ResultFolder, load_result

    scenes = {name: path for name, path in (("colmap", colmap), ("nerfstudio", nerfstudio)) if path}
    files = {
        name: path for name, path in (("tum", tum), ("kitti", kitti), ("euroc", euroc)) if path
    }
    if not scenes and not files:
        raise ConfigError(
            "nothing to write: give one or more of --tum, --kitti, --euroc, --colmap, --nerfstudio"
        )
    if scenes and recording is None:
        raise ConfigError("images are in the recording that was run: name it by --recording DATA")
    if recording is None:
        given = recording_options(format_, calibration, None, sources)
        refuse_ignored(given, "is for the recording of the run: name it by --recording DATA")
    _refuse_equal(files)
    for path in files.values():
        ResultFolder.refuse_to_replace(path, force)
    saved = load_result(result)
    for name, path in files.items():
        typer.echo(str(_chosen(saved, which).save(path, name)))  # type: ignore[arg-type]
    if recording is None:
        return
    if scenes:
        typer.echo(f"poses of the images: {saved.exported_poses(which)[0]}", err=True)
    sequence = open_recording(recording, format_, calibration, None, sources)
    for folder in dict.fromkeys(scenes.values()):
        wanted = [name for name, path in scenes.items() if path == folder]
        for file in saved.export(folder, sequence, wanted, spacing, which):
            typer.echo(str(file))


def _refuse_equal(files: dict[str, Path]) -> None:
    """Refuse one file for two formats: the second would replace the first.

    Raises:
        ConfigError: naming the two options.
    """
    from slam_graph.errors import ConfigError

    taken: dict[Path, str] = {}
    for name, path in files.items():
        other = taken.setdefault(path.resolve(), name)
        if other != name and not (path.exists() and not path.is_file()):  # to devices both go
            raise ConfigError(f"--{other} and --{name} name the same file, {path}; give two names")


def _chosen(saved: SavedRun, which: Which) -> Trajectory:
    """A trajectory of a result.

    Raises:
        DataError: if the run has none of this kind.
    """
    from slam_graph.errors import DataError

    names = {"best": "best_trajectory", "causal": "trajectory", "loop": "loop_closed"}
    found: Trajectory | None = getattr(saved, names.get(which, which))
    if found is None:
        raise DataError(f"{saved.folder}: the run has no trajectory of the kind '{which}'")
    return found
