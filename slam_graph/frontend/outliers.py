# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rejection of wrong matches by epipolar geometry, on undistorted normalised coordinates."""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.frontend.config import FrontendConfig

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_POINTS = 8
"""With fewer matches the fundamental matrix fits anything; nothing is rejected then."""

MAX_ITERATIONS = 1000
"""Most samples that RANSAC draws."""


def fundamental_inliers(
    before: FloatArray, after: FloatArray, focal_px: float, config: FrontendConfig
) -> Mask:
    """Which matches between two frames of one camera fit a single rigid motion.

    Args:
        before: (N, 2) normalised coordinates in the earlier frame.
        after: (N, 2) the same points in the later frame.
        focal_px: focal length, which turns the threshold in pixels into one on the plane z = 1.
        config: threshold and confidence.

    Returns:
        (N,) True for inliers.
    """
    if len(before) < MIN_POINTS:
        return np.ones(len(before), np.bool_)
    # OpenCV's solvers expect numbers of the size of pixels
    matrix, inliers = cv2.findFundamentalMat(
        before * focal_px,
        after * focal_px,
        cv2.FM_RANSAC,
        config.ransac_px,
        config.ransac_confidence,
        MAX_ITERATIONS,
    )
    if matrix is None or inliers is None:
        return np.ones(len(before), np.bool_)
    result: Mask = np.asarray(inliers)[:, 0] == 1
    # A sample of seven noisy points fits some of the others badly; all that agree fit them better
    for _ in range(2):
        if np.count_nonzero(result) < MIN_POINTS:
            break
        F = eight_point(before[result], after[result])
        refined: Mask = epipolar_distance(F, before, after) * focal_px < config.ransac_px
        if np.count_nonzero(refined) <= np.count_nonzero(result):
            break
        result = refined
    return result


def eight_point(m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """F (3, 3) with m_bᵀ F m_a ≈ 0 in the least squares sense, of rank 2.

    Normalised coordinates are of the order of one, so the linear system is conditioned well enough
    as it stands (Hartley 1997).
    """
    a = np.column_stack([m_a, np.ones(len(m_a))])
    b = np.column_stack([m_b, np.ones(len(m_b))])
    rows = (b[:, :, None] * a[:, None, :]).reshape(-1, 9)
    _, vectors = np.linalg.eigh(rows.T @ rows)
    U, s, Vt = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    F: FloatArray = (U * [s[0], s[1], 0.0]) @ Vt
    return F


def essential_matrix(b_T_a: gtsam.Pose3) -> FloatArray:
    """E (3, 3) with m_bᵀ E m_a = 0 for the same point seen in a and in b; 0 without a baseline."""
    t = b_T_a.translation()
    E: FloatArray = (
        gtsam.Rot3.Hat(t / max(float(np.linalg.norm(t)), 1e-9)) @ b_T_a.rotation().matrix()
    )
    return E


def epipolar_distance(E: FloatArray, m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """Sampson's distance (N,) of matches (N, 2) from the epipolar constraint, on the plane z = 1.

    To first order it is the length of the smallest correction of the four coordinates that makes
    the match fit (Hartley and Zisserman 2004, eq. 11.9).
    """
    a = np.column_stack([m_a, np.ones(len(m_a))])
    b = np.column_stack([m_b, np.ones(len(m_b))])
    line_b, line_a = a @ E.T, b @ E
    residual = np.abs(np.sum(b * line_b, axis=1))
    gradient = np.sqrt(np.sum(line_a[:, :2] ** 2, axis=1) + np.sum(line_b[:, :2] ** 2, axis=1))
    distance: FloatArray = residual / np.maximum(gradient, 1e-12)
    return distance


def triangulated_depths(b_T_a: gtsam.Pose3, m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """Depths (N, 2) in a and in b of the closest points of the two rays, in metres.

    They are infinite where the rays are parallel, and negative where they meet behind a camera.
    """
    a = np.column_stack([m_a, np.ones(len(m_a))]) @ b_T_a.rotation().matrix().T
    b = np.column_stack([m_b, np.ones(len(m_b))])
    t = b_T_a.translation()
    # z_a a + t = z_b b in the least squares sense
    aa, bb, ab = np.sum(a * a, 1), np.sum(b * b, 1), np.sum(a * b, 1)
    at, bt = a @ t, b @ t
    determinant = aa * bb - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = np.column_stack([ab * bt - bb * at, aa * bt - ab * at]) / determinant[:, None]
    result: FloatArray = np.where(determinant[:, None] < 1e-12, np.inf, depths)
    return result
