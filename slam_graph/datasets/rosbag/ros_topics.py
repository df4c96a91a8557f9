# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag: which are used, and the calibration that they carry.

Calibration that a bag carries: intrinsics in `CameraInfo`, mounting in the static transforms.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import numpy as np
import yaml

from slam_graph.arrays import FloatArray
from slam_graph.datasets.calibration.calibration_yaml import (
    YamlValue,
    pose_from_matrix,
    read_yaml,
)
from slam_graph.datasets.calibration.euroc_calibration import check_size, lens
from slam_graph.datasets.rosbag.bag import REINDEX, Bag, Message
from slam_graph.datasets.rosbag.messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    POSES,
    TRANSFORM,
    TRANSFORMS,
    pose_of,
)
from slam_graph.errors import DataError
from slam_graph.sensors import CAMERA_MODELS, Camera, ImuNoise, Rig, RigCamera


@dataclass(frozen=True, slots=True)
class Topics:
    """The topics of the sensors.

    Attributes:
        imu: topic of the IMU, None where there is none.
        cameras: topic of each camera.
        groundtruth: topic of poses, None where none was named.
        depth: topic of depth, None where none was named.
    """

    imu: str | None
    cameras: tuple[str, ...]
    groundtruth: str | None
    depth: str | None = None


def find_topics(bag: Bag, named: Mapping[str, str], calibration: Path | None) -> Topics:
    """Find the sensors in a bag.

    Args:
        bag: the bag.
        named: topics by ``imu``, ``cam0``, ``cam1``, …, ``depth`` and ``groundtruth``.
        calibration: a Kalibr camera chain, whose keys ``rostopic`` are used where nothing is named.

    Raises:
        DataError: if a topic is missing or of another type, or several could be meant.
    """
    unknown = [key for key in named if not re.fullmatch(r"imu|groundtruth|depth|cam\d+", key)]
    if unknown:
        raise DataError(
            f"unknown sensor '{unknown[0]}'; known: imu, cam0, cam1, …, depth, groundtruth"
        )
    recorded = _recorded_topics(calibration) if calibration is not None else {}
    known = {key: topic for key, topic in recorded.items() if topic in bag.topics} | dict(named)
    truth = known.get("groundtruth")
    if truth is not None:
        _require(bag, truth, tuple(POSES))
    return Topics(_find_imu(bag, known), _find_cameras(bag, known), truth, known.get("depth"))


def _recorded_topics(calibration: Path) -> dict[str, str]:
    """The keys ``rostopic`` of a Kalibr file, by sensor."""
    topics = {}
    for name, value in read_yaml(calibration).items():
        if re.fullmatch(r"imu0|depth0|cam\d+", name) and isinstance(value.node, yaml.MappingNode):
            topic: YamlValue | None = value.get("rostopic")
            if topic is not None:
                topics[name[:-1] if name in ("imu0", "depth0") else name] = topic.text()
    return topics


def _find_imu(bag: Bag, known: Mapping[str, str]) -> str | None:
    if "imu" in known:
        return _require(bag, known["imu"], (IMU,))
    found = bag.of_type(IMU)
    if len(found) > 1:
        raise DataError(
            f"{bag.path}: {len(found)} IMU topics ({', '.join(found)}); choose with --topic imu=…"
        )
    return found[0] if found else None


def _find_cameras(bag: Bag, known: Mapping[str, str]) -> tuple[str, ...]:
    numbers = sorted(int(key[3:]) for key in known if key.startswith("cam"))
    if numbers:
        if numbers != list(range(len(numbers))):
            raise DataError(f"{bag.path}: cameras must be named cam0, cam1, … without gaps")
        return tuple(_require(bag, known[f"cam{k}"], (IMAGE, COMPRESSED_IMAGE)) for k in numbers)
    raw = bag.of_type(IMAGE)
    compressed = [
        topic
        for topic in bag.of_type(COMPRESSED_IMAGE)
        if topic.rpartition("/")[0] not in raw and not topic.endswith("compressedDepth")
    ]
    found = sorted(topic for topic in raw + compressed if "depth" not in topic)
    if not found:
        raise DataError(f"{bag.path}: no images in this bag; it has {bag.listed()}")
    return tuple(found)


