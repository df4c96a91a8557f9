# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera by points that it sees.

By PnP with RANSAC (OpenCV), or by steps from a pose that is nearly right.
"""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
from cv2.typing import MatLike

from slam_graph.arrays import BoolArray, FloatArray, median

RANSAC_ITERATIONS = 200
_CONFIDENCE = 0.999
_TIGHTENED = 2
"""How often the points that fit are chosen again."""
_MAX_MEDIANS = 2.1
"""Largest error of these, in medians: 95 % of two-dimensional normal errors are smaller."""
_FEWEST = 6
"""Fewer points are no better choice."""

_SCALES = np.array([16.0, 8.0, 4.0, 2.0])
"""Of a robust loss, in errors of points that fit: with each step from a guess more errors count as
outliers."""
_LAST_STEPS = np.full(2, np.inf)
"""Steps over the points that fit, without a loss."""


def camera_pose(
    points: FloatArray, rays: FloatArray, error: float, least: int = 4, tightened: bool = False
) -> tuple[gtsam.Pose3, BoolArray] | None:
    """camera_T_points of known points that a camera sees, and which of them fit it.

    Samples of three points and one (AP3P: Ke & Roumeliotis 2017), then Levenberg-Marquardt over
    the inliers.

    Args:
        points: (N, 3) m.
        rays: (N, 2) where the camera sees them, on its plane z = 1.
        error: largest error on that plane of a point that fits.
        least: how many points must fit the best sample.
        tightened: whether the points that fit are chosen again by their own errors, not all of
            those within `error`: something that moves slowly would pull the pose.

    Returns:
        The pose, and (N,) which points are in front of the camera and fit; None without a pose.
    """
    cv2.setRNGSeed(0)  # OpenCV draws from one global generator
    points, rays = np.ascontiguousarray(points), np.ascontiguousarray(rays)
    found, rotation, translation, rows = cv2.solvePnPRansac(
        points,
        rays,
        np.eye(3),
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=error,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or rows is None or len(rows) < least:
        return None
    chosen = rows[:, 0]
    for refined in range(_TIGHTENED if tightened else 1):
        if tightened:
            errors = _errors(points, rays, rotation, translation)
            fitting = errors[errors < error]
            limit = min(error, _MAX_MEDIANS * float(np.median(fitting))) if len(fitting) else 0.0
            tighter = np.flatnonzero(errors < limit)
            if len(tighter) >= max(least, _FEWEST):
                chosen = tighter
            elif refined:
                break
        rotation, translation = cv2.solvePnPRefineLM(
            points[chosen], rays[chosen], np.eye(3), None, rotation, translation
        )
    pose = gtsam.Pose3(gtsam.Rot3(cv2.Rodrigues(rotation)[0]), translation[:, 0])
    return pose, _errors(points, rays, rotation, translation) < error


def pose_from_guess(
    points: FloatArray, rays: FloatArray, error: float, guess: gtsam.Pose3, least: int = 4
) -> tuple[gtsam.Pose3, BoolArray] | None:
    """camera_T_points as `camera_pose` with `tightened` finds it, from a pose that is nearly right.

    Gauss-Newton steps under a loss that narrows, so that no samples are drawn. From a guess that is
    not good enough few points fit in the end.

    Args:
        points: (N, 3) m.
        rays: (N, 2) where the camera sees them, on its plane z = 1.
        error: largest error on that plane of a point that fits.
        guess: camera_T_points.
        least: how many points must fit.

    Returns:
        The pose, and (N,) which points are in front of the camera and fit; None without a pose.
    """
    from slam_graph.kernels.pose_steps import pose_steps  # which loads kernels

    points, rays = np.ascontiguousarray(points), np.ascontiguousarray(rays)
    pose, errors = np.ascontiguousarray(guess.matrix()[:3]), np.empty(len(points))
    pose_steps(points, rays, np.ones(len(points), np.bool_), error * _SCALES, pose, errors)
    for _ in range(_TIGHTENED):
        fitting = errors[errors < error]
        if len(fitting) < least:
            return None
        chosen = errors < min(error, _MAX_MEDIANS * float(median(fitting)))
        if np.count_nonzero(chosen) < _FEWEST:
            break
        pose_steps(points, rays, chosen, _LAST_STEPS, pose, errors)
    if not np.isfinite(pose).all():
        return None
    return gtsam.Pose3(gtsam.Rot3(pose[:, :3]), pose[:, 3]), errors < error


def _errors(
    points: FloatArray, rays: FloatArray, rotation: MatLike, translation: MatLike
) -> FloatArray:
    """How far (N,) points are from where they are seen, on the plane z = 1; infinite if behind."""
    seen = cv2.projectPoints(points, rotation, translation, np.eye(3), None)[0][:, 0]
    ahead = (points @ cv2.Rodrigues(rotation)[0].T + translation.T)[:, 2] > 0
    return np.asarray(np.where(ahead, np.linalg.norm(seen - rays, axis=1), np.inf))
