# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images: from files, paired with frames by time, and registered to their camera."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets.streams.images import Fault, FileImages
from slam_graph.datasets.streams.pairing import ABSENT
from slam_graph.errors import DataError
from slam_graph.image_files import ImageFile
from slam_graph.sensors import Camera, DepthSensor, Rig

DEPTH_TOLERANCE_S = 0.02
"""A depth image is that of a frame if it was taken at most this far apart. Kinect's colour and
depth cameras of 30 Hz are not synchronised; TUM RGB-D's own tool has the same tolerance."""

_NEAREST_M = 1e-3
"""Points nearer to a camera than this, or behind it, are not registered."""


Metres = NDArray[np.float32]
"""(height, width) depth along the optical axis in m; NaN where there is none."""

DepthProcess = Callable[[NDArray[Any]], NDArray[Any]]
"""Turns a raw depth image (height, width) into another one."""


_REACH = 0.7
"""A registered point fills the pixels up to this share of a depth pixel's width around it: half,
and some more, as points on a slanted surface are farther apart."""
_MOST_PIXELS = 2e8
"""Most pixels of the camera that an image of the depth sensor is spread over, one by one."""
_LARGEST_RATIO = 32.0
"""Largest ratio of the camera's focal length to the depth sensor's. Each depth fills that number
squared of pixels, in a loop."""
_LARGEST_CAMERA = 2**25
"""Most pixels of a camera that depth is registered to; its images may be missing, so that nothing
else tells that its calibrated size is wrong."""


class DepthStream(Protocol):
    """The depth images of a recording, registered to a camera of its rig.

    Attributes:
        name: of the sensor, for messages.
        stamps_ns: (N,) int64, strictly increasing.
    """

    name: str
    stamps_ns: IntArray

    def read(self, index: int) -> Metres | Fault:
        """One image, or what is wrong with it; may be called in another thread."""
        ...

    def missing(self, index: int) -> Fault | None:
        """What is wrong with one image as far as is known without reading it."""
        ...


class FileDepth:
    """Depth images that are each in a file of its own, a `DepthStream`.

    Args:
        files: their stamps and paths; PNG of 16 bits, or TIFF with floating-point metres.
        rig: has the depth sensor.
        process: applied to each decoded image, e.g. rectification.

    Attributes:
        name: of the sensor, for messages.
        stamps_ns: (N,) int64, strictly increasing.
    """

    def __init__(self, files: FileImages, rig: Rig, process: DepthProcess | None = None) -> None:
        self.name, self.stamps_ns = files.name, files.stamps_ns
        self._files = files
        self._finish = DepthFinish.of(rig)
        self._process = process

    def read(self, index: int) -> Metres | Fault:
        """One image in metres."""
        path = self._files.paths[index]
        fault = self._files.missing(index)
        if fault is not None:
            return Fault("depth_unreadable", fault.message)
        try:
            raw = decode_depth(path.read_bytes(), str(path))
        except OSError as error:
            return Fault("depth_unreadable", f"{path}: {error.strerror}")
        if isinstance(raw, Fault):
            return raw
        return self._finish(raw if self._process is None else self._process(raw), str(path))

    def missing(self, index: int) -> Fault | None:
        """Whether the file is there."""
        fault = self._files.missing(index)
        return None if fault is None else Fault("depth_unreadable", fault.message)


class DepthFinish:
    """Makes a raw depth image one in metres, registered to its camera.

    Args:
        sensor: scale and range; the lens and mounting of a depth camera of its own.
        camera: that the depth is of.
    """

    def __init__(self, sensor: DepthSensor, camera: Camera) -> None:
        self._sensor, self._camera = sensor, camera

    @staticmethod
    def of(rig: Rig) -> DepthFinish:
        """For the depth sensor of a rig, which has one."""
        assert rig.depth is not None
        return DepthFinish(rig.depth, rig.cameras[rig.depth.camera].camera)

    def __call__(self, raw: NDArray[Any], where: str) -> Metres | Fault:
        """The registered image, or what is wrong with it.

        Args:
            raw: (height, width) uint16 or float32.
            where: it comes from, for the fault.
        """
        lens = self._sensor.lens or self._camera
        if raw.shape != (lens.height, lens.width):
            got = f"{raw.shape[1]}x{raw.shape[0]}"
            what = f"{where}: {got}, the calibration says {lens.width}x{lens.height}"
            return Fault("depth_wrong_size", what)
        depth = self._sensor.metres(raw)
        return depth if self._sensor.lens is None else self._registration.register(depth)

    @cached_property
    def _registration(self) -> Registration:
        assert self._sensor.lens is not None
        return Registration(self._sensor.lens, self._camera, self._sensor.camera_T_depth)


