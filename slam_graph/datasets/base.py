# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The protocol that every recorded sequence fulfils."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.sensors.measurements import Packet
from slam_graph.sensors.rig import Rig


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