def _require(bag: Bag, topic: str, types: tuple[str, ...]) -> str:
    if topic not in bag.topics:
        raise DataError(f"{bag.path}: no topic '{topic}' in this bag; it has {bag.listed()}")
    if bag.topics[topic] not in types:
        raise DataError(
            f"{bag.path}: '{topic}' is of type {bag.topics[topic]}; expected {' or '.join(types)}"
        )
    return topic


_STATIC_TOPIC = "/tf_static"


def read_bag_rig(bag: Bag, topics: Topics, noise: ImuNoise) -> Rig:
    """The rig of a bag, from the `CameraInfo` beside each image topic and ``/tf_static``.

    Without an IMU the body frame is that of the first camera.

    Raises:
        DataError: if a part is missing; it names ``--calibration`` as the way out.
    """
    first = topics.imu or topics.cameras[0]
    body = frame_of(bag, first)
    transforms = _static_transforms(bag)
    mounted = []
    for k, topic in enumerate(topics.cameras):
        info = _info_beside(bag, topic)
        camera = _camera(bag, topic, info)
        body_T_camera = _path(bag, transforms, body, info.frame)
        body_T_image = body_T_camera.compose(camera_T_image(bag, topic))
        mounted.append(RigCamera(camera, body_T_image, 0.0, f"cam{k}"))
    return Rig(tuple(mounted), noise)


def frame_of(bag: Bag, topic: str) -> str:
    """The frame of the messages on a topic."""
    return _first(bag, topic).decode(_frame_of)


def _frame_of(message: Any) -> str:
    return _plain(str(message.header.frame_id))


def own_camera(bag: Bag, topic: str) -> Camera:
    """The intrinsics in the `CameraInfo` beside a topic of images.

    Raises:
        DataError: if there is none, or it cannot be used.
    """
    return _camera(bag, topic, _info_beside(bag, topic))


_OTHERWISE = "give --calibration"


def path_between(bag: Bag, begin: str, end: str, otherwise: str = _OTHERWISE) -> gtsam.Pose3:
    """begin_T_end of two frames, along ``/tf_static``.

    Args:
        bag: the bag.
        begin: a frame.
        end: another one.
        otherwise: what to do if they are not connected, for the error.

    Raises:
        DataError: if it does not connect them.
    """
    return _path(bag, _static_transforms(bag), begin, end, otherwise)


def _first(bag: Bag, topic: str) -> Message:
    """The first message of a topic, which has one."""
    with closing(bag.messages([topic])) as messages:
        message = next(messages, None)
    if message is None:
        raise DataError(f"{bag.path}: no message on '{topic}' can be read; {REINDEX}")
    return message


def _beside(bag: Bag, topic: str) -> str:
    """The topic with the calibration of the camera that publishes images under a topic."""
    return f"{_base(bag, topic).rpartition('/')[0]}/camera_info"


def _base(bag: Bag, topic: str) -> str:
    """The topic of images without the name of their transport, such as `compressed`."""
    return topic if bag.topics[topic] == IMAGE else topic.rpartition("/")[0]


def _info_beside(bag: Bag, topic: str) -> _CameraInfo:
    """The `CameraInfo` beside a topic of images."""
    beside = _beside(bag, topic)
    if bag.topics.get(beside) != CAMERA_INFO:
        raise DataError(
            f"{bag.path}: no calibration: no topic '{beside}'; give --calibration; "
            f"the bag has {bag.listed()}"
        )
    return _first(bag, beside).decode(_camera_info_of)


class _CameraInfo(NamedTuple):
    """The fields of a `CameraInfo`.

    Attributes:
        frame: of the camera.
        size: width and height.
        K: (3, 3) intrinsics of the images as they are taken.
        D: coefficients of their distortion.
        P: (3, 4) projection into rectified images.
        R: (3, 3) turns the axes of the camera to those of rectified images.
        distortion_model: by the name that ROS has for it.
    """

    frame: str
    size: tuple[int, int]
    K: FloatArray
    D: FloatArray
    P: FloatArray
    R: FloatArray
    distortion_model: str


