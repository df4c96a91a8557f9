# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages as measurements: grey images of all common encodings, IMU samples, poses.

Functions that get a message object only take its fields, as numbers, texts and arrays (see
`Message.decode`); what is made of them comes after.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.datasets.streams.images import Fault, Image, decode_grey

IMU = "sensor_msgs/msg/Imu"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    TRANSFORM: "transform",
    "nav_msgs/msg/Odometry": "pose.pose",
}
"""The field with the pose in each type of message that has one."""


class _Encoding(NamedTuple):
    """How the pixels of an encoding are stored.

    Attributes:
        channels: numbers per pixel.
        bits: of each number.
        to_grey: OpenCV's conversion, None where there is nothing to convert.
    """

    channels: int
    bits: int
    to_grey: int | None


_ENCODINGS = {
    "mono8": _Encoding(1, 8, None),
    "8UC1": _Encoding(1, 8, None),
    "mono16": _Encoding(1, 16, None),
    "16UC1": _Encoding(1, 16, None),
    "rgb8": _Encoding(3, 8, cv2.COLOR_RGB2GRAY),
    "bgr8": _Encoding(3, 8, cv2.COLOR_BGR2GRAY),
    "8UC3": _Encoding(3, 8, cv2.COLOR_BGR2GRAY),
    "rgba8": _Encoding(4, 8, cv2.COLOR_RGBA2GRAY),
    "bgra8": _Encoding(4, 8, cv2.COLOR_BGRA2GRAY),
    "bayer_rggb8": _Encoding(1, 8, cv2.COLOR_BayerRGGB2GRAY),
    "bayer_bggr8": _Encoding(1, 8, cv2.COLOR_BayerBGGR2GRAY),
    "bayer_gbrg8": _Encoding(1, 8, cv2.COLOR_BayerGBRG2GRAY),
    "bayer_grbg8": _Encoding(1, 8, cv2.COLOR_BayerGRBG2GRAY),
    "yuv422": _Encoding(2, 8, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": _Encoding(2, 8, cv2.COLOR_YUV2GRAY_YUY2),
}
"""The encodings that can be read; of 16 bits the upper 8 are kept."""


class RawImage(NamedTuple):
    """The fields of an `Image`.

    Attributes:
        encoding: of its pixels.
        width, height: in pixels.
        step: bytes of a row, which may end with some that mean nothing.
        is_bigendian: the order of the bytes of a number.
        data: (step * height,) bytes, if the message is a good one.
    """

    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: bool
    data: NDArray[np.uint8]

    def rows(self, bits: int, where: str) -> NDArray[np.uint8] | Fault:
        """(height, N) bytes of the pixels in each row, or what is wrong with them.

        Args:
            bits: of a pixel.
            where: it comes from, for the fault.
        """
        row, data = self.width * bits // 8, self.data
        fits = self.step >= row and len(data) == self.step * self.height
        if self.width < 1 or self.height < 1 or not fits:
            size = f"{self.width}x{self.height} {self.encoding}, rows of {self.step} bytes"
            return Fault("image_unreadable", f"{where}: {len(data)} bytes do not make {size}")
        return data.reshape(self.height, self.step)[:, :row]


class PackedImage(NamedTuple):
    """The fields of a `CompressedImage`.

    Attributes:
        format: of the file, and of its pixels.
        data: the file.
    """

    format: str
    data: bytes


def image_fields(message: Any) -> RawImage | PackedImage:
    """The fields of an `Image` or a `CompressedImage`."""
    data = np.asarray(message.data, np.uint8).ravel()
    if not hasattr(message, "encoding"):
        return PackedImage(str(message.format), data.tobytes())
    return RawImage(
        str(message.encoding),
        int(message.width),
        int(message.height),
        int(message.step),
        bool(message.is_bigendian),
        data,
    )


def image_of(image: RawImage | PackedImage, where: str) -> Image | Fault:
    """The grey image, or what is wrong with it.

    Args:
        image: the fields of a message.
        where: it comes from, for the fault.
    """
    if isinstance(image, PackedImage):
        return decode_grey(image.data, where)
    encoding = _ENCODINGS.get(image.encoding)
    if encoding is None:
        known = ", ".join(_ENCODINGS)
        what = f"{where}: unknown encoding '{image.encoding}'; known: {known}"
        return Fault("image_unreadable", what)
    pixels = image.rows(encoding.channels * encoding.bits, where)
    if isinstance(pixels, Fault):
        return pixels
    if encoding.bits == 16:
        upper = 0 if image.is_bigendian else 1
        return np.ascontiguousarray(pixels[:, upper::2])
    if encoding.to_grey is None:
        return np.ascontiguousarray(pixels)
    shape = (image.height, image.width, encoding.channels)
    coloured = np.ascontiguousarray(pixels).reshape(shape if encoding.channels > 1 else shape[:2])
    return np.asarray(cv2.cvtColor(coloured, encoding.to_grey), np.uint8)


def inertial_of(message: Any) -> list[float]:
    """Angular rate [rad/s] and specific force [m/s²] of an `Imu`: six numbers."""
    rate, force = message.angular_velocity, message.linear_acceleration
    return [float(part) for part in (rate.x, rate.y, rate.z, force.x, force.y, force.z)]


def covariance_of(message: Any) -> FloatArray:
    """(6, 6) the covariance of a pose; NaN in messages of types without one."""
    matrix = getattr(getattr(message, "pose", None), "covariance", None)
    if matrix is None:
        return np.full((6, 6), np.nan)
    return np.asarray(matrix, np.float64).reshape(6, 6)


def sigmas_of(covariance: FloatArray) -> FloatArray:
    """(6,) standard deviations of a pose, m along and rad about the axes of its frame.

    NaN in three numbers (of the position, or of the orientation) one of which is not positive:
    those were not set.

    Args:
        covariance: (6, 6) of a message.
    """
    variances = covariance.diagonal().reshape(2, 3)
    known = (variances > 0.0).all(axis=1, keepdims=True)
    return np.sqrt(np.where(known, variances, np.nan)).ravel()


def pose_of(message: Any, msgtype: str) -> list[float]:
    """Position and quaternion (x, y, z, w) of a message of a type in `POSES`."""
    value = message
    for name in POSES[msgtype].split("."):
        value = getattr(value, name)
    is_transform = hasattr(value, "translation")
    place = value.translation if is_transform else value.position
    turn = value.rotation if is_transform else value.orientation
    return [float(x) for x in (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)]
