# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The motion that an IMU predicts from many states, each up to the next one."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from slam_graph.arrays import FloatArray, IntArray, skew
from slam_graph.kernels.compilation import compiled

__all__ = ["predict_motion", "predict_motion_numpy"]

_SMALL = 1e-8
"""Squared angle below which the series of sine and cosine takes their place."""


@compiled()
def _exponential(rate: FloatArray, seconds: float, turn: FloatArray) -> None:
    """The rotation (3, 3) by a rate over a time (Rodrigues)."""
    x, y, z = rate[0] * seconds, rate[1] * seconds, rate[2] * seconds
    square = x * x + y * y + z * z
    if square > _SMALL:
        angle = math.sqrt(square)
        sine, cosine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    else:
        sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
    turn[0, 0], turn[1, 1] = 1.0 - cosine * (y * y + z * z), 1.0 - cosine * (x * x + z * z)
    turn[2, 2] = 1.0 - cosine * (x * x + y * y)
    turn[0, 1], turn[1, 0] = cosine * x * y - sine * z, cosine * x * y + sine * z
    turn[0, 2], turn[2, 0] = cosine * x * z + sine * y, cosine * x * z - sine * y
    turn[1, 2], turn[2, 1] = cosine * y * z - sine * x, cosine * y * z + sine * x


@compiled(
    "void(f8[::1], f8[:, ::1], f8[:, ::1], i8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1],"
    " f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1])"
)
def predict_motion(
    durations: FloatArray,
    rates: FloatArray,
    forces: FloatArray,
    steps: IntArray,
    known: IntArray,
    rotations: FloatArray,
    positions: FloatArray,
    velocities: FloatArray,
    gyro_biases: FloatArray,
    accel_biases: FloatArray,
    gravity: FloatArray,
) -> None:
    """Fill in the motion at all times after known ones, and up to the next known one.

    Rate and specific force are constant in each step (Forster et al. 2017, eq. 30); the force has
    the direction of the middle of the step.

    Args:
        durations: (S,) of the steps, s.
        rates: (S, 3) angular rates in them, rad/s.
        forces: (S, 3) specific forces in them, m/s².
        steps: (N,) the first step after each time.
        known: (K,) times with a known motion, ascending, the first and the last time among them.
        rotations: (N, 3, 3) world_R_body. At known times they are given; on return all but the
            first are what is predicted from the known time before.
        positions: (N, 3), m, likewise.
        velocities: (N, 3), m/s, likewise.
        gyro_biases: (K, 3) from each known time on, rad/s.
        accel_biases: (K, 3) likewise, m/s².
        gravity: (3,) m/s².
    """
    R, turn, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    after_R, after = np.empty((3, 3)), np.empty((2, 3))
    p, v, rate, force = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        after[0, i], after[1, i] = positions[known[0], i], velocities[known[0], i]
        for j in range(3):
            after_R[i, j] = rotations[known[0], i, j]
    for k in range(len(known) - 1):
        end = known[k + 1]
        for i in range(3):  # what is known at the end is overwritten below
            p[i], v[i] = after[0, i], after[1, i]
            after[0, i], after[1, i] = positions[end, i], velocities[end, i]
            for j in range(3):
                R[i, j], after_R[i, j] = after_R[i, j], rotations[end, i, j]
        for n in range(known[k], end):
            for s in range(steps[n], steps[n + 1]):
                dt = durations[s]
                half = 0.5 * dt
                for i in range(3):
                    rate[i] = rates[s, i] - gyro_biases[k, i]
                    force[i] = forces[s, i] - accel_biases[k, i]
                x = force[0] + half * (rate[1] * force[2] - rate[2] * force[1])
                y = force[1] + half * (rate[2] * force[0] - rate[0] * force[2])
                z = force[2] + half * (rate[0] * force[1] - rate[1] * force[0])
                _exponential(rate, dt, turn)
                for i in range(3):
                    a = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z + gravity[i]
                    p[i] += dt * (v[i] + half * a)
                    v[i] += dt * a
                    for j in range(3):
                        first, second = R[i, 0] * turn[0, j], R[i, 1] * turn[1, j]
                        turned[i, j] = first + second + R[i, 2] * turn[2, j]
                R, turned = turned, R
            for i in range(3):
                positions[n + 1, i], velocities[n + 1, i] = p[i], v[i]
                for j in range(3):
                    rotations[n + 1, i, j] = R[i, j]


def predict_motion_numpy(
    durations: FloatArray,
    rates: FloatArray,
    forces: FloatArray,
    steps: IntArray,
    known: IntArray,
    rotations: FloatArray,
    positions: FloatArray,
    velocities: FloatArray,
    gyro_biases: FloatArray,
    accel_biases: FloatArray,
    gravity: FloatArray,
) -> None:
    """`predict_motion` in NumPy."""
    given = rotations[known], positions[known], velocities[known]
    for k, (begin, end) in enumerate(pairwise(known)):
        R, p, v = (values[k].copy() for values in given)
        for n in range(begin, end):
            for s in range(steps[n], steps[n + 1]):
                dt, rate, force = durations[s], rates[s] - gyro_biases[k], forces[s]
                force = force - accel_biases[k]
                a = R @ (force + np.cross(0.5 * dt * rate, force)) + gravity
                p, v = p + dt * v + 0.5 * dt**2 * a, v + dt * a
                angle, K = float(np.linalg.norm(rate * dt)), skew(rate * dt)
                # sinc(x) of NumPy is sin(πx) / πx
                sine, cosine = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
                R = R @ (np.eye(3) + sine * K + cosine * K @ K)
            rotations[n + 1], positions[n + 1], velocities[n + 1] = R, p, v
