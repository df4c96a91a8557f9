# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS bag as a sequence: images and IMU streamed in the order of their header stamps."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, warn_noise_assumed
from slam_graph.datasets.rosbag.bag import REINDEX, Bag, Message
from slam_graph.datasets.rosbag.messages import image_fields, image_of, inertial_of, pose_of
from slam_graph.datasets.rosbag.ros_aiding import BagAiding
from slam_graph.datasets.rosbag.ros_depth import depth_of, find_depth
from slam_graph.datasets.rosbag.ros_topics import find_topics, read_bag_rig
from slam_graph.datasets.sequence import FrameStream, ReaderOptions, SequenceInfo
from slam_graph.datasets.streams.depth_images import DepthFinish, Metres, nearest_in_time
from slam_graph.datasets.streams.image_sequence import (
    LOOKED_AT,
    STEREO_TOLERANCE_S,
    GroupedSequence,
    check_size,
    require_size,
)
from slam_graph.datasets.streams.images import Fault, Image, prefetch
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.datasets.streams.pairing import ABSENT, Groups, in_order
from slam_graph.datasets.streams.vector_lengths import lengths_of
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory
from slam_graph.sensors import AidingData, ImuData, ImuNoise

SAMPLES_PER_BLOCK = 256

_Result = Image | tuple[int, Metres] | Fault | None
"""An image, or the stamp and the image of depth, or what is wrong with one."""


@dataclass(frozen=True, eq=False)
class _Index:
    """The images of a bag by their stamps.

    Attributes:
        received_ns: for each camera the times at which all its messages were recorded; those of
            depth come last.
        kept: for each camera which of its messages are used: those in the order of time.
        groups: frames, with indices into `kept`.
        depth_frames: the frame of each message of depth that is in one, by its number.
        depth_stamps_ns: of these messages.
        imu_samples: number of messages of the IMU.
    """

    received_ns: list[NDArray[np.int64]]
    kept: list[NDArray[np.intp]]
    groups: Groups
    depth_frames: dict[int, int]
    depth_stamps_ns: dict[int, int]
    imu_samples: int

    def frame_of(self) -> list[dict[int, int]]:
        """For each camera, and for depth, the frame of each message that is in one."""
        frames: list[dict[int, int]] = [{} for _ in self.kept]
        for frame, members in enumerate(self.groups.members.tolist()):
            for camera, member in enumerate(members):
                if member != ABSENT:
                    frames[camera][int(self.kept[camera][member])] = frame
        return [*frames, self.depth_frames]


