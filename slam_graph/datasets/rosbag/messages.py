# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages as measurements: grey images of all common encodings, IMU samples, poses."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.datasets.streams.images import Fault, Image, decode_grey

IMU = "sensor_msgs/msg/Imu"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
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


def image_of(message: Any, where: str) -> Image | Fault:
    """The grey image in an `Image` or a `CompressedImage`, or what is wrong with it.

    Args:
        message: the message.
        where: it comes from, for the fault.
    """
    if not hasattr(message, "encoding"):
        return decode_grey(bytes(message.data), where)
    encoding = _ENCODINGS.get(message.encoding)
    if encoding is None:
        known = ", ".join(_ENCODINGS)
        what = f"{where}: unknown encoding '{message.encoding}'; known: {known}"
        return Fault("image_unreadable", what)
    row = message.width * encoding.channels * encoding.bits // 8
    data = np.asarray(message.data, np.uint8)
    if message.step < row or len(data) != message.step * message.height or len(data) == 0:
        size = f"{message.width}x{message.height} {message.encoding}, rows of {message.step} bytes"
        return Fault("image_unreadable", f"{where}: {len(data)} bytes do not make {size}")
    pixels = data.reshape(message.height, message.step)[:, :row]
    if encoding.bits == 16:
        upper = 0 if message.is_bigendian else 1
        return np.ascontiguousarray(pixels[:, upper::2])
    if encoding.to_grey is None:
        return np.ascontiguousarray(pixels)
    shape = (message.height, message.width, encoding.channels)
    coloured = np.ascontiguousarray(pixels).reshape(shape if encoding.channels > 1 else shape[:2])
    return np.asarray(cv2.cvtColor(coloured, encoding.to_grey), np.uint8)


def inertial_of(message: Any) -> list[float]:
    """Angular rate [rad/s] and specific force [m/s²] of an `Imu`: six numbers."""
    rate, force = message.angular_velocity, message.linear_acceleration
    return [rate.x, rate.y, rate.z, force.x, force.y, force.z]


def pose_sigmas_of(message: Any) -> FloatArray:
    """(6,) standard deviations of a pose, m along and rad about the axes of its frame.

    NaN where none was set: in messages of types without a covariance, and in three numbers (of the
    position, or of the orientation) one of which is not positive.
    """
    matrix = getattr(getattr(message, "pose", None), "covariance", None)
    if matrix is None:
        return np.full(6, np.nan)
    variances = np.asarray(matrix, np.float64).reshape(6, 6).diagonal().reshape(2, 3)
    known = (variances > 0.0).all(axis=1, keepdims=True)
    return np.sqrt(np.where(known, variances, np.nan)).ravel()


def pose_of(message: Any, msgtype: str) -> list[float]:
    """Position and quaternion (x, y, z, w) of a message of a type in `POSES`."""
    value = message
    for name in POSES[msgtype].split("."):
        value = getattr(value, name)
    is_transform = hasattr(value, "translation")
    position = value.translation if is_transform else value.position
    turn = value.rotation if is_transform else value.orientation
    return [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
