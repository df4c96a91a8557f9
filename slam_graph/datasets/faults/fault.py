# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The base class of faults, and their registry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.plugins import Registry
from slam_graph.settings import Settings

if TYPE_CHECKING:
    from slam_graph.datasets.sequence import FrameStream
    from slam_graph.diagnostics import Diagnostics
    from slam_graph.geometry import Trajectory
    from slam_graph.sensors import ImuData, Rig


@dataclass(frozen=True)
class Surroundings:
    """What a fault knows of the recording that it is put into.

    Attributes:
        rig: calibrated sensors.
        start_ns: time of the first frame.
        diagnostics: where faults that a reader recognises are counted.
    """

    rig: Rig
    start_ns: int
    diagnostics: Diagnostics


class Fault(Settings):
    """A fault: what it does to frames, IMU samples and ground truth; here, nothing.

    Attributes:
        fits_masks: whether masks of the recording are still those of what images show.
    """

    fits_masks: ClassVar[bool] = True

    at_s: float = Field(6.0, ge=0.0, le=1e6)
    """When it begins, in seconds after the first frame."""

    duration_s: float = Field(1.0, gt=0.0, le=1e6)
    """How long it lasts."""

    seed: int = Field(0, ge=0)
    """Of what is random in it."""

    def require(self, around: Surroundings) -> None:
        """Refuse a recording that cannot have this fault.

        Raises:
            DataError: naming what it lacks.
        """

    def frames(self, frames: FrameStream, around: Surroundings) -> FrameStream:
        """The frames with the fault. Frames out of order are left out later."""
        return frames

    def imu(self, blocks: Iterator[ImuData], around: Surroundings) -> Iterator[ImuData]:
        """The IMU samples with the fault, in the order in which they are recorded."""
        return blocks

    def truth(self, truth: Trajectory, around: Surroundings) -> Trajectory:
        """The ground truth, where the fault changes the time of what is recorded."""
        return truth

    def stamped(self, stamps_ns: IntArray, around: Surroundings) -> IntArray:
        """The stamps (N,) that what is recorded at these times gets."""
        return stamps_ns

    def recorded(self, stamps_ns: IntArray, around: Surroundings) -> IntArray:
        """The stamps (N,) of what is recorded, of the stamps that it has got; undoes `stamped`."""
        return stamps_ns

    def begin_ns(self, around: Surroundings) -> int:
        """When it begins, as a stamp."""
        return around.start_ns + round(self.at_s * 1e9)

    def end_ns(self, around: Surroundings) -> int:
        """When it ends, as a stamp; that of the end is not in it."""
        return self.begin_ns(around) + round(self.duration_s * 1e9)

    def covers(self, stamps_ns: IntArray, around: Surroundings) -> BoolArray:
        """Which of these times (N,) it covers."""
        inside: BoolArray = (stamps_ns >= self.begin_ns(around)) & (stamps_ns < self.end_ns(around))
        return inside

    def rng(self) -> np.random.Generator:
        """Random numbers, the same ones whenever the recording is read."""
        return np.random.default_rng(self.seed)


FAULTS: Registry[type[Fault]] = Registry(
    "slam_graph.faults",
    "fault",
    accepts=lambda part: isinstance(part, type) and issubclass(part, Fault),
)
"""Faults by name."""
