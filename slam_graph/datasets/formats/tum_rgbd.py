# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""TUM RGB-D: colour and depth images of a Kinect with motion capture, without an IMU.

Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012. ``rgb.txt`` lists
time [s] and file of the images, ``groundtruth.txt`` the poses of the colour camera's optical frame.
``depth.txt`` lists the depth images, of 16 bits with 5000 units to a metre, which the driver of the
sensor has registered to the colour images as they are, with their distortion. They are read if they
are there. ``accelerometer.txt`` is not, as it is of no use without a gyroscope.

The images, those of depth too, are undistorted with the published calibration as they are read,
because it has five coefficients of Brown's distortion (k1, k2, p1, p2, k3), one more than `Camera`
knows. `rectifier` does the same for KITTI's unsynchronised images.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.formats.euroc import ordered_images
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.csv_rows import read_rows, stamp_from_seconds
from slam_graph.datasets.streams.depth_images import DepthProcess, FileDepth
from slam_graph.datasets.streams.image_sequence import ImageSequence
from slam_graph.datasets.streams.images import FileImages, Image, file_within
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.sensors import Camera, DepthSensor, Rig, RigCamera

Size = tuple[int, int]


def rectifier(
    K: FloatArray,
    coefficients: FloatArray,
    rectified_R_camera: FloatArray,
    rectified_K: FloatArray,
    size: Size,
    rectified_size: Size,
) -> Callable[[Image], Image]:
    """A function that turns images of a distorted camera into rectified ones.

    Images of another size than `size` are returned as they are, to be refused for their size.

    Args:
        K: (3, 3) of the camera as it is.
        coefficients: (5,) k1, k2, p1, p2, k3.
        rectified_R_camera: (3, 3) rotation into the rectified frame.
        rectified_K: (3, 3) of the rectified camera.
        size: width and height of the images as they are.
        rectified_size: width and height of the rectified images.
    """
    maps = cv2.initUndistortRectifyMap(
        K, coefficients, rectified_R_camera, rectified_K, rectified_size, cv2.CV_16SC2
    )
    return partial(_remap, maps[0], maps[1], size)


def _remap(whole: NDArray[Any], fraction: NDArray[Any], size: Size, image: Image) -> Image:
    if image.shape[::-1] != size:
        return image
    return np.asarray(cv2.remap(image, whole, fraction, cv2.INTER_LINEAR), np.uint8)


SIZE = (640, 480)

CAMERAS = {
    "1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": (535.4, 539.2, 320.1, 247.6, (0.0, 0.0, 0.0, 0.0, 0.0)),
}
"""fx, fy, cx, cy and k1, k2, p1, p2, k3 of the colour cameras, as the benchmark publishes them for
freiburg1 to freiburg3; the images of the third come undistorted."""


READOUT_S = 0.027
"""Time from the first row to the last of Kinect's colour camera, a rolling shutter. With 26 to
30 ms tracks fit the true motion of freiburg1_rpy best. The third sequences have another sensor,
whose time is not known."""

UNITS_PER_METRE = 5000.0
"""Of the depth images."""


def is_tum_rgbd(path: Path) -> bool:
    """Whether this is the folder of a sequence."""
    return (path / "rgb.txt").is_file() and (path / "rgb").is_dir()


class TumRgbdSequence(ImageSequence):
    """A sequence of TUM RGB-D, its colour images in grey, with depth; the body is the camera.

    Args:
        path: the folder with ``rgb.txt``.
        options: what else is asked for; `calibration` is needed where the name of the folder does
            not contain freiburg1, freiburg2 or freiburg3.

    Raises:
        DataError: if a part of the recording is missing or cannot be read.
    """

    format: ClassVar[str] = "tum_rgbd"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path.resolve()
        images = _list_images(path, "rgb", options.diagnostics)
        if options.calibration is not None:
            rig, process = read_kalibr(options.calibration, needs_imu=False).select(1), None
        else:
            rig, process = _known_rig(self.path, images)
        rig, depth = replace(rig, depth=rig.depth or DepthSensor.kinect(UNITS_PER_METRE)), None
        if (path / "depth.txt").is_file():
            depth = FileDepth(_list_images(path, "depth", options.diagnostics), rig, process)
        truth = path / "groundtruth.txt"
        super().__init__(
            self.path.name,
            options.select(rig),
            [images],
            None,
            options,
            truth if truth.is_file() else None,
            depth=depth,
        )


def _known_rig(path: Path, images: FileImages) -> tuple[Rig, DepthProcess | None]:
    """The published calibration; the images are undistorted with it as they are read.

    Returns:
        The rig, and what undistorts depth images; None where they are not distorted.
    """
    found = re.search(r"freiburg([123])|fr([123])(?!\d)", path.name)
    if found is None:
        raise DataError(
            f"{path}: the name does not say which camera it is (freiburg1, freiburg2, freiburg3); "
            "give --calibration"
        )
    number = found[1] or found[2]
    fx, fy, cx, cy, coefficients = CAMERAS[number]
    camera = Camera(fx, fy, cx, cy, "none", (), *SIZE)
    depth: DepthProcess | None = None
    if any(coefficients):
        K, D = camera.K, np.array(coefficients)
        images.process = rectifier(K, D, np.eye(3), K, SIZE, SIZE)
        u, v = cv2.initUndistortRectifyMap(K, D, np.eye(3), K, SIZE, cv2.CV_32FC1)
        depth = partial(_nearest, u, v)
    mounted = RigCamera(camera, gtsam.Pose3(), 0.0, images.name)
    if number != "3":
        mounted = replace(mounted, rolling_shutter=True, readout_s=READOUT_S, stamped_row="middle")
    return Rig((mounted,)), depth


def _nearest(u: NDArray[Any], v: NDArray[Any], depth: NDArray[Any]) -> NDArray[Any]:
    """The depth of the nearest pixel; between two surfaces there is none to interpolate."""
    return depth if depth.shape != u.shape else cv2.remap(depth, u, v, cv2.INTER_NEAREST)


def _list_images(path: Path, kind: str, diagnostics: Diagnostics) -> FileImages:
    table = path / f"{kind}.txt"
    stamps: list[int] = []
    files: list[Path] = []
    for rows in read_rows(table):
        for k, line in enumerate(rows.lines):
            stamp, _, name = line.strip().partition(" ")
            if not name:
                raise DataError(f"{rows.where(k)}: expected time [s] and file name")
            stamps.append(stamp_from_seconds(stamp, rows, k))
            files.append(file_within(path, name.strip(), rows.where(k)))
    if not stamps:
        raise DataError(f"{table}: no images listed in this file")
    return ordered_images(kind, np.array(stamps, np.int64), files, table, diagnostics)
