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
        self._last: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._durations_s = np.zeros((most, len(blocks)))
        self._gyro, self._accel = np.zeros((2, most, len(blocks), 3))
        for k, (durations_s, gyro, accel) in enumerate(steps):
            rows = slice(len(durations_s))
            self._durations_s[rows, k], self._gyro[rows, k] = durations_s, gyro
            self._accel[rows, k] = accel

    def rotations(self, gyro_bias: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (K, 3, 3) over the intervals, and their derivatives (K, 3, 3) by the bias.

        With R = Π exp(θₛ) and θₛ = (ωₛ - b) dtₛ, the derivative in the tangent at the end is the
        sum of -J_r(θₛ) dtₛ, turned by all steps that follow (Forster et al. 2017, eq. 35).

        Args:
            gyro_bias: (3,) rad/s.
        """
        turns, attitudes = self._integrated(gyro_bias)
        half = skew(turns)
        right = np.eye(3) - half / 2.0 + half @ half / 6.0  # of steps of some hundredths of a rad
        # the turn that follows a step is Rₛ₊₁ᵀ R
        R, changes = attitudes[-1], attitudes[1:] @ (right * self._durations_s[:, :, None, None])
        return R, -(R.mT @ changes.sum(axis=0))

    def motion(self, gyro_bias: FloatArray) -> Motion:
        """The motion from the first frame to every other.

        Args:
            gyro_bias: (3,) rad/s.
        """
        (turns, attitudes), dt = self._integrated(gyro_bias), self._durations_s[:, :, None]
        # the specific force is turned by the attitude half a step on
        force = self._accel + 0.5 * np.cross(turns, self._accel)
        gained = (attitudes[:-1] @ force[..., None])[..., 0] * dt
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

    def _integrated(self, gyro_bias: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation vectors (S, K, 3) of the steps, and attitudes (S + 1, K, 3, 3) before and after.

        Those of the last bias are kept: rotations and the motion are asked for one after the other.
        """
        if self._last is None or not np.array_equal(self._last[0], gyro_bias):
            turns = np.asarray((self._gyro - gyro_bias) * self._durations_s[:, :, None])
            attitudes = np.empty((len(turns) + 1, turns.shape[1], 3, 3))
            attitudes[0] = np.eye(3)
            for s, step in enumerate(_exponentials(turns)):
                np.matmul(attitudes[s], step, out=attitudes[s + 1])
            self._last = gyro_bias.copy(), turns, attitudes
        return self._last[1:]


def _exponentials(turns: FloatArray) -> FloatArray:
    """Rotations (S, K, 3, 3) of rotation vectors (S, K, 3)."""
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices.reshape(*turns.shape, 3))
