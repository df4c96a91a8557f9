# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The motion of the cameras over the last frames, as far as the estimator knows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.errors import EstimationError
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuData

_SAMPLES = 17
"""Samples of the motion between two frames."""


@dataclass(frozen=True, eq=False)
class EgoMotion:
    """Poses of the last F frames, and how well the motion between them is known.

    Attributes:
        stamps_ns: (F,) of the frames, on the clock of the cameras, ascending.
        poses: world_T_body of each.
        velocities: (F, 3) of the body in the world, m/s.
        state: of the last one.
        velocity_covariance: (3, 3) of the mean velocity over the frames, m²/s², world axes.
        rate_covariance: (3, 3) of the mean angular rate over them, rad²/s², world axes.
        step_covariance: (6, 6) of the motion from the last but one frame to the last, in the
            tangent of the last pose: rotation (rad), translation (m).
        motions: of the body within frames, by their stamps, for rolling shutters.
    """

    stamps_ns: tuple[int, ...]
    poses: tuple[gtsam.Pose3, ...]
    velocities: FloatArray
    state: NavState
    velocity_covariance: FloatArray
    rate_covariance: FloatArray
    step_covariance: FloatArray
    motions: Mapping[int, FrameMotion] = field(default_factory=dict)

    @property
    def seconds(self) -> FloatArray:
        """(F,) times of the frames since the last one, s, not positive."""
        return (np.array(self.stamps_ns) - self.stamps_ns[-1]) * 1e-9

    def covariance_over(self, since: int) -> FloatArray:
        """(6, 6) of the motion since an earlier frame, in the tangent of the last pose."""
        R = self.poses[-1].rotation().matrix()
        seconds = -self.seconds[since]
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = R.T @ self.rate_covariance @ R * seconds**2
        covariance[3:, 3:] = R.T @ self.velocity_covariance @ R * seconds**2
        return covariance

    def samples(self, now_ns: int, offset_ns: int) -> ImuData:
        """What an ideal IMU without gravity would have measured from the frame before to one.

        Args:
            now_ns: stamp of the frame.
            offset_ns: from stamps of frames to the clock of the samples.
        """
        known = self._known_samples.get((now_ns, offset_ns))  # every object asks for them
        if known is None:
            known = self._known_samples[now_ns, offset_ns] = self._samples(now_ns, offset_ns)
        return known

    @cached_property
    def _known_samples(self) -> dict[tuple[int, int], ImuData]:
        return {}

    def _samples(self, now_ns: int, offset_ns: int) -> ImuData:
        row = self.stamps_ns.index(now_ns)
        if row == 0:
            return ImuData.empty()
        before, now = (
            NavState(
                self.stamps_ns[k] + offset_ns,
                self.poses[k],
                self.velocities[k],
                accel_bias=np.zeros(3),
                gyro_bias=np.zeros(3),
            )
            for k in (row - 1, row)
        )
        return motion_samples(before, now)

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Rotations (F, 3, 3) and positions (F, 3) of the body."""
        return pose_arrays(self.poses)


def motion_samples(before: NavState, now: NavState) -> ImuData:
    """What an ideal IMU without gravity would have measured between two states.

    Rate and acceleration, the latter in the world, are constant.
    """
    period_ns = now.stamp_ns - before.stamp_ns
    seconds = period_ns * 1e-9
    R = before.world_T_body.rotation()
    rate = gtsam.Rot3.Logmap(R.between(now.world_T_body.rotation())) / seconds
    acceleration = (now.velocity - before.velocity) / seconds
    parts = np.linspace(0.0, 1.0, _SAMPLES)
    stamps = before.stamp_ns + (parts * period_ns).astype(np.int64)
    stamps[0] += 1  # the last one of the motion before stays
    turned = Rotation.from_rotvec(parts[:, None] * rate * seconds)
    start = R.unrotate(acceleration)
    return ImuData(stamps, np.tile(rate, (_SAMPLES, 1)), turned.inv().apply(start))


def pose_arrays(poses: tuple[gtsam.Pose3, ...]) -> tuple[FloatArray, FloatArray]:
    """Rotations (F, 3, 3) and positions (F, 3) of poses."""
    matrices = np.array([pose.matrix() for pose in poses]).reshape(-1, 4, 4)
    return np.ascontiguousarray(matrices[:, :3, :3]), np.ascontiguousarray(matrices[:, :3, 3])


class EgoWindow:
    """Keeps the poses of the last frames, and takes later estimates of them where there are any.

    Args:
        length_s: how long frames are kept.
    """

    def __init__(self, length_s: float) -> None:
        self._length_ns = round(length_s * 1e9)
        self._poses: dict[int, gtsam.Pose3] = {}
        self._velocities: dict[int, FloatArray] = {}
        self._motions: dict[int, FrameMotion] = {}
        self._frames: dict[int, int] = {}  # stamp of the frame with an index in the estimator
        self._started = False

    def move(self, motion: gtsam.Pose3) -> None:
        """Move all frames with their world, by `new_T_old`."""
        R = motion.rotation().matrix()
        self._poses = {stamp: motion.compose(pose) for stamp, pose in self._poses.items()}
        self._velocities = {stamp: R @ velocity for stamp, velocity in self._velocities.items()}

    def forget(self) -> None:
        """Forget all frames: the world is another one from now on."""
        self._poses.clear()
        self._velocities.clear()
        self._motions.clear()
        self._frames.clear()
        self._started = False

    def add(self, stamp_ns: int, state: NavState, estimator: Estimator) -> EgoMotion | None:
        """The motion up to a new frame; None at the first one, whose pose no image has corrected.

        Args:
            stamp_ns: of the frame.
            state: of the platform then.
            estimator: after the frame.
        """
        window = estimator.window
        assert window is not None
        if not self._started:
            self._started = True
            return None
        self._frames[window.frame] = stamp_ns
        self._poses[stamp_ns] = state.world_T_body
        self._velocities[stamp_ns] = state.velocity
        if estimator.motion is not None:
            self._motions[stamp_ns] = estimator.motion
        for stamp in [s for s in self._poses if s < stamp_ns - self._length_ns]:
            del self._poses[stamp]
            del self._velocities[stamp]
            self._motions.pop(stamp, None)
        self._frames = {i: s for i, s in self._frames.items() if s in self._poses}
        past = [i for i in window.past if i in self._frames and i != window.frame]
        for i in past:
            if window.state.frames.exists(X(i)):
                self._poses[self._frames[i]] = window.state.frames.atPose3(X(i))
        stamps = tuple(self._poses)
        known = _known(estimator, window.frame, past, self._frames)
        velocity, rate, step = known or _by_state(state, stamps)
        velocities = np.array([self._velocities[stamp] for stamp in stamps])
        poses = tuple(self._poses.values())
        motions = dict(self._motions)
        return EgoMotion(stamps, poses, velocities, state, velocity, rate, step, motions)


def _known(
    estimator: Estimator, now: int, past: list[int], frames: dict[int, int]
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Covariances of velocity, rate and last step by the poses in the state; None without any."""
    if not past:
        return None
    first, last = min(past), max(past)
    keys = sorted({first, last})
    try:
        joint = estimator.covariance_of([*(X(i) for i in keys), X(now)])
    except EstimationError:
        return None
    window = estimator.window
    assert window is not None
    at = window.state.frames.atPose3
    pose = at(X(now))

    def relative(i: int) -> FloatArray:
        """Covariance (6, 6) of the motion since a frame, in the tangent of the pose now."""
        rows = 6 * keys.index(i)
        adjoint = pose.between(at(X(i))).AdjointMap()
        J = np.hstack([-adjoint, np.eye(6)])
        both = np.r_[rows : rows + 6, len(joint) - 6 : len(joint)]
        P: FloatArray = J @ joint[np.ix_(both, both)] @ J.T
        return P

    R = pose.rotation().matrix()
    P, seconds = relative(first), (frames[now] - frames[first]) * 1e-9
    step = relative(last)
    between_s = (frames[now] - frames[last]) * 1e-9
    before_s = (frames[now] - max(s for i, s in frames.items() if i != now)) * 1e-9
    return (
        R @ P[3:, 3:] @ R.T / seconds**2,
        R @ P[:3, :3] @ R.T / seconds**2,
        step * (before_s / between_s) ** 2,
    )


def _by_state(
    state: NavState, stamps: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same by the velocity and rate of the state alone."""
    P = state.covariance
    assert P is not None
    R = state.world_T_body.rotation().matrix()
    seconds = (stamps[-1] - stamps[-2]) * 1e-9 if len(stamps) > 1 else 1.0
    velocity, rate = P[6:9, 6:9], P[12:15, 12:15]
    step = np.zeros((6, 6))
    step[:3, :3] = rate * seconds**2
    step[3:, 3:] = R.T @ velocity @ R * seconds**2
    return velocity, R @ rate @ R.T, step
