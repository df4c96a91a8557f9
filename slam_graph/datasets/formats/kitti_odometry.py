# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""KITTI's odometry benchmark: rectified grey stereo and poses, without an IMU.

Geiger et al., "Are we ready for autonomous driving?", CVPR 2012. ``sequences/NN`` holds
``times.txt`` (seconds), ``calib.txt`` (a 3x4 projection matrix ``P0``, ``P1`` of each grey camera)
and the images ``image_0``, ``image_1``; ``poses/NN.txt`` beside ``sequences`` the 3x4 poses of
camera 0 in its first frame, for sequences 00 to 10.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.datasets.calibration.calibration_yaml import ROTATION_TOLERANCE, rotation_defects
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.formats.kitti_files import (
    increasing,
    read_calibration,
    read_seconds,
    rectified_camera,
)
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.csv_rows import read_rows
from slam_graph.datasets.streams.image_sequence import ImageSequence
from slam_graph.datasets.streams.images import Fault, FileImages
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import Trajectory
from slam_graph.sensors import Rig, RigCamera

_WORLD_R_CAMERA0 = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Turns x right, y down, z forward into the x forward, y left, z up of a world frame."""


def is_kitti_odometry(path: Path) -> bool:
    """Whether this is the folder of a sequence."""
    needed = (path / "times.txt", path / "calib.txt")
    return all(file.is_file() for file in needed) and (path / "image_0").is_dir()


class KittiOdometrySequence(ImageSequence):
    """A sequence of KITTI's odometry benchmark; the body frame is that of camera 0.

    Args:
        path: ``sequences/NN``.
        options: what else is asked for.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "kitti_odometry"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path.resolve()
        self._times_ns = read_seconds(path / "times.txt")
        folders = [folder for k in range(2) if (folder := path / f"image_{k}").is_dir()]
        self._kept = increasing(
            self._times_ns, "camera_out_of_order", path / "times.txt", options.diagnostics
        )
        kept = self._kept.tolist()
        streams = [
            FileImages(f.name, self._times_ns[kept], [f / f"{k:06d}.png" for k in kept])
            for f in folders
        ]
        chain = options.calibration
        rig = _read_rig(path, streams) if chain is None else read_kalibr(chain, needs_imu=False)
        rig = options.select(rig)
        if len(rig.cameras) > len(streams):
            raise DataError(f"{chain}: {len(rig.cameras)} cameras, {path} has {len(streams)}")
        self._poses = self.path.parent.parent / "poses" / f"{self.path.name}.txt"
        truth = self._read_poses if self._poses.is_file() else None
        used = streams[: len(rig.cameras)]
        super().__init__(f"kitti_{self.path.name}", rig, used, None, options, truth)

    def _read_poses(self) -> Trajectory:
        matrices = _read_poses(self._poses)
        if len(matrices) != len(self._times_ns):
            raise DataError(
                f"{self._poses}: {len(matrices)} poses, {self.path} has {len(self._times_ns)} times"
            )
        good = _are_poses(matrices)
        for k in self._kept[~good[self._kept]]:
            what = f"{self._poses}: row {k + 1} is not a finite pose, dropped"
            self.diagnostics.warn("groundtruth_not_finite", what)
        kept = self._kept[good[self._kept]]
        if not len(kept):
            raise DataError(f"{self._poses}: no pose of this file can be used")
        rotations = _WORLD_R_CAMERA0 @ matrices[kept, :, :3]
        return Trajectory(
            self._times_ns[kept],
            matrices[kept, :, 3] @ _WORLD_R_CAMERA0.T,
            Rotation.from_matrix(rotations).as_quat(),
        )


def _read_poses(path: Path) -> FloatArray:
    """Poses (N, 3, 4) of a file with twelve numbers a row.

    Raises:
        DataError: if a row cannot be read; names file and line.
    """
    blocks = [
        rows.parse([("pose", "f8", (12,))], "12 numbers of a 3x4 pose", None, None)["pose"]
        for rows in read_rows(path)
    ]
    if not blocks:
        raise DataError(f"{path}: no poses in this file")
    return np.concatenate(blocks).reshape(-1, 3, 4)


def _are_poses(matrices: FloatArray) -> BoolArray:
    """Which matrices (N, 3, 4) are finite, with a rotation in their first three columns."""
    defects, dets = rotation_defects(matrices[:, :, :3])
    measurable = Files.are_measurable(matrices).all(axis=(1, 2))
    return np.asarray(measurable & (dets > 0.0) & (defects <= ROTATION_TOLERANCE), bool)


def _read_rig(path: Path, streams: list[FileImages]) -> Rig:
    """The rectified cameras; the size of the images is not in the calibration."""
    file = read_calibration(path / "calib.txt")
    mounted = []
    for k, stream in enumerate(streams):
        first = stream.read(0)
        if isinstance(first, Fault):
            raise DataError(first.message)
        height, width = first.shape
        projection = file.numbers(f"P{k}", 12).reshape(3, 4)
        camera, camera_T_camera0 = rectified_camera(
            projection, width, height, f"{file.path}: line 'P{k}:'"
        )
        mounted.append(RigCamera(camera, camera_T_camera0.inverse(), 0.0, stream.name))
    if not mounted[0].body_T_camera.equals(gtsam.Pose3(), 1e-6):
        raise DataError(f"{file.path}: P0 is expected to be the reference camera")
    return Rig(tuple(mounted))
