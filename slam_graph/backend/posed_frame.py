# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Frames at known poses, as they are: with depth images, and with rolling shutters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.row_unrolling import unrolled
from slam_graph.backend.cost.triangulation import Triangulation, triangulate_frames
from slam_graph.backend.depth_camera import with_depth_camera, with_depth_observed
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.sensors import FeatureFrame, FeatureObservations, Rig

_MAX_STEP_S = 0.2
"""Poses that are further apart do not tell how the body moves while rows are exposed."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrame:
    """A frame and its pose.

    Attributes:
        frame: its features.
        rotation, position: (3, 3) and (3,) of the body in the world.
        motion: of the body while a rolling shutter exposes the frame; None where it is not known.
    """

    frame: FeatureFrame
    rotation: FloatArray
    position: FloatArray
    motion: FrameMotion | None = None

    @staticmethod
    def of(frame: FeatureFrame, last: Sequence[tuple[int, gtsam.Pose3]], rig: Rig) -> PosedFrame:
        """A frame at the last one of some poses.

        Args:
            frame: its features.
            last: times (ns) and poses world_T_body of up to three frames, in the order of time.
            rig: the cameras.
        """
        pose, motion = last[-1][1], _motion(last, rig) if rig.rolling else None
        return PosedFrame(frame, pose.rotation().matrix(), pose.translation(), motion)

    def at(self, pose: gtsam.Pose3) -> PosedFrame:
        """The frame at another pose."""
        return replace(self, rotation=pose.rotation().matrix(), position=pose.translation())

    def moved(self, motion: gtsam.Pose3) -> PosedFrame:
        """The same in a world that is moved by `new_T_old`."""
        return self.at(motion.compose(gtsam.Pose3(gtsam.Rot3(self.rotation), self.position)))

    def rescaled(self, scale: float, camera: gtsam.Pose3) -> PosedFrame:
        """The same where the path of the camera, at body_T_camera, has another unit of length."""
        pose = gtsam.Pose3(gtsam.Rot3(self.rotation), self.position)
        motion = self.motion and rescaled_motion(self.motion, scale, camera.translation())
        return replace(self.at(self.rescaled_pose(pose, scale, camera)), motion=motion)

    @staticmethod
    def rescaled_pose(world_T_body: gtsam.Pose3, scale: float, camera: gtsam.Pose3) -> gtsam.Pose3:
        """A pose where the path of a camera has another unit of length, and its mounting has not.

        Args:
            world_T_body: with the path of the camera in the old unit.
            scale: new units per old one.
            camera: body_T_camera, in the new unit in either case.
        """
        seen_from = world_T_body.compose(camera)
        there = gtsam.Pose3(seen_from.rotation(), scale * seen_from.translation())
        return there.compose(camera.inverse())

    def unrolled(self, seen: FeatureObservations, points: FloatArray, rig: Rig) -> FloatArray:
        """(N, 2) where the first camera sees features on the plane z = 1, all from the pose.

        Args:
            seen: N features.
            points: (N, 3) in the body frame; those with NaN are taken to be as far as the others.
            rig: the cameras.
        """
        camera = rig.cameras[0].body_T_camera
        depths = (points - camera.translation()) @ camera.rotation().matrix()[:, 2]
        known = np.isfinite(depths)
        depths[~known] = np.median(depths[known]) if known.any() else np.inf
        return unrolled(seen, np.arange(len(seen)), rig, self.motion, depths)

    @staticmethod
    def triangulated(ids: IntArray, frames: Sequence[PosedFrame], rig: Rig) -> Triangulation:
        """Features (J,), in any order, from frames at their poses; see `triangulate_frames`.

        What a depth sensor measures counts as what a further camera sees. With a rolling shutter
        only those frames count whose motion is known, if that of any is.
        """
        frames = [posed for posed in frames if posed.motion is not None] or frames
        return triangulate_frames(
            ids,
            [with_depth_observed(posed.frame, rig) for posed in frames],
            np.array([posed.rotation for posed in frames]),
            np.array([posed.position for posed in frames]),
            with_depth_camera(rig),
            {k: posed.motion for k, posed in enumerate(frames) if posed.motion is not None},
        )


def _motion(last: Sequence[tuple[int, gtsam.Pose3]], rig: Rig) -> FrameMotion | None:
    """How the body moves at the last of up to three poses, at most linearly; None if unknown."""
    steps: list[tuple[float, FloatArray]] = []
    for (before_ns, before), (now_ns, now) in pairwise(last):
        seconds = (now_ns - before_ns) * 1e-9
        near = 0.0 < seconds < _MAX_STEP_S
        step = seconds, gtsam.Pose3.Logmap(before.between(now)) / seconds
        steps = [*steps, step] if near else []
    if not steps:
        return None
    seconds, rate = steps[-1]
    change = np.zeros(6)
    if len(steps) > 1:
        change = 2.0 * (rate - steps[0][1]) / (seconds + steps[0][0])
        rate = rate + 0.5 * seconds * change
        change[3:] += np.cross(rate[:3], rate[3:])  # of the velocity, not of its coordinates
    return FrameMotion(rate, rig.pose_offset_s, change)


def rescaled_motion(motion: FrameMotion, scale: float, arm: FloatArray) -> FrameMotion:
    """How the body moves while a frame is taken, its velocity in another unit of length.

    Args:
        motion: of the body.
        scale: new units per old one.
        arm: (3,) position in the body of the camera whose path is scaled, in the new unit.
    """
    rate, change, factor = motion.rate.copy(), motion.change.copy(), scale - 1.0
    turning = np.cross(rate[:3], arm)
    rate[3:] = scale * rate[3:] + factor * turning
    towards = np.cross(change[:3], arm) + np.cross(rate[:3], turning)
    change[3:] = scale * change[3:] + factor * towards
    return replace(motion, rate=rate, change=change)
