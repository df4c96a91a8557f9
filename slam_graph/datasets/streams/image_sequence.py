# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences of images: a stream of images for each camera, grouped into frames by their stamps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal, Protocol

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.datasets.sequence import (
    FrameStream,
    ReaderOptions,
    RecordedSequence,
    SequenceInfo,
)
from slam_graph.datasets.streams.depth_images import (
    DepthStream,
    Metres,
    nearest_in_time,
    require_depth_size,
)
from slam_graph.datasets.streams.images import Fault, Image, prefetch
from slam_graph.datasets.streams.imu_stream import ImuSource
from slam_graph.datasets.streams.pairing import ABSENT, Groups, group_by_time
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory
from slam_graph.sensors import Camera, CameraFrame, ImuData, Rig

STEREO_TOLERANCE_S = 0.003
"""Images at most this far apart are one frame; EuRoC's pairs differ by a few hundred ns."""

LOOKED_AT = 3
"""Images of a camera that are read when a recording is opened, to compare their size with the
calibration: one of another size is a faulty image, three mean a calibration for other images."""


class ImageStream(Protocol):
    """The images of one camera.

    Attributes:
        name: of the camera, for messages.
        stamps_ns: (N,) int64, strictly increasing.
    """

    name: str
    stamps_ns: IntArray

    def read(self, index: int) -> Image | Fault:
        """One image, of any size, or what is wrong with it; may be called in another thread."""
        ...

    def missing(self, index: int) -> Fault | None:
        """What is wrong with one image as far as is known without reading it."""
        ...

    def where(self, index: int) -> str:
        """The place of one image, for messages."""
        ...


