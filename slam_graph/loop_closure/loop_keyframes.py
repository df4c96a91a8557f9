# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes for loop closure: what was seen from where, as it was estimated then.

What a keyframe looks like: descriptors of its tracked features, and of further corners.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import FeatureTracks
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.frontend.descriptors import Orb
from slam_graph.frontend.keypoints import Image, Keypoints
from slam_graph.geometry.interpolation import interpolate
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.loop_closure.loop_config import KeyframeConfig
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations
from slam_graph.sensors.rig import Rig

CORNER_QUALITY, CORNER_DISTANCE_PX = 0.01, 8
PATCH_PX = 31.0
NOT_TRACKED = -1
"""Id of the further corners."""


class KeyframeDescriber:
    """Describes what one camera sees.

    Descriptors are ORB's, upright and of one size: a platform that comes back to a place holds its
    camera upright again, and what is turned with the image says less.

    Args:
        camera: that takes the images.
        corners: how many corners are added to the tracked features.
    """

    def __init__(self, camera: Camera, corners: int) -> None:
        self._camera = camera
        self._corners = corners
        self._descriptor = Orb()

    def describe(self, image: Image, seen: FeatureObservations) -> FeatureObservations:
        """The features of an image with descriptors, followed by further corners.

        Features too close to the edge to be described are left out.
        """
        found = self._further_corners(image, seen.pixels)
        pixels = np.concatenate([seen.pixels, found])
        points = Keypoints.of(pixels.astype(np.float32), np.ones(len(pixels), np.float32), PATCH_PX)
        kept, descriptors = self._descriptor.describe(image, points)
        ids = np.concatenate([seen.ids, np.full(len(found), NOT_TRACKED)])
        normalized = np.concatenate([seen.normalized, self._camera.undistort(found)])
        return FeatureObservations(
            ids[kept], pixels[kept], normalized[kept], descriptors.astype(np.uint8)
        )

    def _further_corners(self, image: Image, taken: np.ndarray) -> np.ndarray:
        """Corners (N, 2) that are not where features are already."""
        if self._corners == 0:
            return np.zeros((0, 2))
        free = np.full(image.shape, 255, np.uint8)
        for u, v in np.rint(taken).astype(int).tolist():
            cv2.circle(free, (u, v), CORNER_DISTANCE_PX, 0, -1)
        corners = cv2.goodFeaturesToTrack(
            image, self._corners, CORNER_QUALITY, CORNER_DISTANCE_PX, mask=free
        )
        found = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        return found[np.isfinite(self._camera.undistort(found)).all(axis=1)]


Descriptors = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A place that one may come back to.

    Attributes:
        stamp_ns: time.
        world_T_body: causal estimate of the pose.
        ids: (N,) features that the first camera sees; -1 for corners that are not tracked.
        normalized: (N, 2) where, on the plane z = 1.
        descriptors: (N, B) what they look like.
        points: (N, 3) where they are in the body frame, in metres; NaN where that is not known.
    """

    stamp_ns: int
    world_T_body: gtsam.Pose3
    ids: IntArray
    normalized: FloatArray
    descriptors: Descriptors
    points: FloatArray

    def world_points(self, world_T_body: gtsam.Pose3 | None = None) -> tuple[IntArray, FloatArray]:
        """Ids (M,) and world positions (M, 3) of known points, seen from this pose or another."""
        pose = world_T_body or self.world_T_body
        known = np.isfinite(self.points).all(axis=1)
        rotation = pose.rotation().matrix()
        return self.ids[known], self.points[known] @ rotation.T + pose.translation()


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A recent frame and where it was taken."""

    frame: FeatureFrame
    rotation: FloatArray
    position: FloatArray


