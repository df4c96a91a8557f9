# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What all recorded formats share: they give frames and IMU blocks, this makes the sequence.

Frames and IMU samples brought together: the packets that a sequence delivers.

The protocol that every recorded sequence fulfils.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.groundtruth import (
    check_groundtruth,
    read_groundtruth,
    resolve_groundtruth,
)
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, ImuData, Packet
from slam_graph.sensors.rig import Rig

HISTORY_NS = 1_000_000_000
"""How much of the IMU before a chosen start the first packet carries."""

FrameStream = Generator[CameraFrame | FeatureFrame, None, None]


class ImuFeed:
    """Hands out a stream of IMU blocks in pieces that end at given times.

    Attributes:
        latest_ns: stamp of the last sample handed out, None before the first.
    """

    def __init__(self, blocks: Iterator[ImuData]) -> None:
        self.latest_ns: int | None = None
        self._blocks = blocks
        self._buffer = ImuData.empty()

    def up_to(self, stamp_ns: int) -> ImuData:
        """All samples not yet handed out, up to and including the first at or after `stamp_ns`."""
        if self.latest_ns is not None and self.latest_ns >= stamp_ns:
            return ImuData.empty()
        pending = [self._buffer]
        while not len(pending[-1]) or pending[-1].stamps_ns[-1] < stamp_ns:
            block = next(self._blocks, None)
            if block is None:
                break
            pending.append(block)
        data = ImuData.concatenate(pending) if len(pending) > 1 else self._buffer
        end = int(np.searchsorted(data.stamps_ns, stamp_ns, side="left")) + 1
        self._buffer = data[end:]
        if len(data):
            self.latest_ns = int(data.stamps_ns[min(end, len(data)) - 1])
        return data[:end]


def packetize(
    frames: FrameStream,
    blocks: Iterator[ImuData],
    diagnostics: Diagnostics,
    history_ns: int | None = None,
    ahead_ns: int = 0,
) -> Iterator[Packet]:
    """Join frames with the IMU samples that lead up to them.

    A frame without any IMU sample since the frame before it (or, for the first one, at or before
    its time) is delivered all the same and counted as `frame_without_imu`.

    Args:
        frames: with strictly increasing stamps; closed at the end.
        blocks: of the IMU stream, with strictly increasing stamps.
        diagnostics: where faults are counted.
        history_ns: how much of the IMU before the first frame its packet carries; None for all.
        ahead_ns: how far the clock of the IMU is ahead of that of the frames.
    """
    feed = ImuFeed(blocks)
    previous_ns: int | None = None
    with closing(frames):
        for frame in frames:
            held_ns, now_ns = feed.latest_ns, frame.stamp_ns + ahead_ns
            imu = feed.up_to(now_ns)
            if previous_ns is None and history_ns is not None:
                imu = imu[int(np.searchsorted(imu.stamps_ns, now_ns - history_ns)) :]
            held = (
                held_ns is not None and previous_ns is not None and previous_ns < held_ns <= now_ns
            )
            if not held and not (len(imu) and imu.stamps_ns[0] <= now_ns):
                diagnostics.warn(
                    "frame_without_imu", f"frame at {frame.stamp_ns} has no IMU samples"
                )
            previous_ns = now_ns
            yield Packet(imu, frame)


def packetize_alone(frames: FrameStream) -> Iterator[Packet]:
    """Packets of a recording without an IMU; the frames are closed at the end."""
    with closing(frames):
        for frame in frames:
            yield Packet(ImuData.empty(), frame)


@dataclass(frozen=True)
class SequenceInfo:
    """What a sequence holds, without reading it whole.

    Attributes:
        name: short name, used for the folder of results (e.g. ``MH_01_easy_17s``).
        format: name of the data set class in the registry.
        content: whether frames carry images or feature tracks.
        cameras: number of cameras.
        frames: number of frames (a stereo pair is one frame).
        start_ns, end_ns: times of the first and the last frame.
        imu_samples: number of IMU samples.
        has_groundtruth: whether `groundtruth()` gives one.
    """

    name: str
    format: str
    content: Literal["images", "tracks"]
    cameras: int
    frames: int
    start_ns: int
    end_ns: int
    imu_samples: int
    has_groundtruth: bool


@runtime_checkable
class Sequence(Protocol):
    """A recording of cameras and one IMU that can be streamed from its start.

    Opening one reads calibration and indices only; images and tracks are read as they are asked
    for, so memory does not grow with the length of the recording.
    """

    rig: Rig
    diagnostics: Diagnostics

    def info(self) -> SequenceInfo:
        """What the sequence holds."""
        ...

    def packets(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Packet]:
        """Frames in the order of time, each with the IMU samples that lead up to it.

        Args:
            start_ns: first frame time to deliver; the first packet then carries the IMU samples of
                up to one second before it.
            end_ns: last frame time to deliver.
        """
        ...

    def groundtruth(self) -> Trajectory | None:
        """The true trajectory of the body, where the recording has one."""
        ...

    def initial_state(self) -> NavState | None:
        """The state at the start that comes with the data (not from its ground truth), or None.

        Its covariance says how well it is known.
        """
        ...


