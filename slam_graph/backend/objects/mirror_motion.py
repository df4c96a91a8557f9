# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The other motion that fits a small or flat object nearly as well: Necker's cube.

Seen from far, a body that turns looks like its mirror image that turns the other way: reflect the
points along the line of sight, and the rotation with them. Perspective and the second camera tell
the two apart, the better the larger the object is; few tracks over half a second may not. An
estimator finds one of the two and does not know of the other, so its covariance is that of one.
"""

from __future__ import annotations

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.sensors import FeatureObservations

_ROUNDS = 3
"""Times that poses and points are fitted to one another."""
_LEAST_POINTS = 4
"""Points that give a pose."""


class MirrorMotion:
    """Compares a motion with its mirror image.

    Args:
        window: the last frames.
        sigma_px: standard deviation of the observations.
    """

    def __init__(self, window: TrackWindow, sigma_px: float) -> None:
        self._window, self._sigma_px = window, sigma_px
        self._body_T_camera = window.rig.cameras[0].body_T_camera

    def worse(self, members: IntArray, poses: dict[int, gtsam.Pose3]) -> float:
        """Squared errors over σ² of the mirror image less those of the motion.

        Args:
            members: (N,) ids of the tracks of an object, ascending.
            poses: of the platform in its frame, object_T_body, by the stamps of frames.
        """
        stamps = [stamp for stamp in self._window.stamps_ns if stamp in poses]
        cameras = {s: poses[s].compose(self._body_T_camera) for s in stamps}
        ids, points = self._points(members, cameras)
        if len(ids) < _LEAST_POINTS:
            return 0.0
        mirrored = self._fitted(members, _mirrored(cameras, points))
        return mirrored - self._fitted(members, cameras)

    def _fitted(self, members: IntArray, cameras: dict[int, gtsam.Pose3]) -> float:
        """Least squared errors near some poses of the first camera."""
        best = self._squares(members, cameras)
        for _ in range(_ROUNDS):
            cameras = self._resected(members, cameras)
            squares = self._squares(members, cameras)
            if squares >= best:
                break
            best = squares
        return best

    def _squares(self, members: IntArray, cameras: dict[int, gtsam.Pose3]) -> float:
        return float(self._window.misfit(members, self._bodies(cameras), self._sigma_px)[1].sum())

    def _points(
        self, members: IntArray, cameras: dict[int, gtsam.Pose3]
    ) -> tuple[IntArray, FloatArray]:
        return self._window.points(members, self._bodies(cameras))

    def _bodies(self, cameras: dict[int, gtsam.Pose3]) -> dict[int, gtsam.Pose3]:
        camera_T_body = self._body_T_camera.inverse()
        return {stamp: pose.compose(camera_T_body) for stamp, pose in cameras.items()}

    def _resected(
        self, members: IntArray, cameras: dict[int, gtsam.Pose3]
    ) -> dict[int, gtsam.Pose3]:
        """The poses that fit the points which these poses have."""
        ids, points = self._points(members, cameras)
        result = dict(cameras)
        for frame in self._window.frames:
            if frame.stamp_ns in cameras:
                seen = frame.cameras[0]
                result[frame.stamp_ns] = _resected(cameras[frame.stamp_ns], ids, points, seen)
        return result


def _mirrored(cameras: dict[int, gtsam.Pose3], points: FloatArray) -> dict[int, gtsam.Pose3]:
    """Poses object_T_camera of the mirror image, whose last one is the same."""
    stamps = sorted(cameras)
    last = cameras[stamps[-1]]
    middle = points.mean(axis=0)
    here, reflected = _reflection(last, middle)
    result = {}
    for stamp in stamps:
        there, other = _reflection(cameras[stamp], middle)
        turn = cameras[stamp].rotation().matrix().T @ last.rotation().matrix()
        R = other @ turn @ reflected
        camera_T_last = gtsam.Pose3(gtsam.Rot3(R), there - R @ here)
        result[stamp] = last.compose(camera_T_last.inverse())
    return result


def _reflection(camera: gtsam.Pose3, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A point (3,) in the camera, and the reflection (3, 3) along the line of sight to it."""
    here = np.asarray(camera.transformTo(point))
    ray = here / np.linalg.norm(here)
    return here, np.eye(3) - 2.0 * np.outer(ray, ray)


def _resected(
    pose: gtsam.Pose3, ids: IntArray, points: FloatArray, seen: FeatureObservations
) -> gtsam.Pose3:
    """object_T_camera that fits points (N, 3) of features, near a pose."""
    order = np.argsort(seen.ids)
    known = np.isin(ids, seen.ids)
    if np.count_nonzero(known) < _LEAST_POINTS:
        return pose
    rays = seen.normalized[order][np.searchsorted(seen.ids[order], ids[known])]
    camera_T_object = pose.inverse()
    rotation, translation = cv2.solvePnPRefineLM(
        np.ascontiguousarray(points[known]),
        np.ascontiguousarray(rays),
        np.eye(3),
        None,
        cv2.Rodrigues(camera_T_object.rotation().matrix())[0],
        np.array(camera_T_object.translation()).reshape(3, 1),
    )
    R = gtsam.Rot3(cv2.Rodrigues(rotation)[0])
    return gtsam.Pose3(R, np.asarray(translation).ravel()).inverse()
