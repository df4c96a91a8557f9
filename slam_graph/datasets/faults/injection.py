# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A recording with faults: what its reader gives, changed by one fault after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np

from slam_graph.datasets.faults import clock_faults, frame_faults, imu_faults  # noqa: F401
from slam_graph.datasets.faults.fault import FAULTS, Fault, Surroundings
from slam_graph.datasets.object_sources import LabelsOverTime
from slam_graph.datasets.sequence import (
    FrameStream,
    ReaderOptions,
    RecordedSequence,
    SequenceInfo,
)
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.datasets.streams.mask_images import LabelImage
from slam_graph.errors import ConfigError, DataError
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import AidingData, ImuData
from slam_graph.settings import ConfigTree


def inject(recording: RecordedSequence, faults: Iterable[str | Fault]) -> RecordedSequence:
    """A recording with faults in it.

        sg.run(inject(sg.simulate(), ["imu_missing:at_s=8,duration_s=1"]))

    Args:
        recording: as it was read.
        faults: in the order in which they happen to it; texts as for `fault_from`.

    Raises:
        ConfigError: if a text names no fault, or a wrong setting of it.
        DataError: if a fault is of a camera that is not there, or begins after the recording's end.
    """
    found = [fault if isinstance(fault, Fault) else fault_from(fault) for fault in faults]
    return FaultySequence(recording, found) if found else recording


def fault_from(text: str) -> Fault:
    """The fault that a text means: `NAME` or `NAME:setting=value,setting=value`.

    Raises:
        ConfigError: if it names no fault, or a wrong setting of it.
    """
    name, _, settings = text.partition(":")
    where = f"fault '{text}'"
    tree = ConfigTree(where={(): where})
    for part in settings.split(",") if settings else ():
        key, separator, value = (piece.strip() for piece in part.partition("="))
        if not key or not separator or not value:
            raise ConfigError(f"{where}: expected NAME:setting=value,setting=value")
        if key in tree.values:
            raise ConfigError(f"{where}: {key} is there twice")
        tree.values[key] = None if value == "null" else value
    return tree.validated(FAULTS[name])


class FaultySequence(RecordedSequence):
    """A recording with faults.

    Args:
        recording: as it was read.
        faults: in the order in which they happen to it.

    Attributes:
        recording: as it was read.
        faults: in the order in which they happen to it.
    """

    format: ClassVar[str] = "faulty"

    def __init__(self, recording: RecordedSequence, faults: Iterable[Fault]) -> None:
        super().__init__(recording.name, recording.rig, ReaderOptions())
        self.diagnostics = recording.diagnostics
        self.recording = recording
        self.faults = list(faults)
        info = recording.info()
        self._around = Surroundings(recording.rig, info.start_ns, recording.diagnostics)
        end = np.array([info.end_ns], np.int64)
        for fault in self.faults:
            fault.require(self._around)
            if fault.begin_ns(self._around) > end[0]:
                raise DataError(
                    f"{type(fault).__name__} with at_s={fault.at_s:g} never begins: the recording "
                    f"has {(end[0] - info.start_ns) * 1e-9:.1f} s; choose an earlier time"
                )
            end = fault.stamped(end, self._around)
        self._end_ns = int(end[0])

    @property
    def has_groundtruth(self) -> bool:
        """Whether `groundtruth()` gives one."""
        return self.recording.has_groundtruth

    def measure(self) -> SequenceInfo:
        """What the recording holds without its faults, and when it ends with them."""
        return replace(self.recording.info(), end_ns=self._end_ns)

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """The frames with their faults; those whose stamps do not increase are left out."""
        latest: int | None = None
        stream = self.recording.frames()
        for fault in self.faults:
            stream = fault.frames(stream, self._around)
        with closing(stream):
            for frame in stream:
                if latest is not None and frame.stamp_ns <= latest:
                    what = f"{self.name}: frame at {frame.stamp_ns} dropped"
                    late = f"{what}, not later than the one before"
                    self.diagnostics.warn("camera_out_of_order", late)
                    continue
                latest = frame.stamp_ns
                if end_ns is not None and frame.stamp_ns > end_ns:
                    return
                if start_ns is None or frame.stamp_ns >= start_ns:
                    yield frame

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The IMU samples with their faults, cleaned as a reader does."""
        blocks = self.recording.imu_blocks()
        for fault in self.faults:
            blocks = fault.imu(blocks, self._around)
        named = ((partial(_sample, block), block) for block in blocks)
        return clean_blocks(named, self.diagnostics, after_ns)

    def read_aiding(self) -> AidingData:
        """Fixes and odometry of the recording, without faults."""
        return self.recording.aiding

    def groundtruth(self) -> Trajectory | None:
        """The true trajectory at the times that the recording says."""
        truth = self.recording.groundtruth()
        for fault in self.faults:
            truth = None if truth is None else fault.truth(truth, self._around)
        return truth

    def object_truth(self) -> dict[int, Trajectory]:
        """True poses of moving objects at the times that the recording says."""
        truth = self.recording.object_truth()
        for fault in self.faults:
            truth = {number: fault.truth(path, self._around) for number, path in truth.items()}
        return truth

    @property
    def masks(self) -> int:
        """Number of masks of the recording."""
        return self.recording.masks

    @property
    def mask_classes(self) -> dict[int, str]:
        """Name of the class by label."""
        return self.recording.mask_classes

    def labels_over_time(self) -> LabelsOverTime | None:
        """What gives tracks the labels of the masks; a fault does not change these."""
        labels = super().labels_over_time()
        changed = [type(fault).__name__ for fault in self.faults if not fault.fits_masks]
        if labels is not None and changed:
            what = f"{self.name}: masks are those of the images without {', '.join(changed)}"
            self.diagnostics.warn("masks_without_fault", what)
        return labels

    def label_image(self, stamp_ns: int) -> LabelImage | None:
        """The label image that the recording has for a frame, whatever stamp it has now."""
        stamp = np.array([stamp_ns], np.int64)
        for fault in reversed(self.faults):
            stamp = fault.recorded(stamp, self._around)
        return self.recording.label_image(int(stamp[0]))

    def initial_state(self) -> NavState | None:
        """The state that comes with the recording."""
        return self.recording.initial_state()


def _sample(block: ImuData, index: int) -> str:
    """The place of a sample of a block, for messages."""
    return f"IMU sample of {block.stamps_ns[index]}"
