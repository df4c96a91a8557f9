# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC / ASL folders, and TUM-VI in the same layout: images, an IMU, often ground truth.

EuRoC / ASL folders: images of any number of cameras, an IMU, and often ground truth. Each sensor
has a folder in ``mav0``, with its calibration in ``sensor.yaml`` and an index or its samples in
``data.csv``.

TUM-VI as it is downloaded in EuRoC's layout: ``mav0``, and its calibration in ``dso``. Schubert et
al., "The TUM VI Benchmark for Evaluating Visual-Inertial Odometry", IROS 2018. Two fisheye cameras
of 512 or 1024 pixels at 20 Hz, an IMU at 200 Hz, and poses of the IMU from motion capture in
``mav0/mocap0`` (of the long sequences at their start and end only). The ``sensor.yaml`` files of
EuRoC are not there: the cameras are in ``dso/camchain.yaml``, the noise of the IMU in
``dso/imu_config.yaml``, both as Kalibr writes them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.datasets.calibration.calibration_yaml import read_yaml
from slam_graph.datasets.calibration.depth_calibration import read_depth_sensor
from slam_graph.datasets.calibration.euroc_calibration import read_euroc_rig, read_imu_noise
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.groundtruth import find_groundtruth
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.csv_rows import read_rows
from slam_graph.datasets.streams.depth_images import FileDepth
from slam_graph.datasets.streams.image_sequence import STEREO_TOLERANCE_S, ImageSequence
from slam_graph.datasets.streams.images import FileImages, file_within
from slam_graph.datasets.streams.imu_stream import ImuFile, parse_imu_rows
from slam_graph.datasets.streams.pairing import in_order
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.sensors import Rig


def _find_mav0(path: Path) -> Path:
    """The folder of sensors of a recording that is given by this folder or its parent."""
    for folder in (path / "mav0", path):
        if (folder / "imu0").is_dir() or (folder / "cam0").is_dir():
            return folder.resolve()
    if not path.is_dir():
        raise DataError(f"{path}: no such folder")
    folder = path / "mav0" if (path / "mav0").is_dir() else path
    raise DataError(
        f"{folder}: no folder 'imu0' or 'cam0' here; an EuRoC recording has mav0/imu0, mav0/cam0"
    )


def _imu_file(mav0: Path) -> ImuFile | None:
    """The samples of the IMU; None where there is no IMU."""
    folder = mav0 / "imu0"
    return ImuFile(folder / "data.csv", parse_imu_rows) if folder.is_dir() else None


def _name_of(mav0: Path) -> str:
    """Name of the recording: that of the folder around ``mav0``."""
    return mav0.parent.name if mav0.name == "mav0" else mav0.name


def _read_rig(mav0: Path, options: ReaderOptions) -> tuple[Rig, list[Path]]:
    """The calibration of the cameras that are used, and the folder of each."""
    count, chain = options.cameras, options.calibration
    found = [(int(m[1]), p) for p in mav0.iterdir() if (m := re.fullmatch(r"cam(\d+)", p.name))]
    folders = [folder for _, folder in sorted(found)]
    if not folders:
        raise DataError(f"{mav0}: no camera folder (cam0, cam1, …) here")
    if chain is None:
        if count is not None and 1 <= count <= len(folders):
            folders = folders[:count]
        rig = read_euroc_rig(mav0, [folder.name for folder in folders])
    else:
        beside = (mav0 / "imu0" / "sensor.yaml", mav0.parent / "dso" / "imu_config.yaml")
        imu = next((file for file in beside if file.is_file()), None)
        noise = read_imu_noise(read_yaml(imu)) if imu is not None else None
        needs_imu = options.imu and (mav0 / "imu0").is_dir()
        rig = read_kalibr(chain, None, noise, needs_imu, options.diagnostics)
        if len(rig.cameras) > len(folders):
            raise DataError(
                f"{chain}: calibrates {len(rig.cameras)} cameras, {mav0} has {len(folders)}; "
                f"choose fewer cameras"
            )
    rig = options.select(rig)
    return rig, folders[: len(rig.cameras)]


def _find_depth(mav0: Path, rig: Rig, diagnostics: Diagnostics) -> tuple[Rig, FileDepth | None]:
    """The rig with its depth sensor, and the depth images; EuRoC's recordings have none.

    They are in a folder ``depth0`` like that of a camera. What measures them is in the Kalibr chain
    that was given, or in ``sensor.yaml`` there.
    """
    folder = mav0 / DEPTH_FOLDER
    if not folder.is_dir():
        return rig, None
    if rig.depth is None:
        sensor = read_depth_sensor(read_yaml(folder / "sensor.yaml"), MOST_CAMERAS)
        if sensor.camera >= len(rig.cameras):
            return rig, None
        rig = replace(rig, depth=sensor)
    return rig, FileDepth(_list_images(folder, diagnostics), rig)


