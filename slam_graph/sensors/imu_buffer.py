# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The buffer of recent IMU samples, which gives the samples between two times."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors.measurements import ImuData, ImuSteps

_FAR_FUTURE_NS = 2**62


class ImuBuffer:
    """The recent IMU samples, kept as long as a frame may still need them."""

    def __init__(self) -> None:
        self.data = ImuData.empty()

    def add(self, imu: ImuData) -> int:
        """Append samples.

        Samples that are not finite, or not later than those before them, are left out.

        Returns:
            How many were left out.
        """
        newest = self.data.stamps_ns[-1] if len(self.data) else np.iinfo(np.int64).min
        if _follows(imu, newest):
            self.data = ImuData.concatenate([self.data, imu])
            return 0
        latest = np.maximum.accumulate(np.concatenate([[newest], imu.stamps_ns]))[:-1]
        good = (imu.stamps_ns > latest) & np.isfinite(imu.gyro).all(axis=1)
        good &= np.isfinite(imu.accel).all(axis=1)
        if good.any():
            rows = ImuData(imu.stamps_ns[good], imu.gyro[good], imu.accel[good])
            self.data = ImuData.concatenate([self.data, rows])
        return int(np.sum(~good))

    def newest_ns(self) -> int:
        """Time of the last sample; far in the future as long as there is none."""
        return int(self.data.stamps_ns[-1]) if len(self.data) else _FAR_FUTURE_NS

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the samples before the last one at or before `stamp_ns`."""
        first = int(self.data.stamps_ns.searchsorted(stamp_ns, side="right")) - 1
        if first > 0:
            self.data = self.data[first:]

    def covers(self, stamp_ns: int) -> bool:
        """Whether there is a sample at or before `stamp_ns`."""
        return len(self.data) > 0 and int(self.data.stamps_ns[0]) <= stamp_ns

    def largest_gap_s(self, start_ns: int, end_ns: int) -> float:
        """Longest time between consecutive samples around an interval; infinite without samples."""
        if len(self.data) == 0:
            return float("inf")
        t = self.data.stamps_ns
        first, last = int(t.searchsorted(start_ns, side="right")), int(t.searchsorted(end_ns))
        stamps = t[max(first - 1, 0) : last + 1]
        if first == 0:
            stamps = np.append(start_ns, stamps)
        if last == len(t):
            stamps = np.append(stamps, end_ns)
        return float((stamps[1:] - stamps[:-1]).max(initial=0)) * 1e-9

    def between(self, start_ns: int, end_ns: int) -> ImuData:
        """Samples at both ends (interpolated, or the nearest held) and all in between."""
        t = self.data.stamps_ns
        if len(t) == 0:  # nothing known: the caller asks `largest_gap_s` first
            return ImuData(np.array([start_ns, end_ns]), np.zeros((2, 3)), np.zeros((2, 3)))
        inside = slice(int(t.searchsorted(start_ns, side="right")), int(t.searchsorted(end_ns)))
        count = max(inside.stop - inside.start, 0) + 2
        stamps, (gyro, accel) = np.empty(count, np.int64), np.empty((2, count, 3))
        stamps[0], stamps[1:-1], stamps[-1] = start_ns, t[inside], end_ns
        gyro[1:-1], accel[1:-1] = self.data.gyro[inside], self.data.accel[inside]
        gyro[0], accel[0] = self._at(start_ns, start_ns)
        gyro[-1], accel[-1] = self._at(end_ns, start_ns)
        return ImuData(stamps, gyro, accel)

    def steps_at(self, stamps_ns: IntArray) -> tuple[ImuSteps, IntArray]:
        """Steps in which the motion over some times is integrated, each within two of them.

        Args:
            stamps_ns: (N,) ascending, at least two.

        Returns:
            The steps, and the first one (N,) after each time.
        """
        samples = self.between(int(stamps_ns[0]), int(stamps_ns[-1]))
        times = np.union1d(samples.stamps_ns, stamps_ns)
        known_s, wanted_s = ((t - times[0]) * 1e-9 for t in (samples.stamps_ns, times))
        gyro, accel = (
            np.stack([np.interp(wanted_s, known_s, axis) for axis in values.T], axis=1)
            for values in (samples.gyro, samples.accel)
        )
        merged = ImuData(times, gyro, accel)
        steps, pieces = merged.short_steps(), merged.pieces()
        first = np.concatenate([[0], np.cumsum(pieces)])
        return steps, first[times.searchsorted(stamps_ns)]

    def _at(self, stamp_ns: int, zero_ns: int) -> tuple[FloatArray, FloatArray]:
        """Angular rate and specific force (3,) at a time, interpolated or the nearest held.

        Args:
            stamp_ns: the time.
            zero_ns: what times in seconds are counted from.
        """
        samples = self.data
        after = int(samples.stamps_ns.searchsorted(stamp_ns, side="right"))
        if after == 0 or after == len(samples):
            held = max(after - 1, 0)
            return samples.gyro[held], samples.accel[held]
        start_ns, end_ns = samples.stamps_ns[after - 1 : after + 1].tolist()
        start_s, end_s = (start_ns - zero_ns) * 1e-9, (end_ns - zero_ns) * 1e-9
        at_s = (stamp_ns - zero_ns) * 1e-9
        gyro, accel, whole_s = samples.gyro[after - 1], samples.accel[after - 1], end_s - start_s
        part_s = at_s - start_s
        return (
            (samples.gyro[after] - gyro) / whole_s * part_s + gyro,
            (samples.accel[after] - accel) / whole_s * part_s + accel,
        )

    def trend(self, stamp_ns: int, around_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Angular rate, its derivative, and specific force at a time, by lines fitted around it.

        Args:
            stamp_ns: the time.
            around_ns: how far samples before and after it count; the part after the last sample
                does not.

        Returns:
            (3,) rad/s, (3,) rad/s² and (3,) m/s².
        """
        newest_ns = max(self.newest_ns(), stamp_ns - around_ns)
        samples = self.between(stamp_ns - around_ns, min(stamp_ns + around_ns, newest_ns))
        seconds = (samples.stamps_ns - stamp_ns) * 1e-9
        if seconds[-1] - seconds[0] < around_ns * 1e-9:  # too short for a slope
            return samples.gyro[-1], np.zeros(3), samples.accel[-1]
        line = np.column_stack([np.ones(len(seconds)), seconds])
        found = np.linalg.lstsq(line, np.hstack([samples.gyro, samples.accel]), rcond=None)[0]
        return found[0, :3], found[1, :3], found[0, 3:]


def _follows(imu: ImuData, newest_ns: int) -> bool:
    """Whether all samples are finite and in order, and later than the newest one."""
    stamps = imu.stamps_ns
    return bool(
        len(stamps) > 0
        and stamps[0] > newest_ns
        and (stamps[1:] > stamps[:-1]).all()
        and np.isfinite(imu.gyro).all()
        and np.isfinite(imu.accel).all()
    )
