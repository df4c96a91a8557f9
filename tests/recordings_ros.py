# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Small made-up ROS bags: ROS 1, and ROS 2 in SQLite and MCAP."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from recordings import FRAME_PERIOD_NS, IMU_PERIOD_NS, SIZE, START_NS
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.writer import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slam_graph.datasets.rosbag.messages import TRANSFORMS
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.measurements import CameraFrame
from slam_graph.sensors.rig import Rig

LAG_NS = 7_000_000
"""How much later than its stamp a message is recorded."""

KINDS = ("ros1", "sqlite", "mcap", "mcap_file")

INTRINSICS = (50.0, 51.0, 32.5, 23.5)
DISTORTION = (-0.28, 0.07, 2e-4, 1.7e-05)


class BagWriter:
    """Messages of one ROS generation, and where they are written to."""

    def __init__(self, writer: Any, store: Any, is_ros1: bool) -> None:
        self._writer, self._store, self._is_ros1 = writer, store, is_ros1
        self._connections: dict[str, Any] = {}

    def make(self, name: str, *values: Any) -> Any:
        """A message by its type, e.g. ``sensor_msgs/msg/Imu``."""
        if name == TRANSFORMS and name not in self._store.types:  # ROS 1 has it under this name
            definition = "geometry_msgs/TransformStamped[] transforms"
            self._store.register(get_types_from_msg(definition, name))
        return self._store.types[name](*values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds = stamp_ns // 10**9
        signed = seconds - 2**32 if seconds >= 2**31 else seconds  # the same bits for rosbags
        stamp = self.make("builtin_interfaces/msg/Time", signed, stamp_ns % 10**9)
        sequence = (0,) if self._is_ros1 else ()
        return self.make("std_msgs/msg/Header", *sequence, stamp, frame)

    def write(self, topic: str, message: Any, received_ns: int) -> None:
        msgtype = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=self._store
            )
        serialize = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        self._writer.write(
            self._connections[topic], received_ns, bytes(serialize(message, msgtype))
        )

    def imu(self, stamp_ns: int, gyro: Any, accel: Any, frame: str = "imu") -> Any:
        turn = self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        covariance = np.zeros(9)
        rate = self.make("geometry_msgs/msg/Vector3", *map(float, gyro))
        force = self.make("geometry_msgs/msg/Vector3", *map(float, accel))
        header = self.header(stamp_ns, frame)
        return self.make(
            "sensor_msgs/msg/Imu", header, turn, covariance, rate, covariance, force, covariance
        )

    def image(
        self, stamp_ns: int, data: Any, encoding: str, frame: str = "cam0", big_endian: int = 0
    ) -> Any:
        """An image of (height, width[, channels]) numbers, its rows filled up by three bytes."""
        height, width = data.shape[:2]
        rows = np.ascontiguousarray(data).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, 3)), constant_values=255)
        values = (height, width, encoding, big_endian, rows.shape[1], rows.ravel())
        return self.make("sensor_msgs/msg/Image", self.header(stamp_ns, frame), *values)

    def compressed(self, stamp_ns: int, data: bytes, form: str, frame: str = "cam0") -> Any:
        header = self.header(stamp_ns, frame)
        return self.make(
            "sensor_msgs/msg/CompressedImage", header, form, np.frombuffer(data, np.uint8)
        )

    def camera_info(
        self,
        stamp_ns: int,
        frame: str,
        k3: float = 0.0,
        camera: Camera | None = None,
        size: tuple[int, int] = SIZE,
        R: Any = np.eye(3),  # noqa: B008 - read only
    ) -> Any:
        """Of a camera with distortion `radtan`, by default of the small made-up one."""
        fx, fy, cx, cy = INTRINSICS if camera is None else camera.intrinsics.tolist()
        distortion = DISTORTION if camera is None else camera.coefficients
        width, height = size if camera is None else (camera.width, camera.height)
        K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
        P = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        matrices = (np.array([*distortion, k3]), K, np.array(R, np.float64).ravel(), P)
        header = self.header(stamp_ns, frame)
        model = (height, width, "plumb_bob")
        return self.make("sensor_msgs/msg/CameraInfo", header, *model, *matrices, 0, 0, region)

    def fix(
        self,
        stamp_ns: int,
        place: Any,
        covariance: Any = np.eye(3),  # noqa: B008 - read only
        kind: int = 2,
        status: int = 0,
    ) -> Any:
        """A `NavSatFix`: latitude, longitude, altitude; the type of the covariance is `kind`."""
        state = self.make("sensor_msgs/msg/NavSatStatus", status, 1)
        numbers = (*map(float, place), np.array(covariance, np.float64).ravel(), kind)
        header = self.header(stamp_ns, "antenna")
        return self.make("sensor_msgs/msg/NavSatFix", header, state, *numbers)

    def odometry(self, stamp_ns: int, t: Any, q: Any, child: str = "base") -> Any:
        """q is x, y, z, w."""
        place = self.make("geometry_msgs/msg/Point", *map(float, t))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, q))
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        pose = self.make("geometry_msgs/msg/Pose", place, turn)
        twist = self.make("geometry_msgs/msg/Twist", zero, zero)
        known = self.make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
        moved = self.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        header = self.header(stamp_ns, "odom")
        return self.make("nav_msgs/msg/Odometry", header, child, known, moved)

    def known_pose(self, stamp_ns: int, t: Any, q: Any, covariance: Any) -> Any:
        """A `PoseWithCovarianceStamped`; q is x, y, z, w."""
        place = self.make("geometry_msgs/msg/Point", *map(float, t))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, q))
        pose = self.make("geometry_msgs/msg/Pose", place, turn)
        numbers = np.array(covariance, np.float64).ravel()
        known = self.make("geometry_msgs/msg/PoseWithCovariance", pose, numbers)
        header = self.header(stamp_ns, "world")
        return self.make("geometry_msgs/msg/PoseWithCovarianceStamped", header, known)

    def transform(self, stamp_ns: int, parent: str, child: str, t: Any, q: Any) -> Any:
        """q is x, y, z, w."""
        move = self.make("geometry_msgs/msg/Vector3", *map(float, t))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, q))
        value = self.make("geometry_msgs/msg/Transform", move, turn)
        return self.make(
            "geometry_msgs/msg/TransformStamped", self.header(stamp_ns, parent), child, value
        )


