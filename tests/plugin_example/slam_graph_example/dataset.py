# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A reader of recordings: all arrays in one .npz file, of one camera without distortion."""

from pathlib import Path

import gtsam
import numpy as np

from slam_graph.datasets import Format, ReaderOptions, RecordedSequence, dataset_from_arrays
from slam_graph.sensors import Camera, Rig, RigCamera


def _open(path: Path, options: ReaderOptions) -> RecordedSequence:
    with np.load(path) as file:
        arrays = dict(file)
    height, width = arrays["images"].shape[1:]
    fx, fy, cx, cy = arrays["intrinsics"].tolist()
    camera = Camera(fx, fy, cx, cy, "none", (), width, height)
    rig = Rig((RigCamera(camera, gtsam.Pose3(arrays["body_T_camera"]), name="cam0"),))
    return dataset_from_arrays(
        options.select(rig),
        imu_stamps_ns=arrays["imu_stamps_ns"],
        gyro=arrays["gyro"],
        accel=arrays["accel"],
        image_stamps_ns=arrays["image_stamps_ns"],
        images=[arrays["images"]],
        name=path.stem,
        diagnostics=options.diagnostics,
    )


NPZ = Format(_open, lambda path: path.suffix == ".npz", "a .npz file with images and IMU")
