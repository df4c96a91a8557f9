# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A folder of images of one camera, with a table of their times, and with or without an IMU."""

from __future__ import annotations

import re
from pathlib import Path
from typing import ClassVar

from slam_graph.arrays import IntArray
from slam_graph.datasets.formats.euroc import ordered_images
from slam_graph.datasets.formats.loose_files import (
    LooseFiles,
    find_files,
    read_stamps,
    regular_stamps,
    stamps_from_names,
)
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.image_sequence import ImageSequence
from slam_graph.datasets.streams.images import FileImages
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}

FOLDERS = ("", "images", "data")
"""Where the images may be, within the folder of a recording."""

STAMPS = ("timestamps.csv", "timestamps.txt", "times.csv", "times.txt", "data.csv")


def is_image_folder(path: Path) -> bool:
    """Whether this is a folder with images."""
    return path.is_dir() and _find_images(path) is not None


def _find_images(path: Path) -> Path | None:
    """The folder that the images are in."""
    for folder in (path / name for name in FOLDERS):
        if folder.is_dir() and any(file.suffix.lower() in SUFFIXES for file in folder.iterdir()):
            return folder
    return None


class ImageFolderSequence(ImageSequence):
    """Images of one camera in a folder.

    Their times are in a table (see `loose_files`), whose second column may name the files. Without
    names the times belong to the images in the order of the numbers in their names. Without a table
    the names of the images must be their times, or a rate must be given.

    Args:
        path: the folder; the images are in it, or in its ``images`` or ``data``.
        options: what else is asked for. Without `calibration` it is ``calibration.yaml`` in the
            folder; `sources` may name files ``stamps`` and ``imu``, or give a ``rate`` in Hz.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "images"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path.resolve()
        folder = _find_images(path)
        if folder is None:
            raise DataError(f"{path}: no images ({', '.join(sorted(SUFFIXES))}) in this folder")
        beside = {
            "stamps": [path / name for name in STAMPS],
            "imu": [path / "imu.csv"],
            "calibration": [path / "calibration.yaml"],
        }
        files = find_files(path, beside, options)
        images = _list_images(folder, files, options.diagnostics)
        super().__init__(self.path.name, files.rig, [images], files.imu, options)


def _list_images(folder: Path, files: LooseFiles, diagnostics: Diagnostics) -> FileImages:
    there = sorted(
        (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES), key=_by_number
    )
    stamps, paths, index = _times(folder, there, files)
    return ordered_images(folder.name, stamps, paths, index, diagnostics)


def _times(folder: Path, there: list[Path], files: LooseFiles) -> tuple[IntArray, list[Path], Path]:
    """Times (N,), the image of each, and where the times are from."""
    if files.rate_hz is not None:
        return regular_stamps(len(there), files.rate_hz), there, folder
    if files.stamps is None:
        stamps = stamps_from_names(there)
        if stamps is None:
            raise DataError(
                f"{folder}: no times of these images ({STAMPS[0]}); give --source stamps=FILE or "
                "--source rate=HZ"
            )
        return stamps, there, folder
    stamps, names = read_stamps(files.stamps)
    if all(names):
        return stamps, [_named(folder, files.stamps, name) for name in names], files.stamps
    if len(stamps) != len(there):
        raise DataError(
            f"{files.stamps}: {len(stamps)} times without names, {len(there)} images in {folder}"
        )
    return stamps, there, files.stamps


def _named(folder: Path, table: Path, name: str) -> Path:
    """The file that a table names: in the folder of images, or as seen from the table."""
    image = folder / name
    return image if image.is_file() else table.parent / name


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key of names with numbers in them: 9 comes before 10."""
    return [(int(part or 0), text) for text, part in re.findall(r"(\D*)(\d*)", path.name)]
