# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC / ASL folders: images of any number of cameras, an IMU, and often ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from slam_graph.datasets.asl import find_mav0, imu_file, list_images, name_of, read_rig
from slam_graph.datasets.groundtruth import find_groundtruth
from slam_graph.datasets.image_sequence import STEREO_TOLERANCE_S, FileImageSequence
from slam_graph.diagnostics import Diagnostics


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
