# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What each kind of noise of an IMU adds to the covariance of preintegrated motion.

The covariance is linear in the four variances, so that with these shares another noise needs no
other preintegration, which takes longer than all else of an IMU factor. To first order, with the
specific force F of a step, in the frame of the beginning, and the time τ that is left after it, an
angle φ, in that frame, that the gyroscope is wrong by in step i moves

    velocity by -[Σ F dt]ₓ φ,   position by -[Σ F dt (τ + dt / 2)]ₓ φ,

sums over the steps after i, and turns the end by φ. An error of the accelerometer in step i moves
velocity by its integral, and position by that times τ + dt / 2. What walks add is what steps after
them integrate. Noise is the same in all directions, so that its axes do not matter. All of it is in
the frame of the end, where GTSAM has the residuals.

Shares are right to some thousandths: only what changes of a covariance is taken from them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam_graph.arrays import FloatArray, skew

_UNIT = np.eye(3)
_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
_ACCEL_BIAS, _GYRO_BIAS = slice(9, 12), slice(12, 15)
_AT_ONCE = 2000
"""Steps of intervals at a time, with those that fill shorter ones up: 10 kB each."""


def noise_shares(
    durations_s: Sequence[FloatArray], gyro: Sequence[FloatArray], accel: Sequence[FloatArray]
) -> FloatArray:
    """Covariances (M, 4, 15, 15) that noise of unit density gives to the motion over M intervals.

    Args:
        durations_s: (S,) of the steps of each interval.
        gyro: (S, 3) their angular rates, rad/s.
        accel: (S, 3) their specific forces, m/s².

    Returns:
        Of white noise of gyroscope and accelerometer, random walk of accelerometer and gyroscope;
        of the residuals of GTSAM's factor: rotation, position, velocity, and both biases,
        accelerometer first.
    """
    lengths = np.array([len(seconds) for seconds in durations_s])
    order, shares = np.argsort(lengths, kind="stable"), np.empty((len(lengths), 4, 15, 15))
    while len(order):  # the longest ones first
        count = min(max(_AT_ONCE // max(int(lengths[order[-1]]), 1), 1), len(order))
        rows, order = order[-count:], order[:-count]
        parts = ([values[k] for k in rows] for values in (durations_s, gyro, accel))
        shares[rows] = _shares(*_padded(*parts))
    return shares


def _shares(dt: FloatArray, rates: FloatArray, forces: FloatArray) -> FloatArray:
    """`noise_shares` of intervals with the same number of steps, see `_padded`."""
    count, steps = dt.shape
    turns, halves = _exp(rates * dt[:, :, None]), _exp(rates * (0.5 * dt)[:, :, None])
    R = np.empty((count, steps + 1, 3, 3))
    R[:, 0] = _UNIT
    for k in range(steps):
        R[:, k + 1] = R[:, k] @ turns[:, k]
    middle = R[:, :-1] @ halves
    left = np.cumsum(dt[:, ::-1], axis=1)[:, ::-1] - 0.5 * dt  # τ + dt / 2
    F = (middle @ forces[:, :, :, None])[:, :, :, 0] * dt[:, :, None]
    at_end = np.swapaxes(R[:, -1:], 2, 3)  # from the first attitude to the last one
    N = np.empty((count, steps, 9, 3))  # what an angle moves
    N[:, :, _ROTATION] = at_end
    N[:, :, _POSITION] = -at_end @ skew(_after(F * left[:, :, None]))
    N[:, :, _VELOCITY] = -at_end @ skew(_after(F))
    by_accel = np.zeros((count, steps, 9, 3))
    by_accel[:, :, _POSITION] = (left * dt)[:, :, None, None] * (at_end @ R[:, :-1])
    by_accel[:, :, _VELOCITY] = dt[:, :, None, None] * (at_end @ R[:, :-1])
    by_gyro = N @ (middle * dt[:, :, None, None])
    shares = np.zeros((count, 4, 15, 15))
    shares[:, 0, :9, :9] = _squares(N, dt)
    shares[:, 1, :9, :9] = _squares(by_accel, 1.0 / np.where(dt > 0.0, dt, np.inf))
    for kind, own, moved in ((2, _ACCEL_BIAS, by_accel), (3, _GYRO_BIAS, by_gyro)):
        walk = np.zeros((count, steps, 15, 3))
        walk[:, :, :9], walk[:, :, own] = -_after(moved), _UNIT
        shares[:, kind] = _squares(walk, dt)
    return shares


def _padded(
    durations_s: Sequence[FloatArray], gyro: Sequence[FloatArray], accel: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Durations (M, S), rates and forces (M, S, 3); steps that are missing take no time."""
    lengths = np.array([len(seconds) for seconds in durations_s])
    inside = np.arange(lengths.max()) < lengths[:, None]
    dt, (rates, forces) = np.zeros(inside.shape), np.zeros((2, *inside.shape, 3))
    dt[inside] = np.concatenate(durations_s)
    rates[inside], forces[inside] = np.concatenate(gyro), np.concatenate(accel)
    return dt, rates, forces


def _after(values: FloatArray) -> FloatArray:
    """Sums over the steps (M, S, ...) after each one."""
    return np.asarray(np.cumsum(values[:, ::-1], axis=1)[:, ::-1] - values)


def _squares(roots: FloatArray, weights: FloatArray) -> FloatArray:
    """Σ w N Nᵀ (M, r, r) over the steps of N (M, S, r, 3) and w (M, S)."""
    count, _, rows, _ = roots.shape
    N = (roots * np.sqrt(weights)[:, :, None, None]).transpose(0, 2, 1, 3).reshape(count, rows, -1)
    return np.asarray(N @ N.transpose(0, 2, 1))


def _exp(turns: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) by vectors (..., 3)."""
    angle = np.linalg.norm(turns, axis=-1)[..., None, None]
    K = skew(turns)
    return np.asarray(
        _UNIT + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * K @ K
    )
