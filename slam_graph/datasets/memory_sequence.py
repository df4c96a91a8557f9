# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A recording in memory: IMU samples, and images or feature tracks, as arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_graph.arrays import IntArray
from slam_graph.datasets.sequence import (
    FrameStream,
    ReaderOptions,
    RecordedSequence,
    SequenceInfo,
)
from slam_graph.datasets.streams.depth_images import DepthFinish, Metres
from slam_graph.datasets.streams.image_sequence import ImageSequence
from slam_graph.datasets.streams.images import Fault, Image
from slam_graph.datasets.streams.imu_stream import ImuArrays
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import FeatureFrame, ImuData, Rig


def dataset_from_arrays(
    rig: Rig,
    *,
    imu_stamps_ns: ArrayLike | None = None,
    gyro: ArrayLike | None = None,
    accel: ArrayLike | None = None,
    image_stamps_ns: ArrayLike | None = None,
    images: Sequence[Sequence[Image | None]] | None = None,
    depth: Sequence[NDArray[np.float32] | None] | None = None,
    features: Sequence[FeatureFrame] | None = None,
    groundtruth: Trajectory | None = None,
    initial_state: NavState | None = None,
    name: str = "arrays",
    diagnostics: Diagnostics | None = None,
) -> RecordedSequence:
    """A recording from arrays in memory, to run on or to convert like any other.

    Give either `images` with `image_stamps_ns`, or `features`; and all of the IMU, or nothing.

    Args:
        rig: calibrated cameras and noise of the IMU.
        imu_stamps_ns: (N,) times of the IMU samples in nanoseconds, int64.
        gyro: (N, 3) angular rate in the body frame, rad/s.
        accel: (N, 3) specific force in the body frame, m/s² (+9.81 upwards at rest).
        image_stamps_ns: (F,) times of the frames in nanoseconds, increasing.
        images: for each camera of the rig F images (height, width) uint8, or None where one is
            missing. A (F, height, width) array will do for a camera.
        depth: F depth images (height, width) in m, registered to the camera that `rig.depth` names,
            NaN where there is none; None for one that is missing.
        features: what each camera sees in each frame, with increasing times.
        groundtruth: true trajectory of the body.
        initial_state: known state at the start.
        name: of the recording.
        diagnostics: where faults are counted, such as IMU samples that are not finite.

    Raises:
        DataError: if the arrays do not fit one another or the rig.
    """
    imu = None
    if imu_stamps_ns is not None or gyro is not None or accel is not None:
        if imu_stamps_ns is None or gyro is None or accel is None:
            raise DataError(f"{name}: an IMU needs imu_stamps_ns, gyro and accel")
        imu = ImuArrays(_imu(imu_stamps_ns, gyro, accel))
    options = ReaderOptions(diagnostics=diagnostics or Diagnostics())
    truth = None if groundtruth is None else lambda: groundtruth
    if (images is None) == (features is None):
        raise DataError(f"{name}: give either images or features")
    if features is not None:
        return _FeaturesInMemory(name, rig, features, imu, options, truth, initial_state)
    if image_stamps_ns is None:
        raise DataError(f"{name}: images need their times, image_stamps_ns")
    assert images is not None
    stamps = np.asarray(image_stamps_ns)
    streams = _streams(name, rig, stamps, images)
    measured = None if depth is None else _depths(name, rig, stamps, depth)
    return _ImagesInMemory(name, rig, streams, imu, options, truth, initial_state, measured)


def _depths(
    name: str,
    rig: Rig,
    stamps: NDArray[np.generic],
    depth: Sequence[NDArray[np.float32] | None],
) -> _DepthInMemory:
    """The depth images, without those that are None."""
    if rig.depth is None or rig.depth.lens is not None:
        raise DataError(f"{name}: depth needs a rig with a depth sensor that is registered")
    if len(depth) != len(stamps):
        raise DataError(f"{name}: expected {len(stamps)} depth images, got {len(depth)}")
    there = [k for k, image in enumerate(depth) if image is not None]
    images = [np.asarray(image, np.float32) for image in depth if image is not None]
    stamps_ns = _nanoseconds(stamps, "image_stamps_ns")[there]
    return _DepthInMemory("depth", stamps_ns, images, DepthFinish.of(rig))