class GroupedSequence(RecordedSequence):
    """A recording of images, grouped into frames by their stamps.

    Frames carry None for the image of a camera that has none at that time (counted as
    `camera_frame_missing`), or one that is damaged or not of the calibrated size
    (`image_unreadable`, `image_wrong_size`).

    Args:
        name: of the recording.
        rig: its calibration.
        camera_names: of the cameras of the rig, for messages.
        imu: its samples; None without an IMU.
        options: what was asked for.
        own_groundtruth: as for `RecordedSequence`.

    Attributes:
        decode: whether images are decoded; they are all None otherwise.
    """

    content: ClassVar[Literal["images", "tracks"]] = "images"

    def __init__(
        self,
        name: str,
        rig: Rig,
        camera_names: Sequence[str],
        imu: ImuSource | None,
        options: ReaderOptions,
        own_groundtruth: Path | Callable[[], Trajectory] | None = None,
    ) -> None:
        super().__init__(name, rig, options, own_groundtruth)
        self.decode = True
        self._imu = imu
        self._camera_names = camera_names

    def without_images(self) -> GroupedSequence:
        """The same recording with frames without images, which is quick to run through."""
        twin = copy(self)
        twin.decode = False
        return twin

    @property
    @abstractmethod
    def groups(self) -> Groups:
        """Which images belong together."""

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on."""
        if self._imu is None or not self.has_imu:
            return iter(())
        return self._imu.blocks(self.diagnostics, after_ns)

    def measure(self) -> SequenceInfo:
        """Count frames and IMU samples."""
        used = self._imu if self.has_imu else None
        samples = 0 if used is None else used.count()
        stamps = self.groups.stamps_ns
        if len(stamps):
            return self.holding(len(stamps), int(stamps[0]), int(stamps[-1]), samples)
        assert used is not None
        return self.holding(0, *used.ends_ns(), samples)

    def _range(self, start_ns: int | None, end_ns: int | None) -> range:
        """The frames within [start_ns, end_ns]."""
        stamps = self.groups.stamps_ns
        first = 0 if start_ns is None else int(np.searchsorted(stamps, start_ns))
        last = len(stamps) if end_ns is None else int(np.searchsorted(stamps, end_ns, "right"))
        return range(first, last)

    def _group(self, stamps: Sequence[IntArray], tolerance_s: float) -> Groups:
        groups = group_by_time(stamps, round(tolerance_s * 1e9))
        for stamp in groups.skipped:
            what = f"{self.name}: frame at {stamp} dropped, not in the order of time"
            self.diagnostics.warn("camera_out_of_order", what)
        return groups

    def _report(
        self,
        index: int,
        images: Sequence[Image | Fault | None],
        depth: tuple[int, Metres] | Fault | None = None,
    ) -> CameraFrame:
        """Count what is wrong with a frame, and deliver the rest of it."""
        stamp_ns = int(self.groups.stamps_ns[index])
        for camera, member in enumerate(self.groups.members[index].tolist()):
            image = images[camera]
            if member == ABSENT:
                name = self._camera_names[camera]
                self.diagnostics.warn("camera_frame_missing", f"{name} has no image at {stamp_ns}")
            elif isinstance(image, Fault):
                self.diagnostics.warn(image.kind, image.message)
        if isinstance(depth, Fault):
            self.diagnostics.warn(depth.kind, depth.message)
            depth = None
        good = tuple(None if isinstance(image, Fault) else image for image in images)
        depth_ns, metres = (None, None) if depth is None else depth
        return CameraFrame(stamp_ns, good, metres, depth_ns)


class ImageSequence(GroupedSequence):
    """A recording of images that can be read in any order.

    Args:
        name: of the recording.
        rig: its calibration.
        streams: the images of each camera of the rig.
        imu: its samples; None without an IMU.
        options: what was asked for.
        own_groundtruth: as for `RecordedSequence`.
        stereo_tolerance_s: largest time difference of images that are one frame.
        depth: the depth images of the rig's depth sensor; None where there are none.

    Raises:
        DataError: if there are neither images nor an IMU, or the calibration is for images of
            another size.
    """

    def __init__(
        self,
        name: str,
        rig: Rig,
        streams: Sequence[ImageStream],
        imu: ImuSource | None,
        options: ReaderOptions,
        own_groundtruth: Path | Callable[[], Trajectory] | None = None,
        stereo_tolerance_s: float = STEREO_TOLERANCE_S,
        depth: DepthStream | None = None,
    ) -> None:
        rig = replace(
            rig,
            has_imu=rig.has_imu and imu is not None,
            depth=None if depth is None else rig.depth,
        )
        depth = None if rig.depth is None else depth
        super().__init__(name, rig, [s.name for s in streams], imu, options, own_groundtruth)
        self._streams = streams
        for mounted, stream in zip(rig.cameras, streams, strict=True):
            count = min(len(stream.stamps_ns), LOOKED_AT)
            images = (stream.read(k) for k in range(count))
            require_size(images, mounted.camera, stream.name)
        self._groups = self._group([s.stamps_ns for s in streams], stereo_tolerance_s)
        if not self.has_imu and len(self._groups.stamps_ns) == 0:
            raise DataError(f"{name}: neither images nor an IMU in this recording")
        self._depth = depth
        if depth is not None:
            require_depth_size(depth, LOOKED_AT)
            self._depth_of_frame = nearest_in_time(self._groups.stamps_ns, depth.stamps_ns)

    @property
    def groups(self) -> Groups:
        """Which images belong together."""
        return self._groups

    def depth_frames(self) -> int:
        """Number of frames with a depth image."""
        return 0 if self._depth is None else int(np.sum(self._depth_of_frame != ABSENT))

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """Frames with their images, the next ones decoded in a thread."""
        wanted = self._range(start_ns, end_ns)
        jobs = (partial(self._read_frame, k) for k in wanted)
        with closing(prefetch(jobs)) as results:
            for k, (images, depth) in zip(wanted, results, strict=True):
                yield self._report(k, images, depth)

    def _read_frame(
        self, index: int
    ) -> tuple[list[Image | Fault | None], tuple[int, Metres] | Fault | None]:
        """The images of one frame; runs in a thread, so it counts no faults."""
        images: list[Image | Fault | None] = []
        for camera, member in enumerate(self._groups.members[index].tolist()):
            if member == ABSENT:
                images.append(None)
            elif self.decode:
                images.append(self._read_image(camera, member))
            else:
                images.append(self._streams[camera].missing(member))
        return images, self._read_depth(index)

    def _read_depth(self, index: int) -> tuple[int, Metres] | Fault | None:
        """The depth image nearest in time to a frame, after its stamp."""
        if self._depth is None or (member := int(self._depth_of_frame[index])) == ABSENT:
            return None
        if not self.decode:
            return self._depth.missing(member)
        metres = self._depth.read(member)
        if isinstance(metres, Fault):
            return metres
        return int(self._depth.stamps_ns[member]), metres

    def _read_image(self, camera: int, member: int) -> Image | Fault:
        stream, model = self._streams[camera], self.rig.cameras[camera].camera
        return check_size(stream.read(member), model, partial(stream.where, member))


def check_size(image: Image | Fault, camera: Camera, where: Callable[[], str]) -> Image | Fault:
    """The image, or a fault if it is not of the size that its camera is calibrated for."""
    if isinstance(image, Fault) or image.shape == (camera.height, camera.width):
        return image
    got, expected = f"{image.shape[1]}x{image.shape[0]}", f"{camera.width}x{camera.height}"
    return Fault("image_wrong_size", f"{where()}: {got}, the calibration says {expected}")


def require_size(images: Iterable[Image | Fault], camera: Camera, name: str) -> None:
    """Refuse a calibration for images of another size.

    Smaller images may have been scaled or cropped, so the calibration is not adapted.

    Args:
        images: the first ones of a recording.
        camera: its calibration.
        name: of the camera, for the message.

    Raises:
        DataError: if the images are all of the same size, but of another one.
    """
    calibrated = (camera.width, camera.height)
    sizes = set()
    for image in images:
        if not isinstance(image, Fault):
            sizes.add((image.shape[1], image.shape[0]))
        if calibrated in sizes:
            return
    if len(sizes) != 1:
        return
    (size,) = sizes
    scales = {have / max(want, 1) for have, want in zip(size, calibrated, strict=True)}
    hint = f" ({scales.pop():g} times as large)" if len(scales) == 1 else ""
    raise DataError(
        f"{name}: images are {size[0]}x{size[1]}{hint}, the calibration is for "
        f"{calibrated[0]}x{calibrated[1]}; give the calibration of these "
        "images with --calibration"
    )
