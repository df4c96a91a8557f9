# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Sequences: the protocol of all recordings, and the base class of their readers.

A reader gives frames and blocks of IMU samples; `RecordedSequence` joins them to packets, each a
frame with the samples that lead up to it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.datasets.groundtruth import (
    check_groundtruth,
    read_groundtruth,
    resolve_groundtruth,
)
from slam_graph.datasets.object_sources import ObjectSources
from slam_graph.datasets.packets import packetize, packetize_alone
from slam_graph.datasets.streams.aiding_files import read_aiding
from slam_graph.datasets.streams.aiding_packets import with_aiding
from slam_graph.diagnostics import Diagnostics
from slam_graph.display import Displayed
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import AidingData, CameraFrame, FeatureFrame, ImuData, Packet, Rig

_HISTORY_NS = 1_000_000_000
"""How much of the IMU and the odometry before a chosen start the first packet carries."""
_ASSUMED_MOUNTING = (
    "where the cameras are mounted is unknown and no IMU tells it: the body is taken for the first "
    "camera, and lever arms, odometry and known poses are taken to be given in its frame"
)


FrameStream = Generator[CameraFrame | FeatureFrame, None, None]


@dataclass(frozen=True)
class SequenceInfo:
    """What a sequence holds.

    Attributes:
        name: short name, used for the folder of results (e.g. ``MH_01_easy_17s``).
        format: name of the format in `DATASETS`.
        content: whether frames carry images or feature tracks.
        cameras: number of cameras in use.
        frames: number of frames (a stereo pair is one frame).
        start_ns, end_ns: times of the first and the last frame.
        imu_samples: number of IMU samples.
        has_groundtruth: whether `groundtruth()` gives one.
        has_imu: whether there is an IMU, and it is to be used; the same as `Rig.has_imu`.
        has_depth: whether depth is measured; the same as that `Rig.depth` is not None.
        depth_frames: number of frames with a depth image; 0 for tracks.
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
    has_imu: bool = True
    has_depth: bool = False
    depth_frames: int = 0


@runtime_checkable
class Sequence(Protocol):
    """A recording of cameras, an IMU or depth, that can be streamed from its start.

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


@dataclass(frozen=True)
class ReaderOptions:
    """What a reader is asked for besides the path of the recording.

    Attributes:
        cameras: number of cameras to use, the first ones; None for all.
        calibration: Kalibr camera chain to use instead of the recording's own calibration.
        groundtruth: file or folder to use instead of the recording's own ground truth.
        sources: where each sensor is, in formats that leave it open.
        diagnostics: where faults are counted.
        imu: whether the IMU is used; False reads the recording as if it had none.
        aiding: where ``gnss`` and ``odometry`` are, files or topics, if not where they are looked
            for.
    """

    cameras: int | None = None
    calibration: Path | None = None
    groundtruth: Path | None = None
    sources: Mapping[str, str] = field(default_factory=dict)
    diagnostics: Diagnostics = field(default_factory=Diagnostics)
    imu: bool = True
    aiding: Mapping[str, str] = field(default_factory=dict)

    def select(self, rig: Rig) -> Rig:
        """The rig with the cameras that are to be used.

        Raises:
            DataError: if it has fewer.
        """
        return rig if self.cameras is None else rig.select(self.cameras)


