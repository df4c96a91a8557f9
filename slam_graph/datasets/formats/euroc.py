# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC / ASL folders: images of any number of cameras, an IMU, and often ground truth.

The files of an ASL folder (``mav0``): which sensors are there, their calibration and indices.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.groundtruth import find_groundtruth
from slam_graph.datasets.streams.csv_rows import read_rows
from slam_graph.datasets.streams.image_sequence import STEREO_TOLERANCE_S, FileImageSequence
from slam_graph.datasets.streams.images import FileImages
from slam_graph.datasets.streams.imu_stream import ImuFile, parse_imu_rows
from slam_graph.datasets.streams.pairing import in_order
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.sensors.calibration_yaml import read_yaml
from slam_graph.sensors.euroc_calibration import read_euroc_rig, read_imu_noise
from slam_graph.sensors.kalibr_calibration import read_kalibr
from slam_graph.sensors.rig import Rig


def find_mav0(path: Path) -> Path:
    """The folder of sensors that a path stands for."""
    for folder in (path / "mav0", path):
        if (folder / "imu0").is_dir() or (folder / "cam0").is_dir():
            return folder.resolve()
    if not path.is_dir():
        raise DataError(f"{path}: no such folder")
    folder = path / "mav0" if (path / "mav0").is_dir() else path
    raise DataError(
        f"{folder}: no folder 'imu0' or 'cam0' here; an EuRoC recording has mav0/imu0, mav0/cam0"
    )


def imu_file(mav0: Path) -> ImuFile | None:
    """The samples of the IMU; None where there is no IMU."""
    folder = mav0 / "imu0"
    return ImuFile(folder / "data.csv", parse_imu_rows) if folder.is_dir() else None


def name_of(mav0: Path) -> str:
    """Name of the recording: that of the folder around ``mav0``."""
    return mav0.parent.name if mav0.name == "mav0" else mav0.name


def read_rig(mav0: Path, count: int | None, calibration: Path | None) -> tuple[Rig, list[Path]]:
    """The calibration, and the folder of each of its cameras.

    Args:
        mav0: folder of sensors.
        count: number of cameras to use, the first ones; None for all.
        calibration: Kalibr camera chain to use instead of the ``sensor.yaml`` files.
    """
    found = [(int(m[1]), p) for p in mav0.iterdir() if (m := re.fullmatch(r"cam(\d+)", p.name))]
    folders = [folder for _, folder in sorted(found)]
    if not folders:
        raise DataError(f"{mav0}: no camera folder (cam0, cam1, …) here")
    if calibration is None:
        if count is not None and 1 <= count <= len(folders):
            folders = folders[:count]
        rig = read_euroc_rig(mav0, [folder.name for folder in folders])
    else:
        beside = (mav0 / "imu0" / "sensor.yaml", mav0.parent / "dso" / "imu_config.yaml")
        imu = next((file for file in beside if file.is_file()), None)
        noise = read_imu_noise(read_yaml(imu)) if imu is not None else None
        rig = read_kalibr(calibration, fallback=noise, needs_imu=imu_file(mav0) is not None)
        if len(rig.cameras) > len(folders):
            raise DataError(
                f"{calibration}: calibrates {len(rig.cameras)} cameras, {mav0} has {len(folders)}; "
                f"choose fewer cameras"
            )
    rig = rig if count is None else rig.select(count)
    return rig, folders[: len(rig.cameras)]


def list_images(folder: Path, diagnostics: Diagnostics) -> FileImages:
    """The images of a camera; none if its folder holds no images at all."""
    index = folder / "data.csv"
    if not index.is_file():
        if (folder / "data").exists():
            raise DataError(f"{index}: missing, but there are images beside it")
        return FileImages(folder.name, np.zeros(0, np.int64), [])
    listed = [
        _parse_image_row(line, partial(rows.where, k))
        for rows in read_rows(index)
        for k, line in enumerate(rows.lines)
    ]
    if not listed:
        raise DataError(f"{index}: no images listed in this file")
    stamps = np.array([stamp for stamp, _ in listed], np.int64)
    paths = [folder / "data" / name for _, name in listed]
    return ordered_images(folder.name, stamps, paths, index, diagnostics)


def ordered_images(
    name: str,
    stamps_ns: NDArray[np.int64],
    paths: Sequence[Path],
    index: Path,
    diagnostics: Diagnostics,
) -> FileImages:
    """The images of a camera without those that break the order of time.

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


def _parse_image_row(line: str, where: Callable[[], str]) -> tuple[int, str]:
    stamp, _, name = line.partition(",")
    try:
        parsed = int(stamp)
    except ValueError:
        parsed = -1
    if parsed < 0 or not name.strip():
        raise DataError(f"{where()}: cannot read '{line.strip()[:100]}' as stamp [ns], file name")
    return parsed, name.strip()


class EurocSequence(FileImageSequence):
    """A recording in the ASL layout: a folder for each sensor, in one folder ``mav0``.

    A folder whose cameras are calibrated but hold no images opens with 0 frames, for its IMU and
    ground truth; one without ``imu0`` for its images.

    Args:
        path: ``mav0`` or the folder that holds it.
        cameras: use only the first so many.
        calibration: a Kalibr camera chain to use instead of the ``sensor.yaml`` files.
        groundtruth: file or folder to use instead of the recording's own ground truth.
        diagnostics: where faults are counted.
        stereo_tolerance_s: largest time difference of images that are one frame.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "euroc"

    def __init__(
        self,
        path: Path,
        cameras: int | None = None,
        calibration: Path | None = None,
        groundtruth: Path | None = None,
        diagnostics: Diagnostics | None = None,
        stereo_tolerance_s: float = STEREO_TOLERANCE_S,
    ) -> None:
        self.path = find_mav0(path)
        diagnostics = diagnostics if diagnostics is not None else Diagnostics()
        rig, folders = read_rig(self.path, cameras, calibration)
        super().__init__(
            name_of(self.path),
            rig,
            [list_images(folder, diagnostics) for folder in folders],
            imu_file(self.path),
            groundtruth or find_groundtruth(self.path),
            diagnostics,
            stereo_tolerance_s,
        )