def _imu(stamps_ns: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> ImuData:
    """The samples, checked for their shapes."""
    stamps = np.asarray(stamps_ns)
    values = [np.asarray(array, np.float64) for array in (gyro, accel)]
    if stamps.ndim != 1 or any(array.shape != (len(stamps), 3) for array in values):
        shapes = ", ".join(str(array.shape) for array in (stamps, *values))
        raise DataError(f"IMU stamps, gyro and accel must be (N,), (N, 3), (N, 3), got {shapes}")
    if len(stamps) == 0:
        raise DataError("no IMU samples; a run needs them")
    return ImuData(_nanoseconds(stamps, "imu_stamps_ns"), *values)


def _nanoseconds(stamps: NDArray[np.generic], what: str) -> IntArray:
    """Stamps as int64; floating-point ones are refused, because seconds look like them."""
    if not np.issubdtype(stamps.dtype, np.integer):
        raise DataError(f"{what} must be whole nanoseconds (int64), got {stamps.dtype}")
    return stamps.astype(np.int64)


def _streams(
    name: str, rig: Rig, stamps: NDArray[np.generic], images: Sequence[Sequence[Image | None]]
) -> list[_ImagesOfCamera]:
    """The images of each camera, without those that are None."""
    stamps_ns = _nanoseconds(stamps, "image_stamps_ns")
    if stamps_ns.ndim != 1 or np.any(np.diff(stamps_ns) <= 0):
        raise DataError(f"{name}: image_stamps_ns must be (F,) and increase")
    counts = [len(of_camera) for of_camera in images]
    if counts != [len(stamps_ns)] * len(rig.cameras):
        raise DataError(
            f"{name}: expected {len(stamps_ns)} images for each of {len(rig.cameras)} cameras, "
            f"got {counts}"
        )
    streams = []
    for index, (mounted, of_camera) in enumerate(zip(rig.cameras, images, strict=True)):
        there = [k for k, image in enumerate(of_camera) if image is not None]
        found = [np.asarray(of_camera[k]) for k in there]
        for k, image in zip(there, found, strict=True):
            if image.ndim != 2 or image.dtype != np.uint8:
                raise DataError(
                    f"{name}: image {k} of camera {index} must be (height, width) uint8, got "
                    f"{image.shape} {image.dtype}"
                )
        streams.append(_ImagesOfCamera(mounted.name or f"cam{index}", stamps_ns[there], found))
    return streams


@dataclass(eq=False)
class _ImagesOfCamera:
    """The images of one camera in memory, an `ImageStream`."""

    name: str
    stamps_ns: IntArray
    images: Sequence[Image]

    def read(self, index: int) -> Image | Fault:
        """One image."""
        return self.images[index]

    def missing(self, index: int) -> Fault | None:
        """None is missing."""
        return None

    def where(self, index: int) -> str:
        """The place of one image, for messages."""
        return f"{self.name}: image at {self.stamps_ns[index]}"


@dataclass(eq=False)
class _DepthInMemory:
    """Depth images in memory, a `DepthStream`."""

    name: str
    stamps_ns: IntArray
    images: Sequence[Metres]
    finish: DepthFinish

    def read(self, index: int) -> Metres | Fault:
        """One image, without what is out of range."""
        return self.finish(self.images[index], f"{self.name}: image at {self.stamps_ns[index]}")

    def missing(self, index: int) -> Fault | None:
        """None is missing."""
        return None


class _ImagesInMemory(ImageSequence):
    """Images in memory."""

    format: ClassVar[str] = "arrays"

    def __init__(
        self,
        name: str,
        rig: Rig,
        streams: Sequence[_ImagesOfCamera],
        imu: ImuArrays | None,
        options: ReaderOptions,
        truth: Callable[[], Trajectory] | None,
        initial_state: NavState | None,
        depth: _DepthInMemory | None,
    ) -> None:
        super().__init__(name, rig, streams, imu, options, truth, depth=depth)
        self._start = initial_state

    def initial_state(self) -> NavState | None:
        """The known state at the start, if one was given."""
        return self._start


class _FeaturesInMemory(RecordedSequence):
    """Feature tracks in memory."""

    format: ClassVar[str] = "arrays"
    content: ClassVar[Literal["images", "tracks"]] = "tracks"

    def __init__(
        self,
        name: str,
        rig: Rig,
        features: Sequence[FeatureFrame],
        imu: ImuArrays | None,
        options: ReaderOptions,
        truth: Callable[[], Trajectory] | None,
        initial_state: NavState | None,
    ) -> None:
        rig = replace(rig, has_imu=rig.has_imu and imu is not None)
        super().__init__(name, rig, options, truth)
        self._features = list(features)
        self._stamps_ns = np.array([frame.stamp_ns for frame in self._features], np.int64)
        self._imu = imu
        self._start = initial_state
        if len(self._features) == 0 or np.any(np.diff(self._stamps_ns) <= 0):
            raise DataError(f"{name}: features need at least one frame, and times that increase")
        for frame in self._features:
            if len(frame.cameras) != len(rig.cameras):
                raise DataError(
                    f"{name}: the frame at {frame.stamp_ns} has features of {len(frame.cameras)} "
                    f"cameras, the rig has {len(rig.cameras)}"
                )

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """The frames as they were given."""
        for k in np.flatnonzero(self.within(self._stamps_ns, start_ns, end_ns)):
            yield self._features[k]

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on."""
        return iter(()) if self._imu is None else self._imu.blocks(self.diagnostics, after_ns)

    def measure(self) -> SequenceInfo:
        """Count frames and IMU samples."""
        stamps = self._stamps_ns
        samples = 0 if self._imu is None else self._imu.count()
        return self.holding(len(stamps), int(stamps[0]), int(stamps[-1]), samples)

    def initial_state(self) -> NavState | None:
        """The known state at the start, if one was given."""
        return self._start
