# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances of smoothed states, from the information of the bundle adjustment's own problem.

The joint covariances of neighbouring keyframes are parts of the inverse of the information
(`state_elimination.py`). A frame in between is interpolated in
`keyframe_states.py`, and so is its error: with axes of the world, where the errors of neighbouring
frames are nearly the same,

    e_m = (1 - α) e_k + α e_{k+1} + n_m,

n_m being what the noise of the IMU adds in between, a Brownian bridge.

**The gauge.** Position and yaw of a visual-inertial problem are only known relative to something
(Kelly & Sukhatme 2011), and a covariance depends on what that is. There are two here. Covariances
of states are relative to position and yaw of the anchor, which define the world. Errors against a
ground truth are what is left after alignment, where no pose is special; their covariance is that of
e - N g, where g = Wᵀ e is what the alignment takes away and N its effect on the frame (an
S-transformation: Baarda 1973; Triggs et al. 2000, sec. 9).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.smoothing.state_elimination import EliminatedStates
from slam_graph.backend.solve.stacked_values import stacked_poses
from slam_graph.backend.world_gauge import gauge_motion
from slam_graph.geometry import NavState

_ERROR = 15
"""Components of the error of a state."""
_POSE = slice(0, 6)
_ROTATION, _POSITION, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
_LEAST_EXTENT_M = 0.01
"""Positions that scatter less than this around their mean determine no yaw."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeCovariances:
    """What is known of the errors of K keyframes.

    Attributes:
        rotations: (K, 3, 3) world_R_body.
        pairs: (K-1, 30, 30) joint covariances of neighbouring keyframes, in the order of
            `NavState.covariance`.
        alignment: (K, 6, 4) covariances of poses, with axes of the world, and g, the part of all
            errors that an alignment in position and yaw takes away; None if positions determine no
            yaw.
        aligned_away: (4, 4) covariance of g: position, yaw.
        centre: (3,) mean position, about which the yaw of g turns.
    """

    rotations: FloatArray
    pairs: FloatArray
    alignment: FloatArray | None
    aligned_away: FloatArray
    centre: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameInterpolation:
    """Where N frames are among K keyframes.

    Attributes:
        before: (N,) the last keyframe before each frame, at most K-2.
        part: (N,) the part α of the way to the next one, from 0 to 1.
        interval_s: (K-1,) time between keyframes.
        densities: (K-1, 2) noise densities of gyroscope and accelerometer.
    """

    before: IntArray
    part: FloatArray
    interval_s: FloatArray
    densities: FloatArray

    @classmethod
    def of(
        cls, stamps_ns: IntArray, keyframes: IntArray, densities: FloatArray
    ) -> FrameInterpolation:
        """Between frames at given times.

        Args:
            stamps_ns: (N,) of all frames.
            keyframes: (K,) numbers of those that are keyframes, the first and the last among them.
            densities: (K-1, 2) noise densities of gyroscope and accelerometer.
        """
        before = np.searchsorted(keyframes, np.arange(len(stamps_ns)), side="right") - 1
        before = np.minimum(before, len(keyframes) - 2)
        times = stamps_ns[keyframes]
        interval_ns = np.diff(times)
        part = (stamps_ns - times[before]) / interval_ns[before]
        return cls(before, part, interval_ns * 1e-9, densities)


def keyframe_covariances(
    states: EliminatedStates, values: gtsam.Values, weights: FloatArray, level: bool = True
) -> KeyframeCovariances:
    """Covariances of the keyframes 0 to K-1.

    Args:
        states: the factor of the cost; its gauge is what the covariances are relative to.
        values: the minimum.
        weights: (K,) of the keyframes in an alignment; their sum is one.
        level: whether gravity is measured; if not, an alignment would turn about all axes, which
            is not covered.
    """
    count = len(weights)
    rotations, positions = stacked_poses(values, range(count))
    pairs = states.pair_covariances()
    centre = weights @ positions
    arms = np.cross([0.0, 0.0, 1.0], positions - centre)
    extent = float(weights @ np.sum(arms**2, axis=1))
    if extent < _LEAST_EXTENT_M**2 or not level:
        return KeyframeCovariances(rotations, pairs, None, np.zeros((4, 4)), centre)
    W = np.zeros((count, 6, 4))  # g = Wᵀ e of all errors e, with axes of the world
    W[:, 3:, :3] = weights[:, None, None] * np.eye(3)
    W[:, 3:, 3] = weights[:, None] * arms / extent
    turned = np.zeros((count, _ERROR, 4))
    turned[:, _POSE] = _turned(rotations, W, transpose=True)
    C = _turned(rotations, states.times_covariance(turned)[:, _POSE])
    return KeyframeCovariances(rotations, pairs, C, np.einsum("kij,kil->jl", W, C), centre)


def _turned(rotations: FloatArray, columns: FloatArray, transpose: bool = False) -> FloatArray:
    """Pose errors (K, 6, m) turned from the body frame into the world; or back."""
    turn = rotations.transpose(0, 2, 1) if transpose else rotations
    return np.concatenate([turn @ columns[:, :3], turn @ columns[:, 3:]], axis=1)


def with_covariances(
    states: list[NavState], known: KeyframeCovariances, frames: FrameInterpolation
) -> tuple[list[NavState], FloatArray | None]:
    """The states of all frames with their covariances; pose covariances after an alignment.

    Args:
        states: of N frames.
        known: of the keyframes.
        frames: where the frames are among them.

    Returns:
        The states, and what `aligned_covariances` returns.
    """
    poses = np.array([state.world_T_body.matrix() for state in states])
    rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
    covariances = frame_covariances(known, frames, rotations)
    states = [replace(state, covariance=P) for state, P in zip(states, covariances, strict=True)]
    return states, aligned_covariances(known, frames, rotations, positions)


def frame_covariances(
    known: KeyframeCovariances, frames: FrameInterpolation, rotations: FloatArray
) -> FloatArray:
    """Covariances (N, 15, 15) of the states of all frames, in the order of `NavState.covariance`.

    Args:
        known: of the keyframes.
        frames: where the frames are among them.
        rotations: (N, 3, 3) world_R_body of the frames.
    """
    P = _in_world(known, frames)
    for rows in (_ROTATION, _POSITION):
        P[:, rows] = rotations.transpose(0, 2, 1) @ P[:, rows]
        P[:, :, rows] = P[:, :, rows] @ rotations
    return P


def aligned_covariances(
    known: KeyframeCovariances,
    frames: FrameInterpolation,
    rotations: FloatArray,
    positions: FloatArray,
) -> FloatArray | None:
    """Pose covariances (N, 6, 6) of all frames after an alignment in position and yaw.

    Args:
        known: of the keyframes.
        frames: where the frames are among them.
        rotations: (N, 3, 3) world_R_body of the frames.
        positions: (N, 3) world_p_body.

    Returns:
        In the body frame, rotation before position; None if positions determine no yaw.
    """
    if known.alignment is None:
        return None
    part = frames.part[:, None, None]
    C = (1.0 - part) * known.alignment[frames.before] + part * known.alignment[frames.before + 1]
    N = gauge_motion(positions - known.centre)
    moved = C @ N.transpose(0, 2, 1)
    P = _in_world(known, frames)[:, _POSE, _POSE] - moved - moved.transpose(0, 2, 1)
    P += N @ known.aligned_away @ N.transpose(0, 2, 1)
    P = _turned(rotations, P, transpose=True)
    return _turned(rotations, P.transpose(0, 2, 1), transpose=True)


def bridge_variances(
    frames: FrameInterpolation, before: IntArray, part: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (M, M) of what noise of the IMU adds to rotations and to positions, on each axis.

    In an interval between keyframes it is a Brownian bridge for rotations and its integral for
    positions; that of different intervals is independent.

    Args:
        frames: intervals and noise.
        before: (M,) the last keyframe before each pose.
        part: (M,) the part of the way to the next one.
    """
    same = before[:, None] == before
    gyro, accel = (frames.densities[before] ** 2).T
    T = frames.interval_s[before]
    s, t = np.minimum(part[:, None], part), np.maximum(part[:, None], part)
    # of white noise integrated once or twice, less the linear part of what it is at the end
    twice = _double(s, t) - t * _double(s, 1.0) - s * _double(t, 1.0) + s * t / 3.0
    return same * (gyro * T) * s * (1.0 - t), same * (accel * T**3) * twice