class Registration:
    """Turns what a depth camera measures into the depth of what another camera sees.

    Each depth becomes a point, which is projected into the camera; of the points at a pixel the
    nearest one counts, as it hides the others. A point fills the pixels that its own pixel covers,
    so that there are no gaps where the camera's resolution is higher.

    Args:
        lens: intrinsics of the depth camera.
        camera: that the depth is registered to.
        camera_T_depth: pose of the depth camera in the frame of the camera.

    Raises:
        DataError: if the calibration would take memory or time out of proportion.
    """

    def __init__(self, lens: Camera, camera: Camera, camera_T_depth: gtsam.Pose3) -> None:
        if camera.width * camera.height > _LARGEST_CAMERA:
            raise DataError(
                f"calibration of the depth sensor: its camera has {camera.width}x{camera.height} "
                "pixels, too many to register depth to; correct the resolution"
            )
        u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        plane, visible = lens.visible(pixels)
        rays = np.column_stack([plane, np.ones(len(plane))])
        rays[~visible] = np.nan
        self._rays: FloatArray = rays @ camera_T_depth.rotation().matrix().T
        self._origin = np.asarray(camera_T_depth.translation())
        self._camera = camera
        ratio = max(camera.fx / lens.fx, camera.fy / lens.fy, 1.0)
        if ratio > _LARGEST_RATIO or ratio**2 * lens.width * lens.height > _MOST_PIXELS:
            raise DataError(
                f"calibration of the depth sensor: its focal length is {ratio:.0f} times shorter "
                "than that of its camera; correct its intrinsics"
            )
        self._reach = _REACH * ratio

    def register(self, depth: Metres) -> Metres:
        """The depth image of the camera, NaN where nothing is seen.

        Args:
            depth: (height, width) of the depth camera, in m along its axis.
        """
        height, width = self._camera.height, self._camera.width
        measured = np.flatnonzero(np.isfinite(depth.ravel()))
        points = self._rays[measured] * depth.ravel()[measured, None] + self._origin
        points = points[points[:, 2] > _NEAREST_M]
        plane = points[:, :2] / points[:, 2:]
        pixels = self._camera.distort(plane)[0]
        inside = np.all(np.isfinite(pixels), axis=1) & (
            np.linalg.norm(plane, axis=1) < self._camera.max_tangent
        )
        pixels, z = pixels[inside], points[inside, 2].astype(np.float32)
        nearest = np.full(height * width, np.inf, np.float32)
        first = np.ceil(pixels - self._reach).astype(np.int64)
        last = np.floor(pixels + self._reach).astype(np.int64)
        for du in range(int(np.ceil(2 * self._reach)) + 1):
            for dv in range(int(np.ceil(2 * self._reach)) + 1):
                u, v = first[:, 0] + du, first[:, 1] + dv
                there = (u <= last[:, 0]) & (v <= last[:, 1])
                there &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
                np.minimum.at(nearest, v[there] * width + u[there], z[there])
        nearest[~np.isfinite(nearest)] = np.nan
        return nearest.reshape(height, width)


def decode_depth(data: bytes, where: str) -> NDArray[Any] | Fault:
    """Decode a depth image of 16 bits or of floating-point metres.

    Args:
        data: bytes of the file.
        where: its place, for the message.

    Returns:
        (height, width) uint16 or float32, or a fault of kind `depth_unreadable`.
    """
    image = ImageFile.decode(data, cv2.IMREAD_UNCHANGED)
    if isinstance(image, str):
        return Fault("depth_unreadable", f"{where}: {image}")
    if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
        what = f"{where}: {image.dtype} {image.shape}; depth is one channel of uint16 or float32"
        return Fault("depth_unreadable", what)
    return image


def nearest_in_time(
    frames_ns: IntArray, stamps_ns: IntArray, tolerance_s: float = DEPTH_TOLERANCE_S
) -> IntArray:
    """For each of F frames the index (F,) of the depth image nearest in time, or `ABSENT`.

    A depth image is that of one frame only, as its errors would count twice otherwise.

    Args:
        frames_ns: (F,) stamps of the frames, increasing.
        stamps_ns: (N,) stamps of the depth images, increasing.
        tolerance_s: largest difference.
    """
    if len(stamps_ns) == 0:
        return np.full(len(frames_ns), ABSENT, np.int64)
    after = np.clip(np.searchsorted(stamps_ns, frames_ns), 1, max(len(stamps_ns) - 1, 1))
    around = np.stack([after - 1, np.minimum(after, len(stamps_ns) - 1)])
    apart = np.abs(stamps_ns[around] - frames_ns)
    best = np.argmin(apart, axis=0)
    columns = np.arange(len(frames_ns))
    distance, index = apart[best, columns], around[best, columns]
    order = np.lexsort((distance, index))
    first = np.ones(len(order), np.bool_)
    first[1:] = index[order][1:] != index[order][:-1]
    used = np.zeros(len(order), np.bool_)
    used[order[first]] = True
    used &= distance <= tolerance_s * 1e9
    return np.where(used, index, ABSENT).astype(np.int64)


def require_depth_size(stream: DepthStream, count: int) -> None:
    """Refuse a calibration for depth images of another size, by the first `count` of them.

    Raises:
        DataError: if they are all of another size.
    """
    first = [stream.read(k) for k in range(min(count, len(stream.stamps_ns)))]
    wrong = [image for image in first if isinstance(image, Fault) and image.kind.endswith("size")]
    if wrong and len(wrong) == len(first):
        raise DataError(f"{wrong[0].message}; give the calibration of these images")
