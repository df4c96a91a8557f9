# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Images without a format: their files, time stamps, IMU and calibration, each on its own.

Images without a format: the files with their time stamps, IMU and calibration. Times in these files
are nanoseconds if they are whole numbers, seconds if any has a decimal point.

A folder of images of one camera, or a folder for each of two, with a table of their times, and with
or without an IMU and depth images.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.formats.euroc import ordered_images
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.csv_rows import (
    STAMP_TEXT,
    Rows,
    nanoseconds,
    read_rows,
    stamp_from_seconds,
)
from slam_graph.datasets.streams.depth_images import FileDepth
from slam_graph.datasets.streams.image_sequence import ImageSequence
from slam_graph.datasets.streams.images import FileImages, file_within
from slam_graph.datasets.streams.imu_stream import INTEGER_STAMPS, ImuFile
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError, closest
from slam_graph.files import Files
from slam_graph.sensors import ImuData, Rig

_SHORTEST_PERIOD_NS = 100_000
"""Frames closer in time than this have stamps in another unit."""

SLOWEST_HZ, FASTEST_HZ = 0.01, 1000.0

SOURCES = ("stamps", "rate", "imu")


@dataclass(frozen=True, slots=True)
class LooseFiles:
    """The files that belong to some images.

    Attributes:
        stamps: table with a time for each image, or None.
        rate_hz: of the images, if that was given instead.
        imu: CSV with time, rate x y z [rad/s], specific force x y z [m/s²], or None.
        rig: its cameras; without an IMU the frame of the first one is the body frame.
    """

    stamps: Path | None
    rate_hz: float | None
    imu: ImuFile | None
    rig: Rig


def find_files(
    path: Path, beside: Mapping[str, Sequence[Path]], options: ReaderOptions, cameras: int = 1
) -> LooseFiles:
    """Find the files that belong to some images: as named, or where they usually are.

    Args:
        path: of the images.
        beside: where to look for ``stamps``, ``imu`` and ``calibration`` that are not named.
        options: `sources` names ``stamps`` and ``imu``, or gives ``rate`` in Hz.
        cameras: that there are images of.

    Raises:
        DataError: if there is no calibration, a source is unknown, or its file is not there.
    """
    named, calibration = options.sources, options.calibration
    unknown = [key for key in named if key not in SOURCES]
    if unknown:
        raise DataError(f"unknown source '{unknown[0]}'; {closest(unknown[0], SOURCES)}")
    found = {key: next(filter(Path.is_file, files), None) for key, files in beside.items()}
    files = {key: Path(named[key]) if key in named else found[key] for key in ("stamps", "imu")}
    for file in files.values():
        if file is not None and not file.is_file():
            raise DataError(f"{file}: no such file")
    chain = calibration if calibration is not None else found["calibration"]
    if chain is None:
        looked = ", ".join(file.name for file in beside["calibration"])
        raise DataError(f"{path}: no calibration ({looked}) beside the images; give --calibration")
    imu = files["imu"]
    rate_hz = _rate(named["rate"]) if "rate" in named else None
    if rate_hz is not None and "stamps" in named:
        raise DataError(f"{path}: stamps and rate are both given; one of them is enough")
    return LooseFiles(
        stamps=None if rate_hz is not None else files["stamps"],
        rate_hz=rate_hz,
        imu=None if imu is None else ImuFile(imu, _parse_timed_imu),
        rig=options.select(_calibrated(chain, imu is not None and options.imu, cameras, options)),
    )


def _calibrated(chain: Path, needs_imu: bool, cameras: int, options: ReaderOptions) -> Rig:
    rig = read_kalibr(chain, needs_imu=needs_imu, diagnostics=options.diagnostics)
    if len(rig.cameras) < cameras:
        raise DataError(
            f"{chain}: calibrates {len(rig.cameras)} cameras, there are images of {cameras}"
        )
    return rig.select(cameras)


def is_usable_rate(rate_hz: float) -> bool:
    """Whether a camera can have this rate."""
    return SLOWEST_HZ <= rate_hz <= FASTEST_HZ


def regular_stamps(count: int, rate_hz: float) -> IntArray:
    """Stamps (N,) in ns of images at a constant rate, the first one at 0."""
    stamps: IntArray = np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return stamps


