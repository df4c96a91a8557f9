# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Verification of loop candidates: matched descriptors, and a relative pose that they support.

The relative pose is that from which the second keyframe sees the points of the first: P3P in
RANSAC, refined on the inliers (OpenCV).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray, skew
from slam_graph.loop_closure.loop_config import VerificationConfig
from slam_graph.loop_closure.loop_keyframes import Descriptors, Keyframe
from slam_graph.sensors import RigCamera

MAX_TILT_RAD = 0.05
"""Largest contradiction between the relative pose and the roll and pitch that gravity gives."""
SIGMA_PX = 2.0
"""Standard deviation of reprojection errors, the errors of the points included."""
FLOOR_SIGMAS = np.array([2e-3] * 3 + [5e-3] * 3)
"""Least standard deviations of a relative pose, for the common errors of the points: rad, m."""
FLOOR_SCALE = 2e-3
"""The same of the logarithm of a scale."""
_MIN_DEPTHS = 8
"""Fewest points that both keyframes know from which a scale is taken."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A verified loop closure.

    Attributes:
        first, second: numbers of the keyframes, the earlier one first.
        first_T_second: relative pose of the bodies.
        covariance: (6, 6) of it in GTSAM's tangent: rotation (rad), translation (m).
        inliers, matches: numbers of inliers and of all matches.
        pairs: (inliers, 2) matching rows of the first and the second keyframe.
        scale: length in the unit of the first keyframe of what has length one in that of the
            second; one unless the scale of the run is unknown.
        scale_sigma: standard deviation of its logarithm.
    """

    first: int
    second: int
    first_T_second: gtsam.Pose3
    covariance: FloatArray
    inliers: int
    matches: int
    pairs: IntArray
    scale: float = 1.0
    scale_sigma: float = 0.0


def _match(first: Descriptors, second: Descriptors, max_bits: int) -> IntArray:
    """Pairs (M, 2) of descriptors that are mutual nearest neighbours and differ in few bits."""
    if len(first) == 0 or len(second) == 0:
        return np.zeros((0, 2), np.int64)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
    rows = [(m.queryIdx, m.trainIdx) for m in matches if m.distance <= max_bits]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


class LoopVerifier:
    """Decides whether two keyframes show the same place.

    Args:
        mounted: the first camera.
        config: thresholds.
        has_scale: whether all keyframes have one unit of length.
    """

    def __init__(
        self, mounted: RigCamera, config: VerificationConfig, has_scale: bool = True
    ) -> None:
        self._config, self._mounted, self._has_scale = config, mounted, has_scale
        self._body_T_camera = mounted.body_T_camera
        self._focal_px = float(np.sqrt(mounted.camera.fx * mounted.camera.fy))

    def verify(
        self, keyframes: list[Keyframe], first: int, second: int, gravity: bool = True
    ) -> Loop | None:
        """The loop closure between two keyframes, or None if verification fails.

        Args:
            keyframes: all keyframes.
            first: number of the earlier one.
            second: number of the later one.
            gravity: whether roll and pitch of the keyframes are known.
        """
        config = self._config
        a, b = keyframes[first], keyframes[second]
        known = np.flatnonzero(np.isfinite(a.points).all(axis=1))
        pairs = _match(a.descriptors[known], b.descriptors, config.max_descriptor_bits)
        if len(pairs) < config.min_inliers:
            return None
        points, rays = a.points[known[pairs[:, 0]]], b.normalized[pairs[:, 1]]
        found = self._mounted.body_pose(points, rays, config.max_error_px, config.min_inliers)
        if found is None:
            return None
        pose, inliers = found
        if inliers.sum() < max(config.min_inliers, config.min_inlier_share * len(pairs)):
            return None
        if gravity and tilt_error(a.world_T_body, b.world_T_body, pose) > MAX_TILT_RAD:
            return None
        covariance = self._covariance(points[inliers], pose)
        supporting = np.column_stack([known[pairs[inliers, 0]], pairs[inliers, 1]])
        loop = Loop(first, second, pose, covariance, int(inliers.sum()), len(pairs), supporting)
        return loop if self._has_scale else self._with_scale(loop, a, b)

    def _with_scale(self, loop: Loop, a: Keyframe, b: Keyframe) -> Loop | None:
        """The loop closure with the ratio of the depths of its points; None if it has too few.

        Args:
            loop: without it.
            a: its first keyframe.
            b: its second keyframe.
        """
        rows = loop.pairs[np.isfinite(b.points[loop.pairs[:, 1]]).all(axis=1)]
        if len(rows) < _MIN_DEPTHS:
            return None
        centre = np.asarray(self._body_T_camera.translation())
        pose = loop.first_T_second
        of_first = (a.points[rows[:, 0]] - pose.translation()) @ pose.rotation().matrix() - centre
        of_second = b.points[rows[:, 1]] - centre
        logs = np.log(np.linalg.norm(of_first, axis=1) / np.linalg.norm(of_second, axis=1))
        median = float(np.median(logs))
        # 1.4826 of the median deviation is σ, and a median has π/2 the variance of a mean
        sigma = 1.4826 * float(np.median(np.abs(logs - median))) * np.sqrt(0.5 * np.pi / len(rows))
        return replace(loop, scale=float(np.exp(median)), scale_sigma=max(sigma, FLOOR_SCALE))

    def _covariance(self, points: FloatArray, pose: gtsam.Pose3) -> FloatArray:
        """(6, 6) covariance of the relative pose from the points (M, 3) of its inliers."""
        body = (points - pose.translation()) @ pose.rotation().matrix()
        camera_R_body = self._body_T_camera.rotation().matrix().T
        x, y, z = ((body - self._body_T_camera.translation()) @ camera_R_body.T).T
        zero = np.zeros_like(x)
        by_camera = np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]]).transpose(
            2, 0, 1
        )
        turn = skew(body)
        by_pose = np.concatenate([turn, np.tile(-np.eye(3), (len(points), 1, 1))], axis=2)
        J = (by_camera @ camera_R_body @ by_pose).reshape(-1, 6)
        sigma = SIGMA_PX / self._focal_px
        return np.asarray(sigma**2 * np.linalg.inv(J.T @ J) + np.diag(FLOOR_SIGMAS**2))


def tilt_error(first: gtsam.Pose3, second: gtsam.Pose3, first_T_second: gtsam.Pose3) -> float:
    """Angle, in rad, between the verticals of two poses under a relative pose."""
    up = np.array([0.0, 0.0, 1.0])
    in_first = first.rotation().matrix().T @ up
    transformed = first_T_second.rotation().matrix() @ second.rotation().matrix().T @ up
    return float(np.arccos(np.clip(in_first @ transformed, -1.0, 1.0)))
