# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of loop closure and maps: pose, descriptors and triangulated points of one frame.

They are further apart than the keyframes of the smoother, and chosen by distance instead of time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeAlias

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend import PosedFrame
from slam_graph.frontend import DESCRIPTORS, Image, Keypoints
from slam_graph.geometry import Trajectory, interpolate
from slam_graph.loop_closure.loop_config import KeyframeConfig
from slam_graph.sensors import Camera, FeatureFrame, FeatureObservations, Rig

POINT_FRAMES = 10
"""Number of recent frames from which the points of a keyframe are triangulated …"""
POINT_FRAME_SPACING_S = 0.1
"""… and the time between them: within a second the estimator hardly drifts."""
MAX_REPROJECTION_PX = 3.0
"""Points of a larger root-mean-square reprojection error are left out."""
MAX_DEPTH_ERROR = 0.1
"""Points of a larger relative standard deviation of the inverse depth are left out."""
_CORNER_QUALITY, _CORNER_DISTANCE_PX = 0.01, 8
_PATCH_PX = 31.0
_NOT_TRACKED = -1
"""Id of corners that are not tracked."""

Descriptors = NDArray[np.uint8]
"""(N, B) binary descriptors of B bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame as place recognition, loop closure and maps use it.

    Attributes:
        stamp_ns: time.
        world_T_body: estimate of the pose.
        ids: (N,) features seen by the first camera; -1 for corners that are not tracked.
        normalized: (N, 2) observations on the plane z = 1, all from the pose.
        descriptors: (N, B) binary descriptors.
        points: (N, 3) in the body frame, metres; NaN where not triangulated. Drift so moves them
            with the keyframe.
        views: from which they are triangulated, where the scale is unknown: at other poses the
            points have another scale.
    """

    stamp_ns: int
    world_T_body: gtsam.Pose3
    ids: IntArray
    normalized: FloatArray
    descriptors: Descriptors
    points: FloatArray
    views: tuple[PosedFrame, ...] = ()

    def moved(self, motion: gtsam.Pose3) -> Keyframe:
        """The same in a world that is moved by `new_T_old`."""
        views = tuple(view.moved(motion) for view in self.views)
        return replace(self, world_T_body=motion.compose(self.world_T_body), views=views)

    def rescaled(self, scale: float, camera: gtsam.Pose3) -> Keyframe:
        """The same where the path of the camera, at body_T_camera, has another unit of length."""
        centre = camera.translation()
        return replace(
            self,
            world_T_body=PosedFrame.rescaled_pose(self.world_T_body, scale, camera),
            points=centre + scale * (self.points - centre),
            views=tuple(view.rescaled(scale, camera) for view in self.views),
        )

    def world_points(self, world_T_body: gtsam.Pose3 | None = None) -> tuple[IntArray, FloatArray]:
        """Ids (M,) and world positions (M, 3) of the known points, from this pose or another."""
        pose = world_T_body or self.world_T_body
        known = np.isfinite(self.points).all(axis=1)
        rotation = pose.rotation().matrix()
        return self.ids[known], self.points[known] @ rotation.T + pose.translation()


class KeyframeDescriber:
    """Computes the descriptors of a keyframe.

    They are upright ORB descriptors of one scale: platforms hold their camera upright, and without
    the rotation invariance descriptors are more distinctive.

    Args:
        camera: of the images.
        corners: number of corners that are added to the tracked features.
    """

    def __init__(self, camera: Camera, corners: int) -> None:
        self._camera = camera
        self._corners = corners
        self._descriptor = DESCRIPTORS["orb"]()

    def describe(self, image: Image, seen: FeatureObservations) -> FeatureObservations:
        """The tracked features of an image with descriptors, followed by further corners.

        Features too close to the border are left out.
        """
        found = self._further_corners(image, seen.pixels)
        pixels = np.concatenate([seen.pixels, found])
        points = Keypoints.of(
            pixels.astype(np.float32), np.ones(len(pixels), np.float32), _PATCH_PX
        )
        kept, descriptors = self._descriptor.describe(image, points)
        ids = np.concatenate([seen.ids, np.full(len(found), _NOT_TRACKED)])
        normalized = np.concatenate([seen.normalized, self._camera.undistort(found)])
        return FeatureObservations(
            ids[kept], pixels[kept], normalized[kept], descriptors.astype(np.uint8)
        )

    def _further_corners(self, image: Image, taken: FloatArray) -> FloatArray:
        """Corners (N, 2) away from the features."""
        if self._corners == 0:
            return np.zeros((0, 2))
        free = np.full(image.shape, 255, np.uint8)
        for u, v in np.rint(taken).astype(int).tolist():
            cv2.circle(free, (u, v), _CORNER_DISTANCE_PX, 0, -1)
        corners = cv2.goodFeaturesToTrack(
            image, self._corners, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=free
        )
        found = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        return found[np.isfinite(self._camera.undistort(found)).all(axis=1)]