def read_stamps(path: Path) -> tuple[IntArray, list[str]]:
    """Times of a table, one a row, in its first column.

    Returns:
        stamps_ns: (N,) in the order of the file.
        names: the second column of each row; empty where there is none.

    Raises:
        DataError: if there are none, one cannot be read, or they are of another unit.
    """
    blocks = list(read_rows(path))
    cells = [[_cells(line) for line in rows.lines] for rows in blocks]
    if not blocks:
        raise DataError(f"{path}: no time stamps in this file")
    seconds = any(_in_seconds(row[0]) for block in cells for row in block)
    stamps = np.array(
        [
            _stamp(row[0], rows, k, seconds)
            for rows, block in zip(blocks, cells, strict=True)
            for k, row in enumerate(block)
        ],
        np.int64,
    )
    _require_unit(stamps, path)
    return stamps, [row[1] if len(row) > 1 else "" for block in cells for row in block]


def _require_unit(stamps_ns: IntArray, path: Path) -> None:
    """Refuse stamps that are too close to be in nanoseconds."""
    if len(stamps_ns) < 2:
        return
    period = float(np.median(np.abs(np.diff(stamps_ns))))
    if period < _SHORTEST_PERIOD_NS:
        raise DataError(
            f"{path}: stamps are {period:.0f} ns apart; whole numbers are nanoseconds, "
            "seconds need a decimal point"
        )


def stamps_from_names(paths: Sequence[Path]) -> IntArray | None:
    """Stamps (N,) of files whose names are their times; None if one is not."""
    stamps = []
    for path in paths:
        try:
            seconds = _in_seconds(path.stem)
            stamps.append(nanoseconds(path.stem) if seconds else int(path.stem))
        except (ValueError, ArithmeticError):
            return None
    if any(abs(stamp) >= Files.LARGEST_STAMP_NS for stamp in stamps):
        return None
    together = np.array(stamps, np.int64)
    if len(together) > 1 and float(np.median(np.abs(np.diff(together)))) < _SHORTEST_PERIOD_NS:
        return None
    return together


def _parse_timed_imu(rows: Rows) -> ImuData:
    """Samples of rows: time, gyro xyz in rad/s, accel xyz in m/s²."""
    what = "time, gyro xyz, accel xyz"
    if not any(_in_seconds(_cells(line)[0]) for line in rows.lines):
        table = rows.parse(INTEGER_STAMPS, what)
        return ImuData(table["stamp"], table["gyro"], table["accel"])
    table = rows.parse([("stamp", STAMP_TEXT), *INTEGER_STAMPS[1:]], what)
    stamps = [stamp_from_seconds(text, rows, k) for k, text in enumerate(table["stamp"])]
    return ImuData(np.array(stamps, np.int64), table["gyro"], table["accel"])


def _cells(line: str) -> list[str]:
    """The cells of a row, which is separated by commas or else by white space."""
    cells = line.split(",") if "," in line else line.split()
    return [cell.strip() for cell in cells]


def _in_seconds(text: str) -> bool:
    return any(mark in text for mark in ".eE")


def _stamp(text: str, rows: Rows, index: int, seconds: bool) -> int:
    if seconds:
        return stamp_from_seconds(text, rows, index)
    try:
        stamp_ns = int(text)
    except ValueError:
        stamp_ns = Files.LARGEST_STAMP_NS
    if abs(stamp_ns) >= Files.LARGEST_STAMP_NS:
        raise DataError(f"{rows.where(index)}: '{text[:80]}' is not a time") from None
    return stamp_ns


def _rate(text: str) -> float:
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = float("nan")
    if not is_usable_rate(rate_hz):
        raise DataError(f"rate={text} is not a number of images a second")
    return rate_hz


SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}

FOLDERS = ("", "images", "data", "rgb", "color")
"""Where the images may be, within the folder of a recording."""

PAIRS = (("left", "right"), ("image_left", "image_right"), ("image_0", "image_1"), ("cam0", "cam1"))
"""Where those of two cameras may be."""

DEPTH_FOLDER = "depth"

STAMPS = ("timestamps.csv", "timestamps.txt", "times.csv", "times.txt", "data.csv")


def is_image_folder(path: Path) -> bool:
    """Whether this is a folder with images."""
    return path.is_dir() and bool(_find_images(path))


def _find_images(path: Path) -> list[Path]:
    """The folders that the images of each camera are in; none if there are no images."""
    for pair in PAIRS:
        if all(_has_images(path / name) for name in pair):
            return [path / name for name in pair]
    return [path / name for name in FOLDERS if _has_images(path / name)][:1]


