# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Saves and loads maps, and exports them for other programs."""

from __future__ import annotations

from pathlib import Path

from slam_graph.errors import DataError
from slam_graph.geometry import tum_lines
from slam_graph.maps import SlamMap, read_map, write_map
from slam_graph.results.point_map import write_ply
from slam_graph.results.result_files import LATEST, appearing, refuse_to_replace, write_text

MAP_NAME = "map.slam"
"""Name of the map in the folder of a run."""


def save_map(content: SlamMap, path: Path | str, force: bool = False) -> None:
    """Write a map file. If writing fails, a file that was there before stays as it was.

    Args:
        content: the map.
        path: of the file.
        force: whether an existing file may be replaced.

    Raises:
        DataError: if the file exists, or cannot be written (a full disk, no permission).
    """
    path = Path(path)
    refuse_to_replace(path, force)
    try:
        with appearing(path) as partial:
            write_map(partial, content)
    except OSError as error:
        raise DataError(f"{path}: map cannot be written ({error.strerror or error})") from error


def load_map(path: Path | str) -> SlamMap:
    """Read a map.

    Args:
        path: of a map file, of the folder of a run that saved one, or of a folder of runs, of which
            the latest is taken.

    Raises:
        DataError: if there is none, or it cannot be used.
    """
    return read_map(find_map(path))


def find_map(path: Path | str) -> Path:
    """The map file that a path means (see `load_map`)."""
    path = Path(path)
    if not path.is_dir():
        if not path.exists():
            raise DataError(
                f"{path}: no such file; name a map, or the folder of a run that saved one"
            )
        return path
    for found in (path / MAP_NAME, path / LATEST / MAP_NAME):
        if found.is_file():
            return found
    raise DataError(
        f"{path}: no {MAP_NAME} in this folder; make one by `slam-graph run --save-map`"
    )


def export_ply(content: SlamMap, path: Path | str, force: bool = False) -> None:
    """Write the points of a map, and its keyframes in red, as a PLY point cloud.

    Raises:
        DataError: if the file exists or cannot be written.
    """
    path = Path(path)
    refuse_to_replace(path, force)
    try:
        write_ply(path, content.points, content.poses.translations)
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error})") from error


def export_tum(content: SlamMap, path: Path | str, force: bool = False) -> list[Path]:
    """Write the keyframes of a map as TUM trajectories, one for each recording.

    Returns:
        The files: `path`, or several with the number of the recording before the suffix.

    Raises:
        DataError: if a file exists or cannot be written.
    """
    path = Path(path)
    count = len(content.recordings)
    paths = [path.with_stem(f"{path.stem}_{n}") if count > 1 else path for n in range(count)]
    for file in paths:
        refuse_to_replace(file, force)
    for file, trajectory in zip(paths, content.trajectories(), strict=True):
        try:
            write_text(file, tum_lines(trajectory))
        except OSError as error:
            raise DataError(f"{file}: cannot be written ({error.strerror or error})") from error
    return paths