class KeyframeLog:
    """Selects the keyframes of a run and triangulates their points.

    Points are triangulated from the last frames at their causal poses: the drift over this second
    is negligible, and earlier drift moves points and keyframe alike.

    Args:
        rig: the cameras.
        config: the spacing of keyframes.

    Attributes:
        keyframes: so far.
        rig: the cameras, as they are known now.
        LAST_POSES: poses that tell how the body moves while a rolling shutter exposes a frame.
    """

    Describer: TypeAlias = KeyframeDescriber
    LAST_POSES: ClassVar[int] = 3

    def __init__(self, rig: Rig, config: KeyframeConfig) -> None:
        self.keyframes: list[Keyframe] = []
        self._config = config
        self.rig = rig
        camera = rig.cameras[0].camera
        self._describer = KeyframeDescriber(camera, config.further_corners)
        self._focal_px = float(np.sqrt(camera.fx * camera.fy))
        self._recent: deque[PosedFrame] = deque(maxlen=POINT_FRAMES)
        self._last: deque[tuple[int, gtsam.Pose3]] = deque(maxlen=self.LAST_POSES)

    def add(
        self, frame: FeatureFrame, world_T_body: gtsam.Pose3, image: Image | None = None
    ) -> Keyframe | None:
        """Add a frame; returns the keyframe that it becomes, if any.

        Args:
            frame: features; without an image those of the first camera need descriptors.
            world_T_body: causal estimate of its pose.
            image: of the first camera.
        """
        self._last.append((frame.stamp_ns, world_T_body))
        wanted = self._is_keyframe(frame, world_T_body)
        spacing_ns = POINT_FRAME_SPACING_S * 1e9
        if self._recent and frame.stamp_ns - self._recent[-1].frame.stamp_ns < spacing_ns:
            if not wanted:
                return None
            self._recent.pop()
        self._recent.append(PosedFrame.of(frame, tuple(self._last), self.rig))
        seen = frame.cameras[0]
        if wanted and image is not None:
            seen = self._describer.describe(image, seen)
        if not wanted or seen.descriptors is None or len(seen) == 0:
            return None
        views = tuple(self._recent)
        points = self._points(seen.ids, views, world_T_body)
        keyframe = Keyframe(
            frame.stamp_ns,
            world_T_body,
            seen.ids,
            views[-1].unrolled(seen, points, self.rig),
            seen.descriptors,
            points,
            () if self.rig.has_scale else views,
        )
        self.keyframes.append(keyframe)
        return keyframe

    def move(self, motion: gtsam.Pose3, after_ns: int | None = None, scale: float = 1.0) -> None:
        """Go on in a world that is moved by `new_T_old`, with the keyframes after a time.

        Args:
            motion: of the world.
            after_ns: the time; None for all keyframes.
            scale: by which the path of the camera is scaled before.
        """
        keyframes, recent, last = self.keyframes, list(self._recent), list(self._last)
        if scale != 1.0:
            camera = self.rig.cameras[0].body_T_camera
            keyframes = [k if _stays(k, after_ns) else k.rescaled(scale, camera) for k in keyframes]
            recent = [view.rescaled(scale, camera) for view in recent]
            last = [(ns, PosedFrame.rescaled_pose(pose, scale, camera)) for ns, pose in last]
        self.keyframes = [k if _stays(k, after_ns) else k.moved(motion) for k in keyframes]
        self._recent = deque((view.moved(motion) for view in recent), maxlen=POINT_FRAMES)
        moved = ((stamp_ns, motion.compose(pose)) for stamp_ns, pose in last)
        self._last = deque(moved, maxlen=self.LAST_POSES)

    def at(self, trajectory: Trajectory) -> list[Keyframe]:
        """The keyframes at the poses of a trajectory; those outside of it keep their poses.

        Where the scale is unknown, their points are triangulated anew from there.
        """
        found, valid = interpolate(trajectory, np.array([k.stamp_ns for k in self.keyframes]))
        keyframes = list(self.keyframes)
        for row, number in enumerate(np.flatnonzero(valid).tolist()):
            pose, was = found.pose(row), keyframes[number]
            points = self._points_at(was, pose, trajectory) if was.views else was.points
            keyframes[number] = replace(was, world_T_body=pose, points=points)
        return keyframes

    def _is_keyframe(self, frame: FeatureFrame, world_T_body: gtsam.Pose3) -> bool:
        if not self.keyframes:
            return True
        last, config = self.keyframes[-1], self._config
        moved = last.world_T_body.between(world_T_body)
        turn = float(np.linalg.norm(gtsam.Rot3.Logmap(moved.rotation())))
        distance = float(np.linalg.norm(moved.translation()))
        if distance >= config.distance_m or turn >= config.angle_rad:
            return True
        # new features are triangulated from frames that the last keyframe did not use
        since_s = (frame.stamp_ns - last.stamp_ns) * 1e-9
        if since_s < POINT_FRAMES * POINT_FRAME_SPACING_S:
            return False
        tracked = last.ids[last.ids >= 0]
        common = np.isin(tracked, frame.cameras[0].ids)
        return len(common) > 0 and bool(np.mean(common) < config.min_common_features)

    def _points_at(
        self, keyframe: Keyframe, pose: gtsam.Pose3, trajectory: Trajectory
    ) -> FloatArray:
        """(N, 3) points of a keyframe, triangulated from the poses of a trajectory."""
        stamps_ns = np.array([view.frame.stamp_ns for view in keyframe.views])
        found, valid = interpolate(trajectory, stamps_ns)
        used = np.flatnonzero(valid).tolist()
        views = [keyframe.views[k].at(found.pose(row)) for row, k in enumerate(used)]
        return self._points(keyframe.ids, views, pose) if len(views) > 1 else keyframe.points

    def _points(
        self, ids: IntArray, views: Sequence[PosedFrame], world_T_body: gtsam.Pose3
    ) -> FloatArray:
        """(N, 3) points of features (N,) in the body frame; NaN where not triangulated."""
        found = PosedFrame.triangulated(ids, views, self.rig)
        good = found.good & (found.reprojection_px < MAX_REPROJECTION_PX)
        good &= found.depth_error < MAX_DEPTH_ERROR * self._focal_px
        points = np.where(good[:, None], found.points, np.nan)
        body: FloatArray = (points - world_T_body.translation()) @ world_T_body.rotation().matrix()
        return body


def _stays(keyframe: Keyframe, after_ns: int | None) -> bool:
    """Whether a keyframe is not after a time; None for none."""
    return after_ns is not None and keyframe.stamp_ns <= after_ns