def _double(s: FloatArray, t: FloatArray | float) -> FloatArray:
    """Covariance of twice integrated white noise of unit density at the times s ≤ t."""
    return np.asarray(s**2 * t / 2.0 - s**3 / 6.0)


def _with_axes_of_the_world(known: KeyframeCovariances) -> FloatArray:
    """The joint covariances (K-1, 30, 30) of neighbouring keyframes, with axes of the world."""
    T = np.zeros((len(known.rotations), _ERROR, _ERROR))
    T[:, _ROTATION, _ROTATION] = T[:, _POSITION, _POSITION] = known.rotations
    T[:, 6:, 6:] = np.eye(9)
    pairs = known.pairs.copy()
    for half, turn in ((slice(0, 15), T[:-1]), (slice(15, 30), T[1:])):
        pairs[:, half] = turn @ pairs[:, half]
        pairs[:, :, half] = pairs[:, :, half] @ turn.transpose(0, 2, 1)
    return pairs


def _in_world(known: KeyframeCovariances, frames: FrameInterpolation) -> FloatArray:
    """Covariances (N, 15, 15) of all frames, with axes of the world."""
    a, pairs = frames.part[:, None, None], _with_axes_of_the_world(known)[frames.before]
    first, second = slice(0, _ERROR), slice(_ERROR, 2 * _ERROR)
    cross = pairs[:, first, second]
    P = (1.0 - a) ** 2 * pairs[:, first, first] + a**2 * pairs[:, second, second]
    P += a * (1.0 - a) * (cross + cross.transpose(0, 2, 1))
    gyro, accel = (frames.densities[frames.before] ** 2).T
    T, a = frames.interval_s[frames.before], frames.part
    # white noise integrated once or twice over α T, less the part α of its integral over T
    once, twice = a * (1.0 - a) * T, (a**3 - a**3 * (3.0 - a) + a**2) * T**3 / 3.0
    for rows, variance in (
        (_ROTATION, gyro * once),
        (_POSITION, accel * twice),
        (_VELOCITY, accel * once),
    ):
        P[:, rows, rows] += variance[:, None, None] * np.eye(3)
    return P
