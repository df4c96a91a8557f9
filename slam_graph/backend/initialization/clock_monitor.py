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

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.initialization.clock_change import ClockChange
from slam_graph.backend.initialization.gyro_alignment import (
    MIN_TURNS,
    GyroAlignment,
    Turns,
    align_gyroscope,
    log_likelihood_ratios,
    offset_step,
)
from slam_graph.sensors import ImuBuffer, ImuData, RigCamera

_FIRST_SIGMA_S, _KNOWN_SIGMA_S = 5e-3, 3e-3
"""An offset is taken from rotations that show it to this; it is found anew until it is known to
that."""
_DIFFERS_SIGMAS, _AGREES_SIGMAS, _APART_SIGMAS = 4.0, 3.0, 5.0
"""A Gauss-Newton step on few rotations that is larger than the first is followed by an estimate
from all. It agrees with the estimates before if they are within the second of one another, in
standard deviations of both, and is of another clock only beyond the third."""
_CHANGED_SIGMAS, _CHANGED_S, _CHANGED_SIGMA_S = 8.0, 8e-3, 4e-3
"""For a change it must also differ from the offset that holds (that of the calibration, where the
estimates agree with it) by so many of its standard deviations, by so much, and be known to this.
Good recordings show up to 3.2 standard deviations."""
_LATE_NS = 2_500_000_000
"""If all rotations show no change, those of this last time may: all are of the new clock then."""
_AFTER_NS = 100_000_000
"""The new beginning keeps this far from the time of the change."""
_GAP_LATER_NS = 2_000_000_000
"""A gap in the samples that is as long as the change is where it happened: at most this much later
than the rotations say, and any time before, as without rotation a change does not show."""


class ClockMonitor:
    """Finds changes of the clock by the rotations of the first camera.

    Args:
        camera: the first of the rig, as calibrated; its rotation on the body is known.
        known: its time offset as it was found, and the standard deviation of that, s; None if
            only the calibration says it.

    Attributes:
        contradicted: whether the last estimate contradicts those before, but not beyond doubt.
    """

    def __init__(self, camera: RigCamera, known: tuple[float, float] | None = None) -> None:
        self._R = camera.body_T_camera.rotation().matrix()
        self._nominal_s = camera.clock_offset_s
        self._known = known
        self.contradicted = False

    def confirms_calibration(self, found: GyroAlignment) -> bool:
        """Whether the calibrated offset was right before, so that another one is a change."""
        if self._known is None or not self.knows:
            return False
        apart_s = _APART_SIGMAS * float(np.hypot(found.offset_sigma_s, self._known[1]))
        return self._is_calibrated and abs(found.offset_s - self._known[0]) > apart_s

    @property
    def knows(self) -> bool:
        """Whether the offset that holds is known well."""
        return self._known is not None and self._known[1] <= _KNOWN_SIGMA_S

    @property
    def _is_calibrated(self) -> bool:
        """Whether what is known agrees with the calibration."""
        assert self._known is not None
        known_s, sigma_s = self._known
        return abs(known_s - self._nominal_s) < _AGREES_SIGMAS * sigma_s

    def needs_estimate(self, turns: Turns, imu: ImuData) -> bool:
        """Whether few rotations show another offset than before, or it is not known well yet.

        Args:
            turns: a few rotations over the last seconds.
            imu: samples that cover them.
        """
        if self._known is None or not self.knows:
            return True
        offset_s, sigma_s = self._known
        step_s, step_sigma_s = offset_step(turns, imu, self._R, offset_s)
        return abs(step_s) > _DIFFERS_SIGMAS * float(np.hypot(step_sigma_s, sigma_s))

    def estimate(self, covered: tuple[Turns, ImuData], imu: ImuBuffer) -> ClockChange | None:
        """Estimate the offset of the last seconds; the change if it contradicts that before.

        Args:
            covered: rotations as close together as at the start, and samples that cover them.
            imu: all recent samples.
        """
        turns, samples = covered
        late = turns.first_ns >= int(turns.second_ns.max()) - _LATE_NS
        self.contradicted = False
        for part in (turns, turns.select(late)):
            if len(part.first_ns) < MIN_TURNS:
                break
            found = align_gyroscope(part, samples, self._R, self._nominal_s)
            if found is not None and found.is_clear():
                change = self.compare(found, covered, imu)
                if change is not None:
                    return change
        return None

    def compare(
        self, found: GyroAlignment, covered: tuple[Turns, ImuData], imu: ImuBuffer
    ) -> ClockChange | None:
        """The change, if an estimate contradicts those before; if it agrees the better one is kept.

        Args:
            found: clear estimate of the offset over the last seconds.
            covered: the rotations of these, and samples that cover them.
            imu: all recent samples.
        """
        offset_s, sigma_s = found.offset_s, found.offset_sigma_s
        if self._known is None:
            if sigma_s < _FIRST_SIGMA_S:
                self._known = offset_s, sigma_s
            return None
        known_s, known_sigma_s = self._known
        both_s = float(np.hypot(sigma_s, known_sigma_s))
        if abs(offset_s - known_s) < _AGREES_SIGMAS * both_s:
            if sigma_s < known_sigma_s:
                self._known = offset_s, sigma_s
            return None
        fits = abs(offset_s - self._nominal_s) < _AGREES_SIGMAS * sigma_s
        if fits and not self.knows and sigma_s < known_sigma_s:
            self._known = offset_s, sigma_s  # the first estimate was wrong, not the calibration
            return None
        self.contradicted = True
        before_s = self._nominal_s if self._is_calibrated else known_s
        limit_s = max(_CHANGED_S, _CHANGED_SIGMAS * (sigma_s if self._is_calibrated else both_s))
        if (
            sigma_s > _CHANGED_SIGMA_S
            or abs(offset_s - known_s) < _APART_SIGMAS * both_s
            or abs(offset_s - before_s) < limit_s
        ):
            return None
        return _change(found, before_s, covered, imu, self._R)


