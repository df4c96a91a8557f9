# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Joint covariances of the poses of neighbouring frames, and so of the motions between them.

Errors of two frames are nearly the same, so that of the motion between them is much smaller than
either. Both frames are between the same two keyframes (`state_covariances.py`), or are these: with
axes of the world

    e_m = (1 - α) e_k + α e_{k+1} + n_m,

and n, the noise in between, is the Brownian bridge for rotations and its integral for positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.smoothing.state_covariances import (
    FrameInterpolation,
    KeyframeCovariances,
    with_axes_of_the_world,
)

_POSES = np.r_[0:6, 15:21]
"""Of the states of two keyframes."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotions:
    """What is known of the errors of the motions from frame to frame.

    Attributes:
        known: errors of the keyframes.
        frames: where the frames are among them.
    """

    known: KeyframeCovariances
    frames: FrameInterpolation

    def joint_covariances(self, rotations: FloatArray) -> FloatArray:
        """Covariances (N-1, 12, 12) of the poses of each two consecutive frames, earlier one first.

        Args:
            rotations: (N, 3, 3) world_R_body of the frames.

        Returns:
            In the tangents of the poses: rotation (rad), translation (m), body axes.
        """
        before, part = self.frames.before[:-1], self.frames.part
        same = self.frames.before[1:] == before
        a, b = part[:-1], np.where(same, part[1:], 1.0)  # the next keyframe ends the interval
        A = np.zeros((len(before), 12, 12))
        for rows, share in ((slice(0, 6), a), (slice(6, 12), b)):
            A[:, rows, :6] = (1.0 - share)[:, None, None] * np.eye(6)
            A[:, rows, 6:] = share[:, None, None] * np.eye(6)
        pairs = with_axes_of_the_world(self.known)[np.ix_(before, _POSES, _POSES)]
        P: FloatArray = A @ pairs @ A.transpose(0, 2, 1) + self._in_between(a, b)
        for first, R in ((0, rotations[:-1]), (6, rotations[1:])):
            for rows in (slice(first, first + 3), slice(first + 3, first + 6)):
                P[:, rows] = R.transpose(0, 2, 1) @ P[:, rows]
                P[:, :, rows] = P[:, :, rows] @ R
        return P

    def _in_between(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Covariances (N-1, 12, 12) of the noise at the parts a ≤ b of the way, world axes."""
        before = self.frames.before[:-1]
        gyro, accel = (self.frames.densities[before] ** 2).T
        T = self.frames.interval_s[before]
        N = np.zeros((len(before), 12, 12))
        for i, s, j, t in ((0, a, 0, a), (0, a, 6, b), (6, b, 6, b)):
            # of white noise integrated once or twice, less the linear part of what it is at the end
            once = gyro * s * (1.0 - t) * T
            twice = accel * T**3 * (_double(s, t) - t * _double(s, 1.0) - s * _double(t, 1.0))
            twice += accel * T**3 * s * t / 3.0
            for row, column, variance in ((i, j, once), (i + 3, j + 3, twice)):
                block = variance[:, None, None] * np.eye(3)
                N[:, row : row + 3, column : column + 3] = block
                N[:, column : column + 3, row : row + 3] = block
        return N


def _double(s: FloatArray, t: FloatArray | float) -> FloatArray:
    """Covariance of twice integrated white noise of unit density at the times s ≤ t."""
    result: FloatArray = s**2 * t / 2.0 - s**3 / 6.0
    return result
