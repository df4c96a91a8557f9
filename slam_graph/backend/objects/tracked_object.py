# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One object from when it is found to when it is lost."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import gtsam
import numpy as np
from scipy.special import chdtri

from slam_graph.arrays import FloatArray, IntArray, median
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.object_state import ObjectMotion, ObjectState
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.relative_motion import RelativeMotion
from slam_graph.backend.objects.track_window import TrackWindow, quantile

_MAX_REJECTIONS = 2
"""A track that the gate rejects so often within the frames of the window is not of the object."""
_CONFIRMED = 3
"""An object is reported when it has so many frames."""
_SAME_MOTION = 0.01
"""Probability with which two parts of one object are taken for two in a frame."""
_POWER = 0.5
"""Two objects become one if a difference of the least speed would have been seen: it is two
standard deviations."""
_NEAR = 1.5
"""Parts of one object are no farther apart than the sum of their sizes times this."""
_MOTION_S = 0.3
"""Time over which it is judged whether an object moves."""
_AT_REST = 0.1
"""Probability with which the motion of an object at rest is estimated larger than that which shows
that it stands. That it does not move for certain does not show it: that limit is much larger."""


class TrackedObject:
    """Tracks of one object, and the estimator of its motion.

    Args:
        number: of the object.
        label: of its mask; 0 without one.
        members: (N,) ids of its tracks, ascending.
        motion: their estimator, with a pose in the last frame.
        ego: the motion of the platform.
        config: of objects.

    Attributes:
        members: as above, now.
        frames: number of frames with a state.
        reviewed: how many of them it had when it was reviewed last.
        compared_next: how many it has when it is compared with its mirror image again.
        seen_ns: time of the last frame with a state.
        moving: whether it is known to move.
        standing: whether it was seen to stand since it moved last.
        reported: whether it has been reported.
        unique: whether its motion is known from the mirror image of it; it is not reported before.
    """

    def __init__(
        self,
        number: int,
        label: int,
        members: IntArray,
        motion: RelativeMotion,
        ego: EgoMotion,
        config: ObjectsConfig,
    ) -> None:
        self.number, self.label, self.members = number, label, members
        self.frames, self.reviewed, self.compared_next = 0, 0, 0
        self.moving, self.standing = False, False
        self.reported, self.unique = False, False
        self.seen_ns = ego.stamps_ns[-1]
        self._config = config
        self._object_T_start = gtsam.Pose3()
        self.state: ObjectState | None = None
        self._motion = motion
        self._rejections: deque[IntArray] = deque()
        self._points: tuple[tuple[RelativeMotion, int, gtsam.Pose3], FloatArray] | None = None
        self._place(ego)

    def begin_again(self, members: IntArray, motion: RelativeMotion, ego: EgoMotion) -> None:
        """Go on with some of the tracks only, or with another motion; the pose goes on, too.

        Args:
            members: (N,) ids of the tracks, ascending.
            motion: their estimator, with a pose in the last frame.
            ego: the motion of the platform.
        """
        before = self.state
        self.members, self._motion = members, motion
        self._rejections = deque()
        self.unique, self.standing = False, False
        if before is not None and before.stamp_ns == ego.stamps_ns[-1]:
            self.continue_from(before.world_T_object, ego)
        else:
            self._place(ego)

    @property
    def confirmed(self) -> bool:
        """Whether it has been seen often enough to be reported, and has one motion."""
        return self.unique and self.frames >= _CONFIRMED

    @property
    def poses(self) -> dict[int, gtsam.Pose3]:
        """Poses of the platform relative to the object, by the stamps of frames."""
        return self._motion.poses

    @property
    def taken(self) -> IntArray:
        """Ids (N,) of those of its tracks that its estimate rests on: not of what just joined."""
        return self.members[is_in(self.members, self._motion.known)]

    def points(self) -> FloatArray:
        """(N, 3) its points, in its own frame, m."""
        made_of = self._motion, self._motion.taken_ns, self._object_T_start
        if self._points is None or self._points[0] != made_of:  # many ask for them in a frame
            _, points = self._motion.points()
            moved = np.asarray(self._object_T_start.transformFrom(points.T)).T.reshape(-1, 3)
            self._points = made_of, moved
        return self._points[1]

    def world_points(self) -> FloatArray:
        """(N, 3) its points in the world, where they were in its last frame, m."""
        points = self.points()
        if self.state is None or len(points) == 0:
            return np.zeros((0, 3))
        return np.asarray(self.state.world_T_object.transformFrom(points.T)).T

    def _place(self, ego: EgoMotion) -> None:
        """Choose the frame of the object: axes of the world, origin in the middle of its points."""
        now = ego.stamps_ns[-1]
        world_T_start = ego.poses[-1].compose(self._motion.poses[now].inverse())
        _, points = self._motion.points()
        middle = median(points) if len(points) else np.zeros(3)
        origin = gtsam.Pose3(gtsam.Rot3(), world_T_start.transformFrom(middle))
        self._object_T_start = origin.inverse().compose(world_T_start)

    def continue_from(self, pose: gtsam.Pose3, ego: EgoMotion) -> None:
        """Take a pose of the object now, with its axes: it was seen before.

        Args:
            pose: world_T_object, as predicted.
            ego: the motion of the platform.
        """
        now = ego.stamps_ns[-1]
        world_T_start = ego.poses[-1].compose(self._motion.poses[now].inverse())
        self._object_T_start = pose.inverse().compose(world_T_start)

    def assume_pixel_noise(self, sigma_px: float) -> None:
        """Take observations for so noisy from now on."""
        self._motion.assume_pixel_noise(sigma_px)

    def add(self, window: TrackWindow, ego: EgoMotion) -> ObjectState | None:
        """Take the last frame of the window.

        Returns:
            The state then; None if too few of its tracks are seen.
        """
        frame = window.frames[-1]
        self.members = self.members[is_in(self.members, window.seen)]
        if len(self.members) < 4:
            return None
        if frame.stamp_ns not in self._motion.poses and not self._motion.add(
            frame.only(self.members), ego, list(window.frames)[:-1]
        ):
            return None
        self._drop_rejected()
        self.frames += 1
        self.seen_ns = frame.stamp_ns
        self.state = self._state(ego)
        return self.state

    def _drop_rejected(self) -> None:
        self._rejections.append(self._motion.rejected)
        while len(self._rejections) > max(len(self._motion.poses), 1):
            self._rejections.popleft()
        ids, counts = np.unique(np.concatenate(self._rejections), return_counts=True)
        self.members = self.members[~is_in(self.members, ids[counts >= _MAX_REJECTIONS])]

    def _state(self, ego: EgoMotion) -> ObjectState | None:
        now = ego.stamps_ns[-1]
        pose = self._object_T_start.compose(self._motion.poses[now])
        world_T_object = ego.poses[-1].compose(pose.inverse())
        step = self._motion_since(1, ego)
        mean = self._motion_since(self._frames_back(ego), ego) or step
        velocity, velocity_covariance = np.zeros(3), np.full((3, 3), np.nan)
        if mean is not None:
            R = world_T_object.rotation().matrix()
            velocity = R @ mean.motion.rotation().unrotate(mean.motion.translation()) / mean.seconds
            velocity_covariance = R @ mean.covariance[3:, 3:] @ R.T / mean.seconds**2
            self._judge(mean, velocity, velocity_covariance)
        return ObjectState(
            now,
            self.number,
            self.label,
            world_T_object,
            self._pose_covariance(ego, pose),
            ego.poses[-1],
            step,
            velocity,
            velocity_covariance,
            self.moving,
            len(self.members),
        )

    def _judge(self, mean: ObjectMotion, velocity: FloatArray, covariance: FloatArray) -> None:
        """Whether it moves, by its motion over the last frames; as before if that cannot tell."""
        if mean.statistic > chdtri(6, self._config.false_alarm):
            self.moving = True
        elif self.moving:
            sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
            self.moving = float(np.linalg.norm(velocity)) + sigma > self._config.min_speed
        self.standing |= mean.statistic < chdtri(6, _AT_REST)
        self.standing &= not self.moving

    def _frames_back(self, ego: EgoMotion) -> int:
        """How many frames back the motion is taken from, to judge it."""
        poses, stamps, seconds = self._motion.poses, ego.stamps_ns, ego.seconds
        known = (n for n in range(1, len(stamps)) if stamps[-1 - n] in poses)
        return max((n for n in known if seconds[-1 - n] >= -_MOTION_S), default=1)

    def _motion_since(self, frames: int, ego: EgoMotion) -> ObjectMotion | None:
        """The motion over the last frames; None where it is not known."""
        if len(ego.stamps_ns) <= frames:
            return None
        before, now = ego.stamps_ns[-1 - frames], ego.stamps_ns[-1]
        step = self._motion.step(now, before)
        if step is None:
            return None
        between = ego.poses[-1 - frames].between(ego.poses[-1])
        covariance = ego.step_covariance if frames == 1 else ego.covariance_over(-1 - frames)
        return ObjectMotion.of(step, self._object_T_start, between, covariance)

    def _pose_covariance(self, ego: EgoMotion, object_T_body: gtsam.Pose3) -> FloatArray:
        """(6, 6) of the pose, by those of the platform in the world and in the object's frame."""
        now = ego.stamps_ns[-1]
        inner = self._motion.covariance(now)
        if ego.state.covariance is not None:
            inner = inner + ego.state.covariance[:6, :6]
        adjoint = object_T_body.AdjointMap()
        covariance: FloatArray = adjoint @ inner @ adjoint.T
        return covariance

    def as_ego_motion(self, ego: EgoMotion) -> EgoMotion | None:
        """The motion of the platform in the frame of the object; None if it is not known yet."""
        stamps = [stamp for stamp in ego.stamps_ns if stamp in self._motion.poses]
        if len(stamps) < 3:
            return None
        step = self._motion.step(stamps[-1], stamps[0])
        if step is None:
            return None
        R, P = step.now.rotation().matrix(), step.body_motion()[1]
        seconds = (stamps[-1] - stamps[0]) * 1e-9
        return EgoMotion(
            tuple(stamps),
            tuple(self._motion.poses[stamp] for stamp in stamps),
            np.zeros((len(stamps), 3)),
            replace(ego.state, world_T_body=step.now),
            R @ P[3:, 3:] @ R.T / seconds**2,
            R @ P[:3, :3] @ R.T / seconds**2,
            P,
        )

    def moves_with(self, other: TrackedObject, ego: EgoMotion) -> bool:
        """Whether another object is near and moves as a part of this one.

        The platform has the same motion relative to all parts of a rigid body. As long as it is
        known too badly to tell two bodies apart, they stay two.
        """
        if not (self.confirmed and other.confirmed):
            return False
        apart = float(np.linalg.norm(self.middle(ego) - other.middle(ego)))
        if apart > _NEAR * (self.size() + other.size()):
            return False
        back = self._frames_back(ego)
        steps = [
            item._motion.step(ego.stamps_ns[-1], ego.stamps_ns[-1 - back]) for item in (self, other)
        ]
        if steps[0] is None or steps[1] is None:
            return False
        (mine, P), (theirs, Q) = (step.body_motion() for step in steps if step is not None)
        difference = gtsam.Pose3.Logmap(mine.between(theirs))
        distance = float(difference @ np.linalg.solve(P + Q, difference))
        if distance > chdtri(6, _SAME_MOTION):
            return False
        seconds = -ego.seconds[-1 - back]
        here = ego.poses[-1].inverse().transformFrom
        return all(
            _speed_sigma(P + Q, np.asarray(here(item.middle(ego))), seconds)
            < _POWER * self._config.min_speed
            for item in (self, other)
        )

    def middle(self, ego: EgoMotion) -> FloatArray:
        """(3,) middle of its points now, in the world."""
        pose = self._object_T_start.compose(self._motion.poses[ego.stamps_ns[-1]])
        world_T_object = ego.poses[-1].compose(pose.inverse())
        return np.asarray(world_T_object.transformFrom(self.shape_middle()))

    def shape_middle(self) -> FloatArray:
        """(3,) middle of its points, in its own frame."""
        points = self.points()
        return median(points) if len(points) else np.zeros(3)

    def size(self) -> float:
        """Largest distance of a point from the middle, m."""
        points = self.points()
        if len(points) == 0:
            return 0.0
        return quantile(np.linalg.norm(points - self.shape_middle(), axis=1), 0.9)

    def predicted(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """world_T_object at a later time, if its motion goes on; None if it is not known."""
        state = self.state
        if state is None:
            return None
        seconds = (stamp_ns - state.stamp_ns) * 1e-9
        here = state.world_T_object
        return gtsam.Pose3(here.rotation(), here.translation() + state.velocity * seconds)


def _speed_sigma(covariance: FloatArray, point: FloatArray, seconds: float) -> float:
    """Largest standard deviation, m/s, of the velocity of a point of the body.

    Args:
        covariance: (6, 6) of a motion of the body, in its tangent.
        point: (3,) in the body.
        seconds: time of the motion.
    """
    x, y, z = point
    J = np.hstack([np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]), np.eye(3)])
    return float(np.sqrt(np.linalg.eigvalsh(J @ covariance @ J.T)[-1])) / seconds