def _has_images(folder: Path) -> bool:
    return folder.is_dir() and any(file.suffix.lower() in SUFFIXES for file in folder.iterdir())


class ImageFolderSequence(ImageSequence):
    """Images of one camera in a folder, or of two in a folder each, and depth images if there are.

    Their times are in a table (see `loose_files`), whose second column may name the files. Without
    names the times belong to the images in the order of the numbers in their names. Without a table
    the names of the images must be their times, or a rate must be given. Images of the second
    camera, and of depth, have the times of those of the first with the same name, without its
    ending, so that some may be missing; with other names they are as many, in the same order.

    Depth images are in ``depth``, and the calibration has a key ``depth0``.

    Args:
        path: the folder; the images are in it or in its ``images``, ``data``, ``rgb`` or ``color``,
            those of two cameras in ``left`` and ``right`` or another of `PAIRS`.
        options: what else is asked for. Without `calibration` it is ``calibration.yaml`` in the
            folder; `sources` may name files ``stamps`` and ``imu``, or give a ``rate`` in Hz.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "images"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path.resolve()
        folders = _find_images(path)
        if not folders:
            raise DataError(f"{path}: no images ({', '.join(sorted(SUFFIXES))}) in this folder")
        beside = {
            "stamps": [path / name for name in STAMPS],
            "imu": [path / "imu.csv"],
            "calibration": [path / "calibration.yaml"],
        }
        files = find_files(path, beside, options, len(folders))
        used = folders[: len(files.rig.cameras)]
        streams = [_list_images(folder, files, options.diagnostics, used[0]) for folder in used]
        depth = None
        if _has_images(path / DEPTH_FOLDER):
            depth = _depth(path / DEPTH_FOLDER, files, options.diagnostics, used[0])
        super().__init__(self.path.name, files.rig, streams, files.imu, options, depth=depth)


def _depth(
    folder: Path, files: LooseFiles, diagnostics: Diagnostics, first: Path
) -> FileDepth | None:
    """The depth images, if the calibration says what they mean."""
    if files.rig.depth is not None:
        return FileDepth(_list_images(folder, files, diagnostics, first), files.rig)
    what = f"{folder}: left out, as the calibration has no key 'depth0'"
    diagnostics.warn("depth_left_out", what)
    return None


def _list_images(
    folder: Path, files: LooseFiles, diagnostics: Diagnostics, first: Path
) -> FileImages:
    """The images in a folder, with their times or those of the images in the `first` one."""
    if folder == first or (files.rate_hz is None and files.stamps is None):
        stamps, paths, index = _times(folder, files)
    else:
        stamps, paths, index = _times_of_first(folder, files, diagnostics, first)
    return ordered_images(folder.name, stamps, paths, index, diagnostics)


def _images_in(folder: Path) -> list[Path]:
    """The images in a folder, in the order of the numbers in their names."""
    images = (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
    return sorted(images, key=_by_number)


def _times(folder: Path, files: LooseFiles) -> tuple[IntArray, list[Path], Path]:
    """Times (N,), the image of each, and where the times are from."""
    there = _images_in(folder)
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


def _times_of_first(
    folder: Path, files: LooseFiles, diagnostics: Diagnostics, first: Path
) -> tuple[IntArray, list[Path], Path]:
    """As `_times`, of images that have the names of those in the `first` folder, or are as many."""
    stamps, images, index = _times(first, files)
    there = _images_in(folder)
    named = {path.stem: path for path in there}
    rows = [k for k, image in enumerate(images) if image.stem in named]
    if rows:
        alone = len(named.keys() - {image.stem for image in [*images, *_images_in(first)]})
        if alone:
            what = f"{folder}: {alone} images left out, as {first} has none of their names"
            diagnostics.warn("camera_frame_missing", what)
        return stamps[rows], [named[images[k].stem] for k in rows], index
    if len(there) != len(images):
        raise DataError(
            f"{folder}: {len(there)} images, none with the name of one of the {len(images)} in "
            f"{first}; give them the names of those that they belong to"
        )
    return stamps, there, index


def _named(folder: Path, table: Path, name: str) -> Path:
    """The file that a table names: in the folder of images, or as seen from the table."""
    image = file_within(folder, name, str(table))
    return image if image.is_file() else table.parent / name


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key of names with numbers in them: 9 comes before 10."""
    return [(int(part or 0), text) for text, part in re.findall(r"(\D*)(\d*)", path.name)]
