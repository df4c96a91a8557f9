# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The inertial motion over a short window for many gyroscope biases, all its intervals at once.

What GTSAM's preintegration gives too, without covariances. A start needs it at many biases, and
only to find a first guess. Between two samples the mean rate is integrated on the rotation group,
where GTSAM's sum of rotation vectors is exact to first order: the two differ by some 1e-6 rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, skew
from slam_graph.sensors import ImuData


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The inertial motion of the body relative to its first frame, up to velocity and gravity.

    Attributes:
        times_s: (K,) since the first frame.
        rotations: (K, 3, 3) first_R_body.
        displacements: (K, 3) α, the double integral of the rotated specific force.
        velocities: (K, 3) its single integral.
    """

    times_s: FloatArray
    rotations: FloatArray
    displacements: FloatArray
    velocities: FloatArray


class Intervals:
    """The samples of K intervals that follow one another, ready to be integrated."""

    def __init__(self, blocks: list[ImuData]) -> None:
        """Take the samples of each interval; shorter ones get steps of no duration at the end."""
        steps = [block.steps() for block in blocks]
        most = max(len(durations_s) for durations_s, _, _ in steps)
        self._durations_s = np.zeros((most, len(blocks)))
        self._gyro, self._accel = np.zeros((2, most, len(blocks), 3))
        for k, (durations_s, gyro, accel) in enumerate(steps):
            rows = slice(len(durations_s))
            self._durations_s[rows, k], self._gyro[rows, k] = durations_s, gyro
            self._accel[rows, k] = accel

    def rotations(self, gyro_bias: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (K, 3, 3) over the intervals, and their derivatives (K, 3, 3) by the bias.

        With R = Π exp(θₛ) and θₛ = (ωₛ - b) dtₛ, the derivative in the tangent at the end follows
        from step to step (Forster et al. 2017, eq. 35): J ← exp(θₛ)ᵀ J - J_r(θₛ) dtₛ.

        Args:
            gyro_bias: (3,) rad/s.
        """
        turns = self._turns(gyro_bias)
        steps = _exponentials(turns)
        half = skew(turns.reshape(-1, 3)).reshape(steps.shape)
        right = np.eye(3) - half / 2.0 + half @ half / 6.0  # of steps of some hundredths of a rad
        by_bias = right * self._durations_s[:, :, None, None]
        R, J = np.tile(np.eye(3), (len(steps[0]), 1, 1)), np.zeros((len(steps[0]), 3, 3))
        for step, change in zip(steps, by_bias, strict=True):
            R, J = R @ step, step.transpose(0, 2, 1) @ J - change
        return R, J

    def motion(self, gyro_bias: FloatArray) -> Motion:
        """The motion from the first frame to every other.

        Args:
            gyro_bias: (3,) rad/s.
        """
        turns, dt = self._turns(gyro_bias), self._durations_s[:, :, None]
        # the specific force is turned by the attitude half a step on
        force = self._accel + 0.5 * np.cross(turns, self._accel)
        attitudes = [np.tile(np.eye(3), (turns.shape[1], 1, 1))]
        for step in _exponentials(turns):
            attitudes.append(attitudes[-1] @ step)
        gained = (np.array(attitudes[:-1]) @ force[..., None])[..., 0] * dt
        velocity = np.cumsum(gained, axis=0)
        displacement = np.sum((velocity - 0.5 * gained) * dt, axis=0)
        durations_s = self._durations_s.sum(axis=0)
        R, p, v = np.eye(3), np.zeros(3), np.zeros(3)
        rows = [(0.0, R, p, v)]
        for k, duration_s in enumerate(durations_s):
            p = p + v * duration_s + R @ displacement[k]
            v = v + R @ velocity[-1, k]
            R = R @ attitudes[-1][k]
            rows.append((rows[-1][0] + duration_s, R, p, v))
        return Motion(*(np.array(column) for column in zip(*rows, strict=True)))

    def _turns(self, gyro_bias: FloatArray) -> FloatArray:
        """Rotation vectors (S, K, 3) of the steps."""
        return np.asarray((self._gyro - gyro_bias) * self._durations_s[:, :, None])


def _exponentials(turns: FloatArray) -> FloatArray:
    """Rotations (S, K, 3, 3) of rotation vectors (S, K, 3)."""
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices.reshape(*turns.shape, 3))
