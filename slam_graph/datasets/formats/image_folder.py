# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A folder of images of one camera, with a table of their times, and with or without an IMU."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.formats.euroc import ordered_images
from slam_graph.datasets.formats.loose_files import (
    LooseFiles,
    find_files,
    read_stamps,
    regular_stamps,
    stamps_from_names,
)
from slam_graph.datasets.streams.image_sequence import FileImageSequence
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


class ImageFolderSequence(FileImageSequence):
    """Images of one camera in a folder.

    Their times are in a table (see `loose_files`), whose second column may name the files; without
    names they belong to the images in the order of their names. Without a table the names of the
    images must be their times, or a rate must be told.

    Args:
        path: the folder; the images are in it, or in its ``images`` or ``data``.
        cameras: 1 or None.
        calibration: a Kalibr camera chain; without it ``calibration.yaml`` in the folder.
        groundtruth: file or folder with the ground truth.
        diagnostics: where faults are counted.
        sources: ``stamps`` and ``imu`` files to use instead of those in the folder, or ``rate``.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "images"

    def __init__(
        self,
        path: Path,
        cameras: int | None = None,
        calibration: Path | None = None,
        groundtruth: Path | None = None,
        diagnostics: Diagnostics | None = None,
        sources: Mapping[str, str] | None = None,
    ) -> None:
        self.path = path.resolve()
        diagnostics = diagnostics if diagnostics is not None else Diagnostics()
        folder = _find_images(path)
        if folder is None:
            raise DataError(f"{path}: no images ({', '.join(sorted(SUFFIXES))}) in this folder")
        beside = {
            "stamps": [path / name for name in STAMPS],
            "imu": [path / "imu.csv"],
            "calibration": [path / "calibration.yaml"],
        }
        files = find_files(path, sources or {}, beside, calibration)
        images = _list_images(folder, files, diagnostics)
        rig = files.rig if cameras is None else files.rig.select(cameras)
        super().__init__(self.path.name, rig, [images], files.imu, groundtruth, diagnostics)


def _list_images(folder: Path, files: LooseFiles, diagnostics: Diagnostics) -> FileImages:
    there = sorted(
        (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES), key=_by_number
    )
    stamps, paths, index = _times(folder, there, files)
    return ordered_images(folder.name, stamps, paths, index, diagnostics)


def _times(
    folder: Path, there: list[Path], files: LooseFiles
) -> tuple[NDArray[np.int64], list[Path], Path]:
    """Times (N,), the image of each, and the file that says so."""
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
    """Sorts names with numbers in them by the numbers: 9 before 10."""
    return [(int(part or 0), text) for text, part in re.findall(r"(\D*)(\d*)", path.name)]