class KeyframeLog:
    """Picks keyframes from a run and triangulates what they see.

    Points are triangulated from a few recent frames at their causal poses: over so short a way the
    estimator does not drift, and whatever it has drifted before moves points and keyframe alike.

    Args:
        rig: the cameras.
        config: how dense keyframes are.

    Attributes:
        keyframes: so far.
    """

    def __init__(self, rig: Rig, config: KeyframeConfig) -> None:
        self.keyframes: list[Keyframe] = []
        self._config = config
        self._projection = RigProjection(rig)
        camera = rig.cameras[0].camera
        self._describer = KeyframeDescriber(camera, config.further_corners)
        self._focal_px = float(np.sqrt(camera.fx * camera.fy))
        self._recent: deque[_View] = deque(maxlen=config.points_from_frames)

    def add(
        self, frame: FeatureFrame, world_T_body: gtsam.Pose3, image: Image | None = None
    ) -> Keyframe | None:
        """Take a frame, and the keyframe that it has become, if any.

        Args:
            frame: features; those of the first camera with descriptors if there is no image.
            world_T_body: causal estimate of the pose then.
            image: of the first camera.
        """
        wanted = self._is_keyframe(frame, world_T_body)
        spacing_ns = self._config.frame_spacing_s * 1e9
        if self._recent and frame.stamp_ns - self._recent[-1].frame.stamp_ns < spacing_ns:
            if not wanted:
                return None
            self._recent.pop()
        rotation = world_T_body.rotation().matrix()
        self._recent.append(_View(frame, rotation, world_T_body.translation()))
        seen = frame.cameras[0]
        if wanted and image is not None:
            seen = self._describer.describe(image, seen)
        if not wanted or seen.descriptors is None or len(seen) == 0:
            return None
        points = self._points(seen.ids)
        body_points = (points - world_T_body.translation()) @ rotation
        keyframe = Keyframe(
            frame.stamp_ns, world_T_body, seen.ids, seen.normalized, seen.descriptors, body_points
        )
        self.keyframes.append(keyframe)
        return keyframe

    def _is_keyframe(self, frame: FeatureFrame, world_T_body: gtsam.Pose3) -> bool:
        if not self.keyframes:
            return True
        last, config = self.keyframes[-1], self._config
        moved = last.world_T_body.between(world_T_body)
        turn = float(np.linalg.norm(gtsam.Rot3.Logmap(moved.rotation())))
        way = float(np.linalg.norm(moved.translation()))
        if way >= config.distance_m or turn >= config.angle_rad:
            return True
        # what is new is triangulated from frames that the last keyframe did not use
        since_s = (frame.stamp_ns - last.stamp_ns) * 1e-9
        if since_s < config.points_from_frames * config.frame_spacing_s:
            return False
        tracked = last.ids[last.ids >= 0]
        common = np.isin(tracked, frame.cameras[0].ids)
        return len(common) > 0 and bool(np.mean(common) < config.min_common_features)

    def _points(self, ids: IntArray) -> FloatArray:
        """Where features (N,) are in the world, (N, 3); NaN where that is not known."""
        window = FeatureTracks()
        for index, view in enumerate(self._recent):
            window.add(index, view.frame)
        obs = window.observations(np.unique(ids))
        obs = obs.subset(obs.counts >= 2)
        points = np.full((len(ids), 3), np.nan)
        if len(obs) == 0:
            return points
        rotations = np.array([self._recent[i].rotation for i in obs.frames])
        positions = np.array([self._recent[i].position for i in obs.frames])
        found = triangulate(obs, self._projection, rotations, positions, self._config.triangulation)
        good = found.good & (found.reprojection_px < self._config.max_reprojection_px)
        good &= found.depth_error < self._config.max_depth_error * self._focal_px
        place = np.minimum(np.searchsorted(obs.ids, ids), len(obs.ids) - 1)
        known = good[place] & (obs.ids[place] == ids)
        points[known] = found.points[place[known]]
        return points


def reposed(keyframes: list[Keyframe], trajectory: Trajectory) -> list[Keyframe]:
    """Keyframes at the poses of a trajectory; those that it does not reach stay."""
    found, valid = interpolate(trajectory, np.array([k.stamp_ns for k in keyframes]))
    keyframes = list(keyframes)
    for row, number in enumerate(np.flatnonzero(valid).tolist()):
        keyframes[number] = replace(keyframes[number], world_T_body=found.pose(row))
    return keyframes
