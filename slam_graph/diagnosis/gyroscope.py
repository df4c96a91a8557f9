# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The integrated gyroscope of a part of a recording: its orientation at any time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors import ImuData


class Gyroscope:
    """Orientations of the body by the integrated angular rate.

    Attributes:
        start_ns: stamp of the first sample; times are in seconds since then.
        t: (N,) times of the samples, s.
        rate: (N, 3) angular rates, rad/s.
        force: (N, 3) specific forces, m/s².
        R: (N, 3, 3) start_R_body.
        integral: (N, 3) integral of the rate, which a wrong unit does not wrap, rad.
    """

    def __init__(self, imu: ImuData) -> None:
        """Integrate at least two samples."""
        self.start_ns = int(imu.stamps_ns[0])
        self.t = (imu.stamps_ns - self.start_ns) * 1e-9
        self.rate, self.force = imu.gyro, imu.accel
        durations_s, rates, _ = imu.steps()
        turns = rates * durations_s[:, None]
        self.integral = np.concatenate([np.zeros((1, 3)), np.cumsum(turns, axis=0)])
        self.R = imu.chained(Rotation.from_rotvec(turns).as_matrix())

    def seconds(self, stamps_ns: IntArray) -> FloatArray:
        """Times (...) of stamps (...) on the clock of the IMU."""
        return np.asarray((stamps_ns - self.start_ns) * 1e-9)

    def orientation(self, t: FloatArray) -> FloatArray:
        """start_R_body (K, 3, 3) at times (K,)."""
        row = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 1)
        turn = 0.5 * (self.rate[row] + self.rate_at(t)) * (t - self.t[row])[:, None]
        return np.asarray(self.R[row] @ Rotation.from_rotvec(turn).as_matrix())

    def rate_at(self, t: FloatArray) -> FloatArray:
        """Angular rates (K, 3) at times (K,)."""
        return np.stack([np.interp(t, self.t, axis) for axis in self.rate.T], axis=-1)

    def integral_at(self, t: FloatArray) -> FloatArray:
        """Integrals of the angular rate (K, 3) at times (K,)."""
        return np.stack([np.interp(t, self.t, axis) for axis in self.integral.T], axis=-1)
