# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is known of an object at one time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.objects.relative_motion import RelativeStep
from slam_graph.backend.world_gauge import gauge_motion


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """The motion of an object between two frames.

    Attributes:
        before_ns, now_ns: their times, on the clock of the cameras.
        motion: before_T_now of the object's own frame, L_before⁻¹ L_now.
        covariance: (6, 6) of its tangent: rotation (rad), translation (m), axes of the object now.
    """

    before_ns: int
    now_ns: int
    motion: gtsam.Pose3
    covariance: FloatArray

    @property
    def seconds(self) -> float:
        """Time between the frames."""
        return (self.now_ns - self.before_ns) * 1e-9

    @property
    def statistic(self) -> float:
        """Squared Mahalanobis distance from no motion: χ² of six degrees of freedom if it rests."""
        tangent = gtsam.Pose3.Logmap(self.motion)
        return float(tangent @ np.linalg.solve(self.covariance, tangent))

    @staticmethod
    def of(
        step: RelativeStep,
        object_T_start: gtsam.Pose3,
        ego: gtsam.Pose3,
        ego_covariance: FloatArray,
    ) -> ObjectMotion:
        """The motion in the world: of the platform in the frame of the object, and in the world.

        With Y = object_T_body and the motion U of the platform, M = Y₀ U Y₁⁻¹. Errors on the right
        of each, a of Y₀, e of U and b of Y₁, are one of M: Ad(Y₁) (Ad(U⁻¹) a + e - b).

        Args:
            step: in the frame of the object's estimator.
            object_T_start: of that frame in the object's.
            ego: before_T_now of the platform.
            ego_covariance: (6, 6) of its tangent.
        """
        before, now = object_T_start.compose(step.before), object_T_start.compose(step.now)
        motion = before.compose(ego).compose(now.inverse())
        J = np.hstack([ego.inverse().AdjointMap(), -np.eye(6)])
        inner = J @ step.covariance @ J.T + ego_covariance
        outer = now.AdjointMap()
        covariance = outer @ inner @ outer.T
        return ObjectMotion(step.before_ns, step.now_ns, motion, 0.5 * (covariance + covariance.T))


@dataclass(frozen=True, eq=False)
class ObjectState:
    """An object at one time.

    Attributes:
        stamp_ns: time of the frame, on the clock of the cameras.
        number: of the object.
        label: of its mask; 0 without one.
        world_T_object: its pose. The frame of an object has the axes that the world had and its
            origin in the middle of the points where the object was found first.
        covariance: (6, 6) of the tangent of the pose.
        world_T_body: the platform then.
        step: motion since the frame before; None where it is not known.
        velocity: (3,) of its origin, mean over the last frames, m/s, in the world.
        velocity_covariance: (3, 3).
        moving: whether it is known to move.
        points: number of its tracks in this frame.
    """

    stamp_ns: int
    number: int
    label: int
    world_T_object: gtsam.Pose3
    covariance: FloatArray
    world_T_body: gtsam.Pose3
    step: ObjectMotion | None
    velocity: FloatArray
    velocity_covariance: FloatArray
    moving: bool
    points: int

    def moved(self, motion: gtsam.Pose3) -> ObjectState:
        """The same in a world that is moved by `new_T_old`."""
        R = motion.rotation().matrix()
        return replace(
            self,
            world_T_object=motion.compose(self.world_T_object),
            world_T_body=motion.compose(self.world_T_body),
            velocity=R @ self.velocity,
            velocity_covariance=R @ self.velocity_covariance @ R.T,
        )

    def with_unknown_gauge(self, unknown: FloatArray, centre: FloatArray) -> ObjectState:
        """The same with the uncertainty of the gauge of its world added to that of the pose.

        Args:
            unknown: (4, 4) or (6, 6) covariance of the gauge (m, rad).
            centre: (3,) the point about which the world turns.
        """
        arm = self.world_T_object.translation() - centre
        N = gauge_motion(arm[None], level=len(unknown) == 4)[0]
        object_R_world = self.world_T_object.rotation().matrix().T
        N = np.vstack([object_R_world @ N[:3], object_R_world @ N[3:]])
        return replace(self, covariance=self.covariance + N @ unknown @ N.T)