def _list_images(folder: Path, diagnostics: Diagnostics) -> FileImages:
    """The images of a camera; none if its folder holds no images at all."""
    index = folder / "data.csv"
    if not index.is_file():
        if (folder / "data").exists():
            raise DataError(f"{index}: missing, but there are images beside it")
        return FileImages(folder.name, np.zeros(0, np.int64), [])
    listed = [
        _parse_image_row(line, partial(rows.where, k), folder / "data")
        for rows in read_rows(index)
        for k, line in enumerate(rows.lines)
    ]
    if not listed:
        raise DataError(f"{index}: no images listed in this file")
    stamps = np.array([stamp for stamp, _ in listed], np.int64)
    paths = [path for _, path in listed]
    return ordered_images(folder.name, stamps, paths, index, diagnostics)


def ordered_images(
    name: str,
    stamps_ns: IntArray,
    paths: Sequence[Path],
    index: Path,
    diagnostics: Diagnostics,
) -> FileImages:
    """The images of a camera whose stamps increase; the others are counted.

    Args:
        name: of the camera.
        stamps_ns: (N,) in any order.
        paths: N files.
        index: file that lists them, for messages.
        diagnostics: counts `camera_out_of_order`.
    """

    def dropped(k: int, _: int) -> None:
        what = f"{index}: {paths[k].name} at {stamps_ns[k]} dropped, not in the order of time"
        diagnostics.warn("camera_out_of_order", what)

    kept = in_order(stamps_ns, dropped)
    return FileImages(name, stamps_ns[kept], [paths[k] for k in kept])


def _parse_image_row(line: str, where: Callable[[], str], folder: Path) -> tuple[int, Path]:
    """Stamp and file of an image in a folder."""
    stamp, _, name = line.partition(",")
    try:
        parsed = int(stamp)
    except ValueError:
        parsed = -1
    if not 0 <= parsed < Files.LARGEST_STAMP_NS or not name.strip():
        raise DataError(f"{where()}: cannot read '{line.strip()[:100]}' as stamp [ns], file name")
    return parsed, file_within(folder, name.strip(), where())


DEPTH_FOLDER = "depth0"
"""Depth images of 16 bits; not EuRoC's, laid out like a camera."""

MOST_CAMERAS = 64
"""More than any rig has."""


class EurocSequence(ImageSequence):
    """A recording in the ASL layout: a folder for each sensor, in one folder ``mav0``.

    A folder whose cameras are calibrated but hold no images opens with 0 frames, for its IMU and
    ground truth; one without ``imu0`` for its images.

    Args:
        path: ``mav0`` or the folder that holds it.
        options: what else is asked for.
        stereo_tolerance_s: largest time difference of images that are one frame.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "euroc"

    def __init__(
        self,
        path: Path,
        options: ReaderOptions | None = None,
        stereo_tolerance_s: float = STEREO_TOLERANCE_S,
    ) -> None:
        options = options or ReaderOptions()
        self.path = _find_mav0(path)
        rig, folders = _read_rig(self.path, options)
        rig, depth = _find_depth(self.path, rig, options.diagnostics)
        super().__init__(
            _name_of(self.path),
            rig,
            [_list_images(folder, options.diagnostics) for folder in folders],
            _imu_file(self.path),
            options,
            find_groundtruth(self.path),
            stereo_tolerance_s,
            depth,
        )


CHAIN = Path("dso") / "camchain.yaml"


def _find_root(path: Path) -> Path | None:
    """The folder with ``mav0`` and ``dso`` that a path stands for, or None."""
    for folder in (path, path.resolve().parent):
        if (folder / CHAIN).is_file() and (folder / "mav0").is_dir():
            return folder
    return None


def is_tum_vi(path: Path) -> bool:
    """Whether this is the folder of a TUM-VI sequence, or its ``mav0``."""
    return path.is_dir() and _find_root(path) is not None


class TumViSequence(EurocSequence):
    """A sequence of TUM-VI, 512 or 1024 pixels wide.

    Its images have 16 bits, of which the upper 8 are kept.

    Args:
        path: the folder with ``mav0`` and ``dso``, or ``mav0``.
        options: what else is asked for.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "tum_vi"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        root = _find_root(path) or path
        super().__init__(root, replace(options, calibration=options.calibration or root / CHAIN))