def _camera_info_of(message: Any) -> _CameraInfo:
    """The fields of a `CameraInfo`; ROS 1 writes its matrices in capitals."""
    K, D, P, R = (
        np.asarray(getattr(message, name if hasattr(message, name) else name.upper()), np.float64)
        for name in "kdpr"
    )
    return _CameraInfo(
        _frame_of(message),
        (int(message.width), int(message.height)),
        K.reshape(3, 3),
        D.ravel(),
        P.reshape(3, 4),
        R.reshape(3, 3),
        str(message.distortion_model),
    )


def _is_rectified(bag: Bag, topic: str) -> bool:
    """Whether the images on a topic are rectified, by its name."""
    return "rect" in _base(bag, topic).rpartition("/")[2]


def camera_T_image(bag: Bag, topic: str) -> gtsam.Pose3:
    """From the axes of the images on a topic, which rectification turns, to those of their camera.

    They are the same where `CameraInfo` is missing, or its R was never set.

    Raises:
        DataError: if R is not a rotation.
    """
    if not _is_rectified(bag, topic) or bag.topics.get(_beside(bag, topic)) != CAMERA_INFO:
        return gtsam.Pose3()
    R = _info_beside(bag, topic).R
    matrix = np.eye(4)
    matrix[:3, :3] = R if np.any(R) else np.eye(3)
    return pose_from_matrix(matrix, f"{bag.path}: R in CameraInfo of {topic}").inverse()


def _camera(bag: Bag, topic: str, info: _CameraInfo) -> Camera:
    """The intrinsics of the camera whose images are on a topic."""
    rectified = _is_rectified(bag, topic)
    matrix, D, size = info.P if rectified else info.K, info.D, info.size
    fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    intrinsics, where = (fx, fy, cx, cy), f"{bag.path}: CameraInfo of {topic}"
    check_size(size, where)
    if rectified or not np.any(D):
        return lens(CAMERA_MODELS["none"](), intrinsics, (), size, where)
    models = {name: model for _, model in CAMERA_MODELS.working() for name in model.ros_names}
    model = models.get(info.distortion_model)
    count = 0 if model is None else len(model.coefficient_names)
    if model is None or np.any(D[count:]):
        given = f"{info.distortion_model} with {len(D)} coefficients"
        known = ", ".join(f"{name} ({len(m.coefficient_names)})" for name, m in models.items())
        raise DataError(
            f"{bag.path}: the distortion of CameraInfo is {given}; known, with the number of "
            f"coefficients that may differ from zero: {known}; give --calibration"
        )
    return lens(model(), intrinsics, tuple(D[:count].tolist()), size, where)


def _static_transforms(bag: Bag) -> dict[str, dict[str, gtsam.Pose3]]:
    """parent_T_child by parent and child, and the inverse by child and parent."""
    known: dict[str, dict[str, gtsam.Pose3]] = {}
    if bag.topics.get(_STATIC_TOPIC) != TRANSFORMS:
        return known
    for message in bag.messages([_STATIC_TOPIC]):
        for parent, child, (*place, x, y, z, w) in message.decode(_transforms_of):
            pose = gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.array(place))
            known.setdefault(parent, {})[child] = pose
            known.setdefault(child, {})[parent] = pose.inverse()
    return known


def _transforms_of(message: Any) -> list[tuple[str, str, list[float]]]:
    """Parent, child, position and quaternion (x, y, z, w) of the transforms in a message."""
    return [
        (_frame_of(part), _plain(str(part.child_frame_id)), pose_of(part, TRANSFORM))
        for part in message.transforms
    ]


def _path(
    bag: Bag,
    transforms: dict[str, dict[str, gtsam.Pose3]],
    begin: str,
    end: str,
    otherwise: str = _OTHERWISE,
) -> gtsam.Pose3:
    """begin_T_end, along the static transforms."""
    begin, end = _plain(begin), _plain(end)
    reached = {begin: gtsam.Pose3()}
    queue = deque([begin])
    while queue:
        frame = queue.popleft()
        for other, pose in transforms.get(frame, {}).items():
            if other not in reached:
                reached[other] = reached[frame].compose(pose)
                queue.append(other)
    if end not in reached:
        raise DataError(
            f"{bag.path}: {_STATIC_TOPIC} does not connect the frame '{begin}' with '{end}'; "
            f"{otherwise}"
        )
    return reached[end]


def _plain(frame: str) -> str:
    return frame.lstrip("/")
