# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Has the clock of the IMU changed against that of the cameras, in the course of a run?

The rotations of the first camera over the last seconds are compared with the gyroscope
(`gyro_alignment.py`), as at the start. Once they agree with the calibrated offset, or another one
is known, what they contradict later is a change. The time of the change is the split of the
rotations into those that fit the old offset better and those that fit the new one (a likelihood
ratio: Page 1954).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.initialization.gyro_alignment import (
    GyroAlignment,
    Turns,
    align_gyroscope,
    offset_step,
    preference,
)
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData, RigCamera

_CLEAR = 30.0
"""Smallest margin of the minimum: the second best has a probability of exp(-30) of the best."""
_MAX_MISFIT = 30.0
"""Rotations that fit worse, in units of their information, are of something else than offsets."""
_KNOWN_SIGMA_S, _AGREES_SIGMAS = 5e-3, 3.0
"""An offset that is known to this, and agrees with the calibration within so many standard
deviations, confirms it."""
_SUSPECT_SIGMAS = 4.0
"""A linear look that shows more than this is followed by one over all offsets."""
_CHANGED_SIGMAS, _CHANGED_S, _CHANGED_SIGMA_S = 8.0, 8e-3, 4e-3
"""The clock has changed if the offset differs by so many standard deviations, by so much, and is
known to this. Good recordings show up to 3.2 standard deviations."""
_FEWEST_AFTER = 15
"""Fewest rotations after the change of which the new offset is taken."""
_AFTER_NS = 100_000_000
"""The new beginning keeps this far from the time of the change."""
_NEAR_NS = 1_000_000_000
"""A gap in the samples this near to the change is where it happened."""
_SAME_SIGMAS = 3.0
"""Such a gap is as long as the change if the two differ by fewer standard deviations."""


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
        return (
            f"the clock of the IMU is {1e3 * abs(self.shift_s):.1f} ± {1e3 * self.sigma_s:.1f} ms "
            f"{later} against the cameras since {self.since_ns}"
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


class ClockMonitor:
    """Finds changes of the clock by the rotations of the first camera.

    Args:
        camera: the first of the rig, as calibrated; its rotation on the body is known.
        known: its time offset as it was found, and the standard deviation of that, s; None if
            only the calibration says it.
    """

    def __init__(self, camera: RigCamera, known: tuple[float, float] | None = None) -> None:
        self._R = camera.body_T_camera.rotation().matrix()
        self._nominal_s = camera.clock_offset_s
        self._known = known

    def suspects(self, turns: Turns, imu: ImuData) -> bool:
        """Whether rotations need a closer look: they show another offset, or none is known yet.

        Args:
            turns: a few rotations over the last seconds.
            imu: samples that cover them.
        """
        if self._known is None:
            return True
        offset_s, sigma_s = self._known
        step_s, step_sigma_s = offset_step(turns, imu, self._R, offset_s)
        return abs(step_s) > _SUSPECT_SIGMAS * float(np.hypot(step_sigma_s, sigma_s))

    def look(self, covered: tuple[Turns, ImuData], imu: ImuBuffer) -> ClockChange | None:
        """Find the offset of the last seconds, and the change if it contradicts what was known.

        Args:
            covered: rotations as close together as at the start, and samples that cover them.
            imu: all recent samples.
        """
        found = align_gyroscope(*covered, self._R, self._nominal_s)
        return None if found is None else self.judge(found, covered, imu)

    def judge(
        self, found: GyroAlignment, covered: tuple[Turns, ImuData], imu: ImuBuffer
    ) -> ClockChange | None:
        """The change, if what was found contradicts what was known before.

        Args:
            found: offset of the last seconds.
            covered: the rotations of these, and samples that cover them.
            imu: all recent samples.
        """
        if found.margin < _CLEAR or found.misfit > _MAX_MISFIT:
            return None
        sigma_s = found.offset_sigma_s
        if self._known is None:
            if sigma_s < _KNOWN_SIGMA_S:
                self._know(found)
            return None
        before_s, before_sigma_s = self._known
        change_s = found.offset_s - before_s
        limit_s = max(_CHANGED_S, _CHANGED_SIGMAS * float(np.hypot(sigma_s, before_sigma_s)))
        if sigma_s > _CHANGED_SIGMA_S or abs(change_s) < limit_s:
            return None
        return _change(found, before_s, covered, imu, self._R)

    def _know(self, found: GyroAlignment) -> None:
        """Take the calibrated offset as confirmed, or that which was found as known."""
        away_s = abs(found.offset_s - self._nominal_s)
        confirmed = away_s < _AGREES_SIGMAS * found.offset_sigma_s
        known_s = self._nominal_s if confirmed else found.offset_s
        self._known = known_s, 0.0 if confirmed else found.offset_sigma_s


def _change(
    found: GyroAlignment,
    before_s: float,
    covered: tuple[Turns, ImuData],
    imu: ImuBuffer,
    R: FloatArray,
) -> ClockChange | None:
    """When and by how much the offset has changed; None if it was another one all the time."""
    turns, samples = covered
    preferred = preference(turns, samples, R, found.gyro_bias, (before_s, found.offset_s))
    # the rotations before the split fit the old offset better, the others the new one
    split = int(np.argmin(np.append(0.0, np.cumsum(preferred))))
    if split == len(preferred):
        return None
    good_ns, first_ns = int(turns.first_ns[split]), int(turns.second_ns[split])
    after = turns.first_ns >= first_ns
    if np.count_nonzero(after) >= _FEWEST_AFTER:
        found = align_gyroscope(turns.select(after), samples, R, before_s) or found
    change_s, sigma_s = found.offset_s - before_s, found.offset_sigma_s
    before_ns = round(before_s * 1e9)
    gap = _gap(imu.data, first_ns + before_ns, change_s, sigma_s)
    since_ns, shift_s, sigma_s = gap or (first_ns + before_ns, change_s, sigma_s)
    return ClockChange(since_ns, good_ns + before_ns, first_ns + _AFTER_NS, shift_s, sigma_s)


def _gap(
    imu: ImuData, near_ns: int, change_s: float, sigma_s: float
) -> tuple[int, float, float] | None:
    """The gap that a later clock leaves in the stamps: it is as long as the change.

    Args:
        imu: samples.
        near_ns: about when the clock has changed.
        change_s: by how much.
        sigma_s: standard deviation of that.

    Returns:
        Stamp of the first sample after the gap, how much longer than usual it is, and how much
        intervals differ (s); None if there is no such gap.
    """
    stamps = imu.stamps_ns
    around = stamps[(stamps > near_ns - _NEAR_NS) & (stamps < near_ns + _NEAR_NS)]
    if len(around) < 2:
        return None
    intervals_s = np.diff(around) * 1e-9
    usual_s = float(np.median(intervals_s))
    largest = int(np.argmax(intervals_s))
    longer_s = float(intervals_s[largest]) - usual_s
    if longer_s < usual_s or abs(longer_s - change_s) > _SAME_SIGMAS * sigma_s:
        return None
    jitter_s = float(np.median(np.abs(intervals_s - usual_s)))
    return int(around[largest + 1]), longer_s, jitter_s