def _change(
    found: GyroAlignment,
    before_s: float,
    covered: tuple[Turns, ImuData],
    imu: ImuBuffer,
    R: FloatArray,
) -> ClockChange | None:
    """When and by how much the offset has changed; None if all rotations fit the old one better."""
    turns, samples = covered
    ratios = log_likelihood_ratios(turns, samples, R, found.gyro_bias, (before_s, found.offset_s))
    # the rotations before the split fit the old offset better, the others the new one
    split = int(np.argmin(np.append(0.0, np.cumsum(ratios))))
    if split == len(ratios):
        return None
    good_ns, first_ns = int(turns.first_ns[split]), int(turns.second_ns[split])
    after = turns.first_ns >= first_ns
    if np.count_nonzero(after) >= MIN_TURNS:
        later = align_gyroscope(turns.select(after), samples, R, before_s)
        found = later if later is not None and later.is_clear() else found
    change_s, sigma_s = found.offset_s - before_s, found.offset_sigma_s
    before_ns = round(before_s * 1e9)
    gap = _gap(imu.data, first_ns + before_ns, change_s, sigma_s)
    since_ns, shift_s, sigma_s = gap or (first_ns + before_ns, change_s, sigma_s)
    good_ns += before_ns
    if gap is not None:  # it may be older than all of the rotations
        good_ns = min(good_ns, since_ns - round(shift_s * 1e9))
    return ClockChange(since_ns, good_ns, first_ns + _AFTER_NS, shift_s, sigma_s)


def _gap(
    imu: ImuData, near_ns: int, change_s: float, sigma_s: float
) -> tuple[int, float, float] | None:
    """The gap that a later clock leaves in the stamps: it is as long as the change.

    Args:
        imu: samples.
        near_ns: when the clock has changed by the rotations, on the clock of the IMU.
        change_s: by how much.
        sigma_s: standard deviation of that.

    Returns:
        Stamp of the first sample after the gap, how much longer than usual it is, and how much
        intervals differ (s); None if there is no such gap.
    """
    stamps = imu.stamps_ns[imu.stamps_ns < near_ns + _GAP_LATER_NS]
    if len(stamps) < 2:
        return None
    intervals_s = np.diff(stamps) * 1e-9
    usual_s = float(np.median(intervals_s))
    nearest = int(np.argmin(np.abs(intervals_s - usual_s - change_s)))
    longer_s = float(intervals_s[nearest]) - usual_s
    if longer_s < usual_s or abs(longer_s - change_s) > _AGREES_SIGMAS * sigma_s:
        return None
    jitter_s = float(np.median(np.abs(intervals_s - usual_s)))
    return int(stamps[nearest + 1]), longer_s, jitter_s
