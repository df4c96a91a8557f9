# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A change of the clock of the IMU against that of the cameras, and samples without it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from slam_graph.sensors import FeatureFrame, ImuData


@dataclass(frozen=True, slots=True)
class ClockChange:
    """A change of the clock of the IMU against that of the cameras.

    Attributes:
        since_ns: stamp of the first IMU sample on the new clock, with earlier changes corrected.
        good_ns: time on the clock of the IMU until which states are not affected.
        frames_ns: time on the clock of the cameras from which frames are of the new clock.
        shift_s: how much later the new clock is, s.
        sigma_s: standard deviation of that.
    """

    since_ns: int
    good_ns: int
    frames_ns: int
    shift_s: float
    sigma_s: float

    @property
    def message(self) -> str:
        """What has happened."""
        later = "later" if self.shift_s > 0.0 else "earlier"
        sigma_ms = 1e3 * self.sigma_s
        sigma = f" ± {sigma_ms:.1f}" if sigma_ms >= 0.05 else ""  # a gap of even stamps has none
        return (
            f"the clock of the IMU is {1e3 * abs(self.shift_s):.1f}{sigma} ms "
            f"{later} against the cameras since {self.since_ns} ns"
        )

    def corrected(self, imu: ImuData) -> ImuData:
        """Samples on the old clock; those that would not be later than the one before are left out.

        Args:
            imu: samples as they were recorded, or corrected by the changes before this one.
        """
        new = imu.stamps_ns >= self.since_ns
        if not new.any():
            return imu
        stamps = imu.stamps_ns - new * round(self.shift_s * 1e9)
        latest = np.maximum.accumulate(np.append(np.iinfo(np.int64).min, stamps))[:-1]
        kept = stamps > latest
        return ImuData(stamps[kept], imu.gyro[kept], imu.accel[kept])

    def after(self, frames: Iterable[FeatureFrame]) -> list[FeatureFrame]:
        """Those of some frames that were taken since."""
        return [frame for frame in frames if frame.stamp_ns >= self.frames_ns]


@dataclass(frozen=True, slots=True)
class ClockChanges:
    """The changes of the clock in the course of a run, in their order.

    Attributes:
        changes: those that are corrected so far.
    """

    changes: tuple[ClockChange, ...] = ()

    def __len__(self) -> int:
        return len(self.changes)

    def and_then(self, change: ClockChange) -> ClockChanges:
        """These and another one."""
        return ClockChanges((*self.changes, change))

    def corrected(self, imu: ImuData) -> ImuData:
        """Samples as they were recorded, on the clock of the beginning."""
        for change in self.changes:
            imu = change.corrected(imu)
        return imu

    def _shifts_s(self) -> Iterator[float]:
        shift_s = 0.0
        yield shift_s
        for change in self.changes:
            shift_s += change.shift_s
            yield shift_s

    @property
    def shift_s(self) -> float:
        """How much later the clock is now than it was at the beginning, s."""
        return sum(change.shift_s for change in self.changes)

    @property
    def latest_s(self) -> float:
        """The most by which it was later than at the beginning, at least 0 s."""
        return max(self._shifts_s())

    @property
    def earliest_s(self) -> float:
        """The same for earlier: at most 0 s."""
        return min(self._shifts_s())
