# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The other motion that fits a small or flat object nearly as well: Necker's cube.

Seen from far, a body that turns looks like its mirror image that turns the other way: reflect the
points along the line of sight, and the rotation with them. Perspective and the second camera tell
the two apart, the better the larger the object is; few tracks over half a second may not. An
estimator finds one of the two and does not know of the other, so its covariance is that of one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import Observations, is_in
from slam_graph.backend.cost.reprojection import Geometry
from slam_graph.backend.objects.ego_motion import pose_arrays
from slam_graph.backend.objects.track_assignment import MARGIN
from slam_graph.backend.objects.track_window import TrackWindow, squared_errors

_ROUNDS = 3
"""Times that poses and points are fitted to one another."""
CLEARLY = 4.0
"""Factor on the margin from which the mirror image is clearly worse."""
_LEAST_FRAMES = 3
"""Frames that must have seen a track."""
_LEAST_POINTS = 4
"""Points that give a pose."""

_Rays: TypeAlias = tuple[IntArray, FloatArray]
"""Ids (N,), ascending, and normalised coordinates (N, 2)."""


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

        Above `MARGIN` it is at least so much: the motion is taken as it is then. Fitted to the
        tracks once more, as the mirror image is, it would be better still.

        Args:
            members: (N,) ids of the tracks of an object, ascending.
            poses: of the platform in its frame, object_T_body, by the stamps of frames.
        """
        stamps = [stamp for stamp in self._window.stamps_ns if stamp in poses]
        cameras = [poses[stamp].compose(self._body_T_camera) for stamp in stamps]
        tracks = self._tracks(members, stamps)
        fit = self._fit(tracks, cameras)
        if len(fit.ids) < _LEAST_POINTS:
            return 0.0
        mirrored = _mirrored(cameras, fit.points)
        clear = fit.squares + CLEARLY * MARGIN
        best = self._refined(tracks, mirrored, self._fit(tracks, mirrored), clear)
        if best - fit.squares > MARGIN:
            return best - fit.squares
        return best - self._refined(tracks, cameras, fit)

    def _refined(
        self, tracks: _Tracks, cameras: list[gtsam.Pose3], fit: _Fit, clear: float = np.inf
    ) -> float:
        """Least squared errors near some poses of the first camera.

        Or those of an earlier round, where they fall by less from round to round and would stay
        above `clear` even if all rounds that are left lowered them as much as the last one did.
        """
        gain = 0.0
        for left in reversed(range(_ROUNDS)):
            cameras = [
                _resected(pose, fit.ids, fit.points, *rays)
                for pose, rays in zip(cameras, self._rays(tracks, cameras, fit), strict=True)
            ]
            again = self._fit(tracks, cameras)
            if again.squares >= fit.squares:
                break
            before, gain, fit = gain, fit.squares - again.squares, again
            if gain < before and fit.squares - left * gain > clear:
                break
        return fit.squares

    def _fit(self, tracks: _Tracks, cameras: list[gtsam.Pose3]) -> _Fit:
        """The points that the poses give, and how well they fit."""
        obs = tracks.obs
        found = self._window.triangulated(obs, tracks.stamps_ns, self._of_body(cameras))
        finite = np.isfinite(found.points).all(axis=1)
        squares = squared_errors(obs, found, self._sigma_px)
        return _Fit(float(squares.sum()), obs.ids[finite], found.points[finite])

    def _of_body(self, cameras: list[gtsam.Pose3]) -> list[gtsam.Pose3]:
        """Poses of the body from those of the first camera."""
        camera_T_body = self._body_T_camera.inverse()
        return [pose.compose(camera_T_body) for pose in cameras]

    def _rays(self, tracks: _Tracks, cameras: list[gtsam.Pose3], fit: _Fit) -> list[_Rays]:
        """For each frame the features of the first camera, seen from one pose in all rows."""
        poses = self._of_body(cameras)
        still, moving = self._window.projection(), self._window.projection(tracks.stamps_ns, poses)
        if still is moving:
            return tracks.rays
        obs = tracks.obs.subset(is_in(tracks.obs.ids, fit.ids))
        obs = obs.rows(obs.camera == 0)
        at = Geometry(*pose_arrays(tuple(poses[k] for k in obs.frames)), fit.points)
        by_row = still.views(obs, at).normalized - moving.views(obs, at).normalized
        rays, frame = obs.normalized + by_row, np.array(obs.frames)[obs.frame]
        of_frames = [np.flatnonzero(frame == k) for k in range(len(cameras))]
        return [(obs.ids[obs.feature[rows]], rays[rows]) for rows in of_frames]

    def _tracks(self, members: IntArray, stamps: list[int]) -> _Tracks:
        rays = []
        for frame in self._window.frames:
            if frame.stamp_ns in stamps:
                seen = frame.cameras[0]
                order = np.argsort(seen.ids)
                rays.append((seen.ids[order], seen.normalized[order]))
        return _Tracks(stamps, self._window.observations(members, _LEAST_FRAMES, stamps), rays)


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Observations of an object, and for each frame the features of the first camera.

    Attributes:
        stamps_ns: of the frames.
        obs: of its tracks, in all cameras.
        rays: ids (N,), ascending, and normalised coordinates (N, 2) for each frame.
    """

    stamps_ns: list[int]
    obs: Observations
    rays: list[_Rays]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Points by some poses: squared errors of all over σ², their ids (N,) and positions (N, 3)."""

    squares: float
    ids: IntArray
    points: FloatArray


def _mirrored(cameras: list[gtsam.Pose3], points: FloatArray) -> list[gtsam.Pose3]:
    """Poses object_T_camera of the mirror image, whose last one is the same."""
    last = cameras[-1]
    middle = points.mean(axis=0)
    here, reflected = _reflection(last, middle)
    result = []
    for camera in cameras:
        there, other = _reflection(camera, middle)
        turn = camera.rotation().matrix().T @ last.rotation().matrix()
        R = other @ turn @ reflected
        camera_T_last = gtsam.Pose3(gtsam.Rot3(R), there - R @ here)
        result.append(last.compose(camera_T_last.inverse()))
    return result


def _reflection(camera: gtsam.Pose3, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A point (3,) in the camera, and the reflection (3, 3) along the line of sight to it."""
    here = np.asarray(camera.transformTo(point))
    ray = here / np.linalg.norm(here)
    return here, np.eye(3) - 2.0 * np.outer(ray, ray)


def _resected(
    pose: gtsam.Pose3, ids: IntArray, points: FloatArray, seen: IntArray, normalized: FloatArray
) -> gtsam.Pose3:
    """object_T_camera that fits points (N, 3) of features, near a pose."""
    known = is_in(ids, seen)
    if np.count_nonzero(known) < _LEAST_POINTS:
        return pose
    rays = normalized[np.searchsorted(seen, ids[known])]
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
