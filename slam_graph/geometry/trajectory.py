# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A trajectory: time-stamped poses `world_T_body`, and what else is known at these times."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class NavState:
    """The state of the platform at one time.

    Attributes:
        stamp_ns: time.
        world_T_body: pose of the body in the world (z up).
        velocity: (3,) m/s, in the world frame.
        gyro_bias: (3,) rad/s, in the body frame.
        accel_bias: (3,) m/s², in the body frame.
        covariance: (15, 15) of the error in the order rotation (rad, body frame), position (m, body
            frame), velocity (m/s, world), accelerometer bias, gyroscope bias: the tangents of
            GTSAM's Pose3, Vector3 and ConstantBias. None where it is not known.
    """

    stamp_ns: int
    world_T_body: gtsam.Pose3
    velocity: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray
    covariance: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time, as arrays.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing.
        positions: (N, 3) of the body in the world, in metres.
        quaternions: (N, 4) of world_R_body as (x, y, z, w), of unit length.
        velocities: (N, 3) in the world frame, m/s, or None where the source has none.
        gyro_biases: (N, 3) rad/s, or None.
        accel_biases: (N, 3) m/s², or None.
    """

    stamps_ns: IntArray
    positions: FloatArray
    quaternions: FloatArray
    velocities: FloatArray | None = None
    gyro_biases: FloatArray | None = None
    accel_biases: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def pose(self, index: int) -> gtsam.Pose3:
        """`world_T_body` of one row."""
        x, y, z, w = self.quaternions[index]
        return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), self.positions[index])