class RecordedSequence(ObjectSources, Displayed, ABC):
    """Base class of readers: the part of the `Sequence` protocol that is the same in all formats.

    A reader is a subclass whose constructor takes a path and `ReaderOptions`.

    Args:
        name: of the recording.
        rig: its calibrated sensors, with the cameras that are used.
        options: what was asked for; `groundtruth`, `diagnostics` and `imu` are used here.
        own_groundtruth: the recording's own ground truth: a file, or a function that gives it.

    Raises:
        DataError: if there is no ground truth where one was named.

    Attributes:
        format: name of the format in `DATASETS`.
        content: whether frames carry images or feature tracks.
        name: of the recording.
        rig: its calibrated sensors.
        named_aiding: where ``gnss`` and ``odometry`` are, as far as it was said.
        groundtruth_path: the file that ground truth is read from; None where there is none.
        diagnostics: where faults are counted.
    """

    format: ClassVar[str]
    content: ClassVar[Literal["images", "tracks"]]
    rig: Rig
    diagnostics: Diagnostics

    def __init__(
        self,
        name: str,
        rig: Rig,
        options: ReaderOptions,
        own_groundtruth: Path | Callable[[], Trajectory] | None = None,
    ) -> None:
        self.name = name
        self.rig = rig if options.imu and rig.has_imu else rig.without_imu()
        self.groundtruth_path: Path | None = None
        self.named_aiding = dict(options.aiding)
        self.diagnostics = options.diagnostics
        if not self.rig.has_imu and not all(mounted.rotation_known for mounted in rig.cameras):
            self.diagnostics.warn("mounting_assumed", f"{name}: {_ASSUMED_MOUNTING}")
        rolling = [c.name for c in rig.cameras if c.rolling_shutter and not c.readout_s]
        if rolling:
            what = f"{name}: {', '.join(rolling)}: rows are taken as exposed at one time"
            self.diagnostics.warn("rolling_shutter", f"{what}, as readout_time is not given")
        source = options.groundtruth or own_groundtruth
        self._truth = None if source is None or isinstance(source, Path) else source
        if isinstance(source, Path):
            self.groundtruth_path = resolve_groundtruth(source)
            check_groundtruth(self.groundtruth_path)

    def __repr__(self) -> str:
        info = self.info()
        return (
            f"{type(self).__name__}({info.name}: {info.frames} frames of {info.content}, "
            f"{info.cameras} camera{'' if info.cameras == 1 else 's'}, "
            f"{(info.end_ns - info.start_ns) * 1e-9:.1f} s)"
        )

    def _facts(self) -> dict[str, object]:
        info = self.info()
        seconds = (info.end_ns - info.start_ns) * 1e-9
        lenses = ", ".join(
            f"{c.name or 'camera'} {c.camera.width} x {c.camera.height} {c.camera.distortion}"
            for c in self.rig.cameras
        )
        return {
            "name": info.name,
            "format": f"{info.format}, {info.content}",
            "frames": f"{info.frames} in {seconds:.2f} s"
            + (f" ({(info.frames - 1) / seconds:.1f} Hz)" if seconds > 0 else ""),
            "cameras": lenses or None,
            "IMU": f"{info.imu_samples} samples" if self.has_imu else "none",
            "depth": self._depth_facts(),
            "ground truth": "yes" if info.has_groundtruth else "none",
        }

    def _depth_facts(self) -> str | None:
        if self.rig.depth is None:
            return None
        of = self.rig.cameras[self.rig.depth.camera].name
        frames = f"in {self.info().depth_frames} frames, " if self.content == "images" else ""
        return f"{frames}of {of or 'the camera'}"

    def plot(self) -> Any:
        """IMU and true path (if there is one) of the whole recording, as a figure."""
        imu = self.imu() if self.has_imu else None
        truth = self.groundtruth() if self.has_groundtruth else None
        return self._drawn_by("notebook_figures").recording_figure(self.name, imu, truth)

    def _sketch(self) -> Any:
        if not self.has_groundtruth:
            return None
        return self._drawn_by("notebook_figures").path_figure({"ground truth": self.groundtruth()})

    @abstractmethod
    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """The frames within [start_ns, end_ns], with strictly increasing stamps."""

    @abstractmethod
    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The cleaned IMU stream from `after_ns` on, in blocks, with strictly increasing stamps."""

    @abstractmethod
    def measure(self) -> SequenceInfo:
        """Count what the files hold; this may read through them once.

        A format gives its counts to `holding`.
        """

    def holding(self, frames: int, start_ns: int, end_ns: int, imu_samples: int) -> SequenceInfo:
        """What the sequence holds, by its counts.

        Args:
            frames: number of frames.
            start_ns: time of the first frame; of the first IMU sample if there are no frames.
            end_ns: time of the last frame; of the last IMU sample if there are no frames.
            imu_samples: number of IMU samples in the file, before faulty ones are dropped.
        """
        return SequenceInfo(
            name=self.name,
            format=self.format,
            content=self.content,
            cameras=len(self.rig.cameras),
            frames=frames,
            start_ns=start_ns,
            end_ns=end_ns,
            imu_samples=imu_samples if self.has_imu else 0,
            has_groundtruth=self.has_groundtruth,
            has_imu=self.has_imu,
            has_depth=self.rig.depth is not None,
            depth_frames=self.depth_frames(),
        )

    def depth_frames(self) -> int:
        """Number of frames with a depth image."""
        return 0

    @cached_property
    def _info(self) -> SequenceInfo:
        return self.measure()

    @staticmethod
    def within(stamps_ns: IntArray, start_ns: int | None, end_ns: int | None) -> BoolArray:
        """Which times (N,) lie in a range with optional ends, both included."""
        inside = np.ones(len(stamps_ns), bool)
        if start_ns is not None:
            inside &= stamps_ns >= start_ns
        if end_ns is not None:
            inside &= stamps_ns <= end_ns
        return inside

    @property
    def has_imu(self) -> bool:
        """Whether it has an IMU that is used; without one packets hold frames only."""
        return self.rig.has_imu

    @property
    def has_groundtruth(self) -> bool:
        """Whether `groundtruth()` gives one."""
        return self.groundtruth_path is not None or self._truth is not None

    def info(self) -> SequenceInfo:
        """What the sequence holds; without any frames the times are those of the IMU."""
        return self._info

    def packets(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Packet]:
        """Frames in the order of time, each with the IMU samples that lead up to it.

        Where the clock of the IMU is ahead by the rig's time offset, they lead up to the time of
        the frame on that clock; of a rolling shutter, to that of its last row.

        Args:
            start_ns: first frame time to deliver; the first packet then carries the IMU samples of
                up to one second before it. Without it, it carries all samples from the start.
            end_ns: last frame time to deliver.
        """
        frames, rig = self.frames(start_ns, end_ns), self.rig
        begin_ns = after_ns = None  # on the clock of the states
        if start_ns is not None:
            begin_ns = start_ns + round(rig.pose_offset_s * 1e9)
            after_ns = begin_ns - _HISTORY_NS
        packets = packetize_alone(frames)
        if self.has_imu:
            packets = packetize(
                frames,
                self.imu_blocks(after_ns),
                self.diagnostics,
                None if start_ns is None else _HISTORY_NS,
                round(rig.end_offset_s * 1e9),
            )
        return with_aiding(packets, self._aiding_from(begin_ns), rig)

    def _aiding_from(self, begin_ns: int | None) -> AidingData:
        """What follows a time, with the odometry that leads up to it, as it is interpolated."""
        later = self.aiding.within(begin_ns, None)
        if begin_ns is None:
            return later
        led = self.aiding.within(begin_ns - _HISTORY_NS, None)
        return later.with_odometry(
            led.odometry_stamps_ns, led.odometry_positions, led.odometry_quaternions
        )

    @cached_property
    def aiding(self) -> AidingData:
        """Position fixes and odometry of the whole recording."""
        return self.read_aiding()

    def read_aiding(self) -> AidingData:
        """Read them; here those in files that were named, or are beside the recording."""
        path = getattr(self, "path", None)
        folders = []
        if isinstance(path, Path):
            folder = path if path.is_dir() else path.parent
            folders = [folder, folder.parent] if folder.name == "mav0" else [folder]
        return read_aiding(folders, self.named_aiding, self.diagnostics)

    def imu(self) -> ImuData:
        """All IMU samples at once; none without an IMU."""
        if not self.has_imu:
            return ImuData.empty()
        return ImuData.concatenate(list(self.imu_blocks()))

    def groundtruth(self) -> Trajectory | None:
        """The true trajectory of the body, where the recording has one."""
        if self.groundtruth_path is not None:
            return read_groundtruth(self.groundtruth_path, self.diagnostics)
        return None if self._truth is None else self._truth()

    def initial_state(self) -> NavState | None:
        """The state at the start that comes with the data; None unless a format has one."""
        return None