@dataclass(frozen=True, slots=True)
class Extent:
    """How much a recording holds.

    Attributes:
        frames: number of frames.
        start_ns, end_ns: times of the first and the last frame; of the IMU if there are no frames.
        imu_samples: number of IMU samples in the file, before faulty ones are dropped.
    """

    frames: int
    start_ns: int
    end_ns: int
    imu_samples: int


class RecordedSequence(ABC):
    """A recording in files: the part of the `Sequence` protocol that does not depend on the format.

    Attributes:
        name: of the recording.
        rig: its calibrated sensors.
        has_imu: whether it has gyroscope and accelerometer; without them packets hold frames only.
        groundtruth_path: file or folder with the ground truth, or None.
        own_groundtruth: gives the one of formats that keep it among their data, where there is no
            file with it; None for all others.
        diagnostics: where faults are counted.
    """

    format: ClassVar[str]
    content: ClassVar[Literal["images", "tracks"]]
    has_imu: bool = True
    rig: Rig
    diagnostics: Diagnostics

    def __init__(
        self,
        name: str,
        rig: Rig,
        groundtruth_path: Path | None,
        diagnostics: Diagnostics | None,
    ) -> None:
        self.name = name
        self.rig = rig
        self.groundtruth_path: Path | None = None
        self.own_groundtruth: Callable[[], Trajectory] | None = None
        self.diagnostics = diagnostics if diagnostics is not None else Diagnostics()
        rolling = [mounted.name for mounted in rig.cameras if mounted.rolling_shutter]
        if rolling:
            what = f"{name}: {', '.join(rolling)}: rows are taken as exposed at one time"
            self.diagnostics.warn("rolling_shutter", f"{what}; expect errors in fast motion")
        if groundtruth_path is not None:
            self.groundtruth_path = resolve_groundtruth(groundtruth_path)
            check_groundtruth(self.groundtruth_path)

    @abstractmethod
    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """The frames within [start_ns, end_ns], with strictly increasing stamps."""

    @abstractmethod
    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on, in blocks, with strictly increasing stamps."""

    @abstractmethod
    def measure(self) -> Extent:
        """Count what the files hold; this may read through them once."""

    @cached_property
    def _extent(self) -> Extent:
        return self.measure()

    @property
    def has_groundtruth(self) -> bool:
        """Whether `groundtruth()` gives one."""
        return self.groundtruth_path is not None or self.own_groundtruth is not None

    def info(self) -> SequenceInfo:
        """What the sequence holds; without any frames the times are those of the IMU."""
        extent = self._extent
        return SequenceInfo(
            name=self.name,
            format=self.format,
            content=self.content,
            cameras=len(self.rig.cameras),
            frames=extent.frames,
            start_ns=extent.start_ns,
            end_ns=extent.end_ns,
            imu_samples=extent.imu_samples,
            has_groundtruth=self.has_groundtruth,
        )

    def packets(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Packet]:
        """Frames in the order of time, each with the IMU samples that lead up to it.

        Where the clock of the IMU is ahead by the rig's time offset, they lead up to the time of
        the frame on that clock.

        Args:
            start_ns: first frame time to deliver; the first packet then carries the IMU samples of
                up to one second before it. Without it, it carries all samples from the start.
            end_ns: last frame time to deliver.
        """
        if not self.has_imu:
            return packetize_alone(self.frames(start_ns, end_ns))
        after_ns = None if start_ns is None else start_ns - HISTORY_NS
        return packetize(
            self.frames(start_ns, end_ns),
            self.imu_blocks(after_ns),
            self.diagnostics,
            None if start_ns is None else HISTORY_NS,
            max(0, round(self.rig.cameras[0].time_offset_s * 1e9)),
        )

    def imu(self) -> ImuData:
        """All IMU samples at once."""
        return ImuData.concatenate(list(self.imu_blocks()))

    def groundtruth(self) -> Trajectory | None:
        """The true trajectory of the body, where the recording has one."""
        if self.groundtruth_path is not None:
            return read_groundtruth(self.groundtruth_path, self.diagnostics)
        return None if self.own_groundtruth is None else self.own_groundtruth()

    def initial_state(self) -> NavState | None:
        """The state at the start that comes with the data; None unless a format has one."""
        return None


def within(
    stamps_ns: NDArray[np.int64], start_ns: int | None, end_ns: int | None
) -> NDArray[np.bool_]:
    """Which times (N,) lie in a range with optional ends, both included."""
    inside = np.ones(len(stamps_ns), bool)
    if start_ns is not None:
        inside &= stamps_ns >= start_ns
    if end_ns is not None:
        inside &= stamps_ns <= end_ns
    return inside
