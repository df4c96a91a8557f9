# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Depth in ROS bags: its topic, its calibration, and its messages.

Depth is an `Image` of encoding 16UC1 (mm) or 32FC1 (m), or a `CompressedImage` of one: a PNG, or
what ``compressed_depth_image_transport`` writes. Depth whose messages have the frame of a camera is
registered to it (``aligned_depth_to_color`` of RealSense, ``depth_registered`` of OpenNI). Other
depth is registered with its `CameraInfo` and ``/tf_static``.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.rosbag.bag import Bag
from slam_graph.datasets.rosbag.messages import COMPRESSED_IMAGE, IMAGE, PackedImage, RawImage
from slam_graph.datasets.rosbag.ros_topics import (
    Topics,
    camera_T_image,
    frame_of,
    own_camera,
    path_between,
)
from slam_graph.datasets.streams.depth_images import decode_depth
from slam_graph.datasets.streams.images import Fault
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.sensors import DepthSensor, Rig

_HEADER = struct.Struct("<iff")
"""Before a PNG of ``compressed_depth_image_transport``: format, and two numbers for floats."""


def find_depth(
    bag: Bag, topics: Topics, rig: Rig, diagnostics: Diagnostics
) -> tuple[str | None, Rig]:
    """The topic of depth, and the rig with the sensor that it comes from.

    Depth that was not named, and is of no use, is left out and counted (`depth_left_out`).

    Args:
        bag: the bag.
        topics: of the sensors; `depth` may name one.
        rig: of the cameras; it may have a depth sensor.
        diagnostics: where faults are counted.

    Raises:
        DataError: if the topic that was named is of another type, or is not calibrated.
    """
    named, found = topics.depth, _candidates(bag)
    if named is not None and named not in found:
        raise DataError(
            f"{bag.path}: no depth on '{named}'; depth is on {', '.join(found) or 'no topic'}; "
            f"the bag has {bag.listed()}"
        )
    if not found:
        return None, replace(rig, depth=None)
    try:
        frames = [frame_of(bag, topic) for topic in topics.cameras[: len(rig.cameras)]]
        of_cameras = [topic for topic in found if frame_of(bag, topic) in frames]
        usable = [named] if named is not None else of_cameras or found
        if len(usable) > 1:
            several = ", ".join(usable)
            raise DataError(
                f"{bag.path}: several topics of depth: {several}; choose --topic depth=…"
            )
        return usable[0], replace(rig, depth=rig.depth or _sensor(bag, usable[0], topics, frames))
    except DataError as error:
        if named is not None:
            raise
        diagnostics.warn("depth_left_out", str(error))
        return None, replace(rig, depth=None)


def _candidates(bag: Bag) -> list[str]:
    """Topics that look like depth; those of raw images first, without compressed copies of them."""
    raw = [topic for topic in bag.of_type(IMAGE) if "depth" in topic]
    copies = [topic for topic in bag.of_type(COMPRESSED_IMAGE) if "depth" in topic.lower()]
    bases = {topic.rpartition("/")[0] for topic in copies}
    kept = [t for t in copies if t.endswith("/compressedDepth") or f"{t}Depth" not in copies]
    return sorted(raw) + sorted(
        topic for topic in kept if topic.rpartition("/")[0] in bases - set(raw)
    )


def _sensor(bag: Bag, topic: str, topics: Topics, frames: list[str]) -> DepthSensor:
    """What measures the depth on a topic, by the frame of its messages."""
    frame = frame_of(bag, topic)
    if frame in frames:
        return DepthSensor(frames.index(frame))
    try:
        lens = own_camera(bag, topic)
        turned, turned_depth = camera_T_image(bag, topics.cameras[0]), camera_T_image(bag, topic)
        between = path_between(bag, frames[0], frame)
        camera_T_depth = turned.inverse().compose(between).compose(turned_depth)
        return DepthSensor(0, lens=lens, camera_T_depth=camera_T_depth)
    except DataError as error:
        raise DataError(f"{error}; it may have a key 'depth0' for the depth on '{topic}'") from None


def depth_of(image: RawImage | PackedImage, where: str) -> NDArray[Any] | Fault:
    """The raw depth image (height, width), uint16 or float32, or what is wrong.

    Args:
        image: the fields of a message.
        where: it comes from, for the fault.
    """
    if isinstance(image, PackedImage):
        return _decompressed(image.data, image.format, where)
    kinds = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
    kind = kinds.get(image.encoding)
    if kind is None:
        known = ", ".join(kinds)
        what = f"{where}: encoding '{image.encoding}' is not depth; known: {known}"
        return Fault("depth_unreadable", what)
    number = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    rows = image.rows(8 * number.itemsize, where)
    if isinstance(rows, Fault):
        return Fault("depth_unreadable", rows.message)
    return np.ascontiguousarray(rows).view(number).astype(kind)


def _decompressed(data: bytes, form: str, where: str) -> NDArray[Any] | Fault:
    """The image in a `CompressedImage`; floats are stored as quantised inverse depths."""
    if "compressedDepth" not in form:
        return decode_depth(data, where)
    if len(data) < _HEADER.size:
        return Fault("depth_unreadable", f"{where}: {len(data)} bytes, too few for a depth image")
    _, a, b = _HEADER.unpack_from(data)
    image = decode_depth(data[_HEADER.size :], where)
    if isinstance(image, Fault) or not form.startswith("32FC1"):
        return image
    with np.errstate(all="ignore"):  # a and b may be damaged
        metres = np.float32(a) / (image.astype(np.float32) - np.float32(b))
    return np.where(image == 0, np.float32(np.nan), metres)
