# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How the body has moved, as far as the IMU and the last state of the back end say."""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.measurements import ImuData

HISTORY_NS = 2_000_000_000
"""How long samples are kept."""

MAX_GAP_NS = 30_000_000
"""Samples must begin and end no further than this from the time asked for."""

GRAVITY = np.array([0.0, 0.0, -9.81])


class ImuMotion:
    """Integrates the IMU over short times.

    Attributes:
        state: the last one that the back end estimated, whose biases are used; None before.
    """

    def __init__(self) -> None:
        self.state: NavState | None = None
        self._imu = ImuData.empty()

    def add(self, imu: ImuData) -> None:
        """Add samples that follow those already given; others are left out."""
        if len(self._imu):
            imu = imu[int(np.searchsorted(imu.stamps_ns, self._imu.stamps_ns[-1], "right")) :]
        joined = ImuData.concatenate([self._imu, imu])
        if len(joined):
            first = np.searchsorted(joined.stamps_ns, joined.stamps_ns[-1] - HISTORY_NS)
            joined = joined[int(first) :]
        self._imu = joined

    def rotation(self, start_ns: int, end_ns: int) -> gtsam.Rot3 | None:
        """start_R_end of the body, or None where samples are missing.

        Without a state the bias counts as zero.
        """
        samples = self._between(start_ns, end_ns)
        if samples is None:
            return None
        seconds, rates, _ = samples
        R = gtsam.Rot3()
        for turn in rates * seconds[:, None]:
            R = R * gtsam.Rot3.Expmap(turn)
        return R

    def pose(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """world_T_body, carried on from the last state; None without a state or samples."""
        state = self.state
        if state is None:
            return None
        if stamp_ns <= state.stamp_ns:
            return state.world_T_body if stamp_ns == state.stamp_ns else None
        samples = self._between(state.stamp_ns, stamp_ns)
        if samples is None:
            return None
        R, p, v = state.world_T_body.rotation(), state.world_T_body.translation(), state.velocity
        for dt_s, rate, force in zip(*samples, strict=True):
            middle = R * gtsam.Rot3.Expmap(0.5 * dt_s * rate)
            acceleration = middle.matrix() @ force + GRAVITY
            p = p + v * dt_s + 0.5 * acceleration * dt_s**2
            v = v + acceleration * dt_s
            R = R * gtsam.Rot3.Expmap(dt_s * rate)
        return gtsam.Pose3(R, p)

    def _between(
        self, start_ns: int, end_ns: int
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Lengths (K,) in s of steps, and mean rates and specific forces (K, 3) without biases."""
        stamps = self._imu.stamps_ns
        if len(stamps) == 0 or end_ns <= start_ns:
            return None
        if stamps[0] > start_ns + MAX_GAP_NS or stamps[-1] < end_ns - MAX_GAP_NS:
            return None
        inner = stamps[(stamps > start_ns) & (stamps < end_ns)]
        times = np.concatenate([[start_ns], inner, [end_ns]])
        own = (stamps - start_ns) * 1e-9
        wanted = (times - start_ns) * 1e-9

        def mean(values: FloatArray) -> FloatArray:
            at = np.column_stack([np.interp(wanted, own, column) for column in values.T])
            middle: FloatArray = 0.5 * (at[1:] + at[:-1])
            return middle

        rates, forces = mean(self._imu.gyro), mean(self._imu.accel)
        if self.state is not None:
            rates, forces = rates - self.state.gyro_bias, forces - self.state.accel_bias
        return np.diff(wanted), rates, forces