@contextmanager
def bag_writer(path: Path, kind: str, packed: str = "") -> Iterator[BagWriter]:
    """Write a new bag.

    `packed` is the format of its chunks ("bz2", "lz4"; ROS 1), or what is packed by zstd ("file",
    "message", in MCAP "storage"; ROS 2).
    """
    if kind == "ros1":
        writer = Writer1(path)
        if packed:
            writer.set_compression(Writer1.CompressionFormat[packed.upper()])
        with writer:
            yield BagWriter(writer, get_typestore(Stores.ROS1_NOETIC), True)
        return
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
    writer2 = Writer2(path, version=8, storage_plugin=plugin)
    if packed:
        writer2.set_compression(CompressionMode[packed.upper()], CompressionFormat.ZSTD)
    with writer2:
        yield BagWriter(writer2, get_typestore(Stores.ROS2_HUMBLE), False)


def write_bag(
    folder: Path,
    kind: str = "ros1",
    frames: int = 8,
    stamped: bool = True,
    extra: Callable[[BagWriter], None] | None = None,
    calibrated: bool = True,
    cameras: int = 2,
    size: tuple[int, int] = SIZE,
    imu_lead: int = 20,
    packed: str = "",
) -> Path:
    """A bag with images, IMU and poses, which carries its calibration."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / ("flight.bag" if kind == "ros1" else "flight")
    rng = np.random.default_rng(1)
    with bag_writer(path, kind, packed) as bag:
        if calibrated:
            write_calibration(bag, cameras, size)
        if extra is not None:
            extra(bag)
        count = imu_lead + (frames - 1) * FRAME_PERIOD_NS // IMU_PERIOD_NS + 5
        noise = np.random.default_rng(2).normal(0.0, 1e-3, (count, 6))
        noise[:, 5] += 9.81
        for k in range(count):
            stamp_ns = START_NS + (k - imu_lead) * IMU_PERIOD_NS
            told_ns = stamp_ns if stamped else 0
            bag.write("/imu0", bag.imu(told_ns, noise[k, :3], noise[k, 3:]), stamp_ns + LAG_NS)
            if k >= imu_lead and (k - imu_lead) % 10 == 0 and (k - imu_lead) // 10 < frames:
                for c in range(cameras):
                    image = rng.integers(0, 255, (size[1], size[0]), dtype=np.uint8)
                    message = bag.image(told_ns, image, "mono8", f"cam{c}")
                    # the left image is recorded after the right one of the next frame
                    late_ns = LAG_NS if c else FRAME_PERIOD_NS + 2 * LAG_NS
                    bag.write(f"/cam{c}/image_raw", message, stamp_ns + late_ns)
                pose = bag.transform(told_ns, "world", "body", [k, 2, 3], [0.5, 0.5, -0.5, 0.5])
                bag.write("/truth", pose, stamp_ns + LAG_NS)
    return next(path.glob("*.mcap")) if kind == "mcap_file" else path


def write_bag_of(sequence: RecordedSequence, path: Path, kind: str, end_ns: int) -> Path:
    """Images and IMU of a recording as a bag, without calibration."""
    with bag_writer(path, kind) as bag:
        for packet in sequence.packets(end_ns=end_ns):
            assert isinstance(packet.frame, CameraFrame)
            samples = zip(
                packet.imu.stamps_ns.tolist(), packet.imu.gyro, packet.imu.accel, strict=True
            )
            for stamp_ns, gyro, accel in samples:
                bag.write("/imu0", bag.imu(stamp_ns, gyro, accel), stamp_ns)
            for c, image in enumerate(packet.frame.images):
                if image is not None:
                    message = bag.image(packet.frame.stamp_ns, image, "mono8", f"cam{c}")
                    bag.write(f"/cam{c}/image_raw", message, packet.frame.stamp_ns + LAG_NS)
    return path


def write_calibration(bag: BagWriter, cameras: int = 2, size: tuple[int, int] = SIZE) -> None:
    """`CameraInfo` of the cameras, and where they are: by way of a frame between."""
    begin_ns = START_NS - 10**9
    transforms = [
        bag.transform(0, "base", "imu", [0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]),
        bag.transform(0, "base", "cam0", [0.1, 0.0, 0.1], [0.5, 0.5, 0.5, 0.5]),
        bag.transform(0, "cam0", "cam1", [0.1, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]),
    ]
    message = bag.make(TRANSFORMS, transforms)
    bag.write("/tf_static", message, begin_ns)
    for c in range(cameras):
        info = bag.camera_info(begin_ns, f"cam{c}", size=size)
        bag.write(f"/cam{c}/camera_info", info, begin_ns)


def write_calibration_of(bag: BagWriter, rig: Rig, places: list[str]) -> None:
    """`camera_info` of the cameras of a rig below some topics, and where they are on the IMU."""
    transforms = []
    for c, mounted in enumerate(rig.cameras):
        pose = mounted.body_T_camera
        q = pose.rotation().toQuaternion().coeffs()
        transforms.append(bag.transform(0, "imu", f"cam{c}", pose.translation(), q))
        bag.write(f"{places[c]}/camera_info", bag.camera_info(1, f"cam{c}", 0.0, mounted.camera), 1)
    bag.write("/tf_static", bag.make(TRANSFORMS, transforms), 1)


def encoded(image: np.ndarray, suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1].tobytes())
