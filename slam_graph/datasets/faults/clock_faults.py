# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of all sensors at once: a clock that jumps, nothing recorded, a platform carried away."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.datasets.faults.fault import FAULTS, Fault, Surroundings
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData

if TYPE_CHECKING:
    from slam_graph.datasets.sequence import FrameStream
    from slam_graph.geometry import Trajectory


class _Rewritten(Fault):
    """A fault that gives what is recorded other stamps, or takes it away."""

    def kept(self, stamps_ns: IntArray, around: Surroundings) -> BoolArray:
        """What is still there, of times (N,)."""
        return np.ones(len(stamps_ns), bool)

    def frames(self, frames: FrameStream, around: Surroundings) -> FrameStream:
        """The frames that are left, with their stamps."""
        for frame in frames:
            stamp = np.array([frame.stamp_ns], np.int64)
            if self.kept(stamp, around)[0]:
                yield restamped(frame, int(self.stamped(stamp, around)[0]))

    def imu(self, blocks: Iterator[ImuData], around: Surroundings) -> Iterator[ImuData]:
        """The samples that are left, with their stamps."""
        for block in blocks:
            rows = self.kept(block.stamps_ns, around)
            stamps = self.stamped(block.stamps_ns[rows], around)
            yield ImuData(stamps, block.gyro[rows], block.accel[rows])

    def truth(self, truth: Trajectory, around: Surroundings) -> Trajectory:
        """The truth at the times that things have now."""
        left = truth.select(self.kept(truth.stamps_ns, around))
        stamps = self.stamped(left.stamps_ns, around)
        later = np.ones(len(stamps), bool)
        later[1:] = stamps[1:] > np.maximum.accumulate(stamps)[:-1]
        return replace(left.select(later), stamps_ns=stamps[later])


def restamped(frame: CameraFrame | FeatureFrame, stamp_ns: int) -> CameraFrame | FeatureFrame:
    """The same frame at another time."""
    if isinstance(frame, FeatureFrame) or frame.depth_ns is None:
        return replace(frame, stamp_ns=stamp_ns)
    return replace(frame, stamp_ns=stamp_ns, depth_ns=frame.depth_ns + stamp_ns - frame.stamp_ns)


@FAULTS.register("clock_jump")
class ClockJump(_Rewritten):
    """The clock of all sensors jumps, and stays so."""

    by_s: float = Field(1.0, ge=-1e5, le=1e5)
    """How far; back if negative. What then seems to be older than what was there is left out."""

    def stamped(self, stamps_ns: IntArray, around: Surroundings) -> IntArray:
        """Stamps, those from the jump on by the other clock."""
        late = stamps_ns >= self.begin_ns(around)
        return stamps_ns + late * round(self.by_s * 1e9)

    def recorded(self, stamps_ns: IntArray, around: Surroundings) -> IntArray:
        """Stamps by the clock that does not jump."""
        by_ns = round(self.by_s * 1e9)
        late = stamps_ns >= self.begin_ns(around) + max(by_ns, 0)
        return stamps_ns - late * by_ns


@FAULTS.register("all_missing")
class AllMissing(_Rewritten):
    """Neither frames nor samples of the IMU."""

    duration_s: float = Field(3.0, gt=0.0)
    """How long it lasts."""

    def kept(self, stamps_ns: IntArray, around: Surroundings) -> BoolArray:
        """What is outside."""
        return ~self.covers(stamps_ns, around)

    def truth(self, truth: Trajectory, around: Surroundings) -> Trajectory:
        """All of it: the platform flies on."""
        return truth


@FAULTS.register("kidnapped")
class Kidnapped(AllMissing):
    """The platform is somewhere else at once: a part of the flight is cut out, time as well."""

    def stamped(self, stamps_ns: IntArray, around: Surroundings) -> IntArray:
        """Stamps, without the time that is cut out."""
        late = stamps_ns >= self.end_ns(around)
        return stamps_ns - late * round(self.duration_s * 1e9)

    def recorded(self, stamps_ns: IntArray, around: Surroundings) -> IntArray:
        """Stamps with the time that is cut out."""
        late = stamps_ns >= self.begin_ns(around)
        return stamps_ns + late * round(self.duration_s * 1e9)

    def truth(self, truth: Trajectory, around: Surroundings) -> Trajectory:
        """The truth without what is cut out."""
        return _Rewritten.truth(self, truth, around)