class RosBagSequence(GroupedSequence):
    """A bag with images, and with an IMU or depth or both.

    The whole bag is read once for its stamps before the first frame is delivered. Messages without
    a stamp get the time at which they were recorded (`stamp_missing`). A damaged bag is used up to
    the damage (`bag_damaged`).

    Args:
        path: a ``.bag``, ``.mcap`` or ``.db3`` file, or the folder of a ROS 2 bag.
        options: what else is asked for. Without a calibration `CameraInfo` and ``/tf_static`` are
            used; `sources` are topics by ``imu``, ``cam0``, …, ``depth`` and ``groundtruth`` (poses
            of the body).

    Raises:
        DataError: if a topic or the calibration is missing, or the bag cannot be read.
    """

    format: ClassVar[str] = "rosbag"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path
        self._bag = Bag(path)
        with self._bag.kept_open():
            self._set_up(options)

    def _set_up(self, options: ReaderOptions) -> None:
        """Topics, calibration and the size of the first images."""
        path = self.path
        chain, cameras = options.calibration, options.cameras
        topics = find_topics(self._bag, options.sources, chain)
        self._imu_topic, self._truth_topic = topics.imu, topics.groundtruth
        if chain is not None:
            needs_imu = topics.imu is not None and options.imu
            rig = read_kalibr(chain, needs_imu=needs_imu, diagnostics=options.diagnostics)
        else:
            count = len(topics.cameras) if cameras is None else cameras
            used = replace(topics, cameras=topics.cameras[:count])
            rig = read_bag_rig(self._bag, used, ImuNoise())
            if topics.imu is not None and options.imu:
                warn_noise_assumed(path, options.diagnostics)
        if len(topics.cameras) < len(rig.cameras) or (
            len(topics.cameras) > len(rig.cameras) and chain is not None
        ):
            raise DataError(
                f"{path}: {len(rig.cameras)} cameras are calibrated, images are on "
                f"{', '.join(topics.cameras)}; choose with --topic cam0=…"
            )
        rig = replace(options.select(rig), has_imu=topics.imu is not None)
        self._cameras = topics.cameras[: len(rig.cameras)]
        self._depth_topic, rig = find_depth(self._bag, topics, rig, options.diagnostics)
        truth = None if topics.groundtruth is None else self._read_poses
        super().__init__(path.stem, rig, self._cameras, None, options, truth)
        for k, topic in enumerate(self._cameras):
            self._check_first_images(topic, k)
        self._finish_depth = None if rig.depth is None else DepthFinish.of(rig)
        self._check_first_depth()

    @property
    def _topics(self) -> list[str]:
        """Those of the cameras, and that of depth."""
        return [*self._cameras, *([] if self._depth_topic is None else [self._depth_topic])]

    @cached_property
    def _with_depth(self) -> set[int]:
        """The frames that have a depth image."""
        return set(self._index.depth_frames.values())

    def depth_frames(self) -> int:
        """Number of frames with a depth image."""
        return len(self._with_depth)

    @property
    def groups(self) -> Groups:
        """Which images belong together."""
        return self._index.groups

    def measure(self) -> SequenceInfo:
        """Count frames and IMU samples."""
        stamps = self.groups.stamps_ns
        ends = (int(stamps[0]), int(stamps[-1])) if len(stamps) else (0, 0)
        return self.holding(len(stamps), *ends, self._index.imu_samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on."""
        return clean_blocks(self._samples_in_blocks(), self.diagnostics, after_ns)

    def read_aiding(self) -> AidingData:
        """Fixes and odometry on topics of the bag, or in files."""
        body = self._cameras[0] if self._imu_topic is None else self._imu_topic
        aiding = BagAiding(self._bag, self.named_aiding, body, self.diagnostics)
        self.named_aiding = aiding.in_files
        return aiding.read(super().read_aiding(), self._until_damage, self._stamp_ns)

    def _samples_in_blocks(self) -> Iterator[tuple[Callable[[int], str], ImuData]]:
        if self._imu_topic is None:
            return
        with closing(self._until_damage([self._imu_topic])) as messages:
            while block := list(islice(messages, SAMPLES_PER_BLOCK)):
                stamps = np.array([self._stamp_ns(message) for message in block], np.int64)
                values = np.array([m.decode_or(inertial_of, [np.nan] * 6) for m in block])
                yield partial(self._place, block), ImuData(stamps, values[:, :3], values[:, 3:])

    def _place(self, block: list[Message], index: int) -> str:
        return self._where(block[index])

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """Frames with their images, the next ones decoded in a thread.

        Images are read in the order in which they were recorded. A frame is delivered when it is
        complete and all frames before it are delivered.
        """
        wanted = self._range(start_ns, end_ns)
        waiting = {frame: self._members(frame) for frame in wanted}
        images: dict[int, list[Image | Fault | None]] = {}
        depths: dict[int, tuple[int, Metres] | Fault | None] = {}
        following = iter(wanted)
        current = next(following, None)
        with closing(prefetch(self._jobs(wanted))) as results:
            for frame, camera, result in results:
                seen = images.setdefault(frame, [None] * len(self._cameras))
                if isinstance(result, tuple) or camera == len(seen):
                    depths[frame] = result if isinstance(result, tuple | Fault) else None
                else:
                    seen[camera] = result
                waiting[frame] -= 1
                while current is not None and waiting[current] == 0:
                    yield self._report(current, images.pop(current), depths.pop(current, None))
                    current = next(following, None)

    def _members(self, frame: int) -> int:
        of_cameras = int(np.count_nonzero(self.groups.members[frame] != ABSENT))
        return of_cameras + (frame in self._with_depth)

    def _jobs(self, wanted: range) -> Iterator[Callable[[], tuple[int, int, _Result]]]:
        """What decodes each image of the wanted frames."""
        if not wanted:
            return
        frame_of, index = self._index.frame_of(), self._index
        times = [
            int(index.received_ns[camera][message])
            for camera, frames in enumerate(frame_of)
            for message, frame in frames.items()
            if frame in wanted
        ]
        since_ns, until_ns = min(times), max(times)
        passed = [int(np.count_nonzero(received < since_ns)) for received in index.received_ns]
        with closing(self._bag.messages(self._topics, since_ns, until_ns)) as messages:
            for message in messages:
                camera = self._topics.index(message.topic)
                number = passed[camera]
                frame = frame_of[camera].get(number)
                passed[camera] += 1
                if frame is None or frame not in wanted:
                    continue
                if camera == len(self._cameras):
                    stamp_ns = index.depth_stamps_ns[number]
                    yield partial(self._decode_depth, frame, stamp_ns, message)
                else:
                    yield partial(self._decode, frame, camera, message)

    def _decode(self, frame: int, camera: int, message: Message) -> tuple[int, int, _Result]:
        """An image with its frame and camera; runs in a thread, so it counts no faults."""
        return frame, camera, self._read(message, camera) if self.decode else None

    def _decode_depth(
        self, frame: int, stamp_ns: int, message: Message
    ) -> tuple[int, int, _Result]:
        """The same for a depth image."""
        if not self.decode:
            return frame, len(self._cameras), None
        metres = self._depth(message)
        done = metres if isinstance(metres, Fault) else (stamp_ns, metres)
        return frame, len(self._cameras), done

    def _depth(self, message: Message) -> Metres | Fault:
        where = self._where(message)
        try:
            fields = message.decode(image_fields)
        except DataError as error:
            return Fault("depth_unreadable", str(error))
        raw = depth_of(fields, where)
        assert self._finish_depth is not None
        return raw if isinstance(raw, Fault) else self._finish_depth(raw, where)

    def _read(self, message: Message, camera: int) -> Image | Fault:
        model = self.rig.cameras[camera].camera
        return check_size(self._image(message), model, lambda: self._where(message))

    def _check_first_images(self, topic: str, camera: int) -> None:
        """Refuse images of another size than calibrated, or of an encoding that is not known."""
        with closing(self._bag.messages([topic])) as messages:
            images = [self._image(message) for message in islice(messages, LOOKED_AT)]
        if not images:
            raise DataError(f"{self.path}: no image on '{topic}' can be read; {REINDEX}")
        faults = [image for image in images if isinstance(image, Fault)]
        if len(faults) == len(images) and "unknown encoding" in faults[0].message:
            raise DataError(faults[0].message)
        require_size(images, self.rig.cameras[camera].camera, topic)

    def _check_first_depth(self) -> None:
        """Refuse depth of another size than calibrated, or of an encoding that is not known."""
        if self._depth_topic is None:
            return
        with closing(self._bag.messages([self._depth_topic])) as messages:
            first = [self._depth(message) for message in islice(messages, LOOKED_AT)]
        faults = [image for image in first if isinstance(image, Fault)]
        if first and len(faults) == len(first):
            raise DataError(f"{faults[0].message}; give --calibration with the key 'depth0'")

    def _image(self, message: Message) -> Image | Fault:
        try:
            fields = message.decode(image_fields)
        except DataError as error:
            return Fault("image_unreadable", str(error))
        return image_of(fields, self._where(message))

    @cached_property
    def _index(self) -> _Index:
        """The stamps of all images, from one pass over the bag."""
        received: list[list[int]] = [[] for _ in range(len(self._cameras) + 1)]
        stamps: list[list[int]] = [[] for _ in range(len(self._cameras) + 1)]
        samples = 0
        inertial = [] if self._imu_topic is None else [self._imu_topic]
        for message in self._until_damage([*self._topics, *inertial]):
            if message.topic == self._imu_topic:
                samples += 1
                continue
            camera = self._topics.index(message.topic)
            received[camera].append(message.received_ns)
            stamps[camera].append(self._stamp_ns(message))
        *all_stamps, depth_ns = [np.array(column, np.int64) for column in stamps]
        kept = [self._in_order(*camera) for camera in zip(self._cameras, all_stamps, strict=True)]
        used = [column[rows] for column, rows in zip(all_stamps, kept, strict=True)]
        groups = self._group(used, STEREO_TOLERANCE_S)
        rows = self._in_order(self._depth_topic or "", depth_ns)
        nearest = nearest_in_time(groups.stamps_ns, depth_ns[rows]).tolist()
        depth_frames = {int(rows[k]): f for f, k in enumerate(nearest) if k != ABSENT}
        return _Index(
            [np.array(column, np.int64) for column in received],
            kept,
            groups,
            depth_frames,
            {number: int(depth_ns[number]) for number in depth_frames},
            samples,
        )

    def _in_order(self, topic: str, stamps_ns: NDArray[np.int64]) -> NDArray[np.intp]:
        """The images of a camera whose stamps increase; the others are counted."""

        def dropped(k: int, _: int) -> None:
            what = f"{topic}: image at {stamps_ns[k]} dropped, not in the order of time"
            self.diagnostics.warn("camera_out_of_order", f"{self.path}: {what}")

        return in_order(stamps_ns, dropped)

    def _until_damage(self, topics: list[str]) -> Generator[Message, None, None]:
        """Messages up to the first damage of the bag."""
        try:
            yield from self._bag.messages(topics)
        except DataError as error:
            self.diagnostics.warn("bag_damaged", f"{error}; what comes before is used")

    def _stamp_ns(self, message: Message) -> int:
        """The stamp of a message, or the time at which it was recorded if it has none."""
        stamp_ns = self._bag.header_stamp_ns(message)
        if stamp_ns > 0:
            return stamp_ns
        self.diagnostics.warn(
            "stamp_missing", f"{self._where(message)}: no stamp, the time of recording is taken"
        )
        return message.received_ns

    def _where(self, message: Message) -> str:
        return f"{self.path}: {message.topic} recorded at {message.received_ns}"

    def _read_poses(self) -> Trajectory:
        """The ground truth that was named."""
        topic = self._truth_topic
        assert topic is not None
        take = partial(pose_of, msgtype=self._bag.topics[topic])
        stamps: list[int] = []
        values: list[list[float]] = []
        for message in self._until_damage([topic]):
            stamp_ns = self._stamp_ns(message)
            pose = message.decode_or(take, [np.nan] * 7)
            length = float(lengths_of(np.array([pose[3:]]))[0])
            if not np.isfinite([*pose, length]).all() or length < 0.5:
                self.diagnostics.warn("groundtruth_not_finite", f"{self._where(message)}: dropped")
            elif stamps and stamp_ns <= stamps[-1]:
                self.diagnostics.warn(
                    "groundtruth_out_of_order", f"{self._where(message)}: dropped"
                )
            else:
                stamps.append(stamp_ns)
                values.append(pose)
        if not stamps:
            raise DataError(f"{self.path}: no usable pose on '{topic}'")
        poses = np.array(values)
        quaternions = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        return Trajectory(np.array(stamps, np.int64), poses[:, :3].copy(), quaternions)
