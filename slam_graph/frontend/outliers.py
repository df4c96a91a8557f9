# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Outlier rejection: RANSAC on epipolar geometry or on the map, in normalised coordinates."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.kernels.epipolar import constraint_moments, sampson_distances

MIN_POINTS = 8
"""With fewer matches the fundamental matrix fits anything; nothing is rejected then."""

_GROUP_SHARE = 0.1
_GROUP_POINTS = 16
"""Matches that agree on another motion are an object, not errors, if they are this share of all
and this many at least."""

CONFIDENCE = 0.999
"""Probability with which RANSAC draws at least one sample without an outlier."""

_MAX_ITERATIONS = 1000
"""Most samples that RANSAC draws."""

_PNP_ITERATIONS = 100
"""Most samples of PnP's RANSAC, which starts from a predicted pose."""

_DIRECTION_SAMPLES = 64
"""Samples of two points: with half of the matches wrong, one sample in four is good."""


def coherent_groups(
    inliers: Callable[[IntArray], BoolArray], rest: IntArray, count: int
) -> list[IntArray]:
    """Further rigid motions among the RANSAC outliers.

    They are kept as inliers, because images alone cannot say which motion is relative to the static
    world: a moving object that is near or rich in texture has more features than the background.
    The back end can tell, from the IMU.

    Args:
        inliers: which of the matches, given by their rows (N,), fit the motion of most of them.
        rest: (M,) rows of the outliers.
        count: number of all matches.

    Returns:
        Rows of each group, ascending.
    """
    needed = max(_GROUP_POINTS, _GROUP_SHARE * count)
    groups: list[IntArray] = []
    while len(rest) >= needed:
        group = rest[inliers(rest)]
        if len(group) < needed:
            break
        groups.append(group)
        rest = np.setdiff1d(rest, group, assume_unique=True)
    return groups


def fundamental_inliers(
    before: FloatArray,
    after: FloatArray,
    focal_px: float,
    config: FrontendConfig,
    scale: float = 1.0,
) -> BoolArray:
    """Which matches between two frames of one camera fit a single rigid motion.

    Args:
        before: (N, 2) normalised coordinates in the earlier frame.
        after: (N, 2) the same points in the later frame.
        focal_px: focal length, which turns the threshold in pixels into one on the plane z = 1.
        config: method and threshold.
        scale: factor on the threshold.

    Returns:
        (N,) True for inliers.
    """
    if len(before) < MIN_POINTS:
        return np.ones(len(before), np.bool_)
    tolerance_px = scale * config.epipolar_px
    result = _sampled(before, after, focal_px, config, tolerance_px)
    if result is None:
        return np.ones(len(before), np.bool_)
    # A model of a few noisy points misses inliers that one of all inliers so far fits
    count = np.count_nonzero(result)
    for _ in range(2):
        if count < MIN_POINTS:
            break
        rows = result.nonzero()[0]  # `take` needs a fifth of the time of a mask
        F = eight_point(before.take(rows, axis=0), after.take(rows, axis=0))
        refined: BoolArray = epipolar_distance(F, before, after) * focal_px < tolerance_px
        more = np.count_nonzero(refined)
        if more <= count:
            break
        result, count = refined, more
    return result


def _sampled(
    before: FloatArray,
    after: FloatArray,
    focal_px: float,
    config: FrontendConfig,
    tolerance_px: float,
) -> BoolArray | None:
    """The inliers (N,) of the best sample of OpenCV's RANSAC; None if it finds no model."""
    if config.outliers == "essential":
        # five points, calibrated: only a rotation and a direction of motion are estimated
        matrix, inliers = cv2.findEssentialMat(
            before,
            after,
            np.eye(3),
            cv2.RANSAC,
            CONFIDENCE,
            tolerance_px / focal_px,
            _MAX_ITERATIONS,
        )
    else:
        # OpenCV's solvers expect numbers of the size of pixels
        matrix, inliers = cv2.findFundamentalMat(
            before * focal_px,
            after * focal_px,
            cv2.USAC_MAGSAC if config.outliers == "magsac" else cv2.FM_RANSAC,
            tolerance_px,
            CONFIDENCE,
            _MAX_ITERATIONS,
        )
    if matrix is None or inliers is None:
        return None
    found: BoolArray = np.asarray(inliers)[:, 0] == 1
    return found


def direction_inliers(
    before: FloatArray,
    after: FloatArray,
    after_R_before: FloatArray,
    focal_px: float,
    config: FrontendConfig,
    rng: np.random.Generator,
    scale: float = 1.0,
) -> BoolArray:
    """Which matches fit a motion whose rotation is known, by 2-point RANSAC.

    With the rotation given, the planes of all matches contain the translation: their normals
    n = R f × f' are orthogonal to it, and two of them give its direction n₁ × n₂ (Troiani et al.
    2014).

    Args:
        before: (N, 2) normalised coordinates in the earlier frame.
        after: (N, 2) the same points in the later frame.
        after_R_before: (3, 3) rotation of the camera, e.g. from the gyroscope.
        focal_px: focal length.
        config: threshold.
        rng: draws the samples.
        scale: factor on the threshold.

    Returns:
        (N,) True for inliers.
    """
    n = len(before)
    if n < MIN_POINTS:
        return np.ones(n, np.bool_)
    turned = np.column_stack([before, np.ones(n)]) @ after_R_before.T
    ahead = np.maximum(turned[:, 2:], 1e-3)
    turned, seen = turned / ahead, np.column_stack([after, np.ones(n)])
    normals = np.cross(turned, seen)
    first, second = rng.integers(0, n, (2, _DIRECTION_SAMPLES))
    directions = np.cross(normals[first], normals[second])
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 0] / length[length > 0, None]
    # m'ᵀ [t]× R m = t · n, and its gradients by m and m' are of the length |t × m|, first two rows
    tolerance = scale * config.epipolar_px / focal_px
    if len(directions) == 0:
        return np.ones(n, np.bool_)
    best = _within(directions, normals, turned, seen, tolerance)
    inlier: BoolArray = best[np.argmax(np.count_nonzero(best, axis=1))]
    for _ in range(2):
        _, vectors = np.linalg.eigh(normals[inlier].T @ normals[inlier])
        refined = _within(vectors[:, :1].T, normals, turned, seen, tolerance)[0]
        if np.count_nonzero(refined) <= np.count_nonzero(inlier):
            break
        inlier = refined
    return inlier


def _within(
    directions: FloatArray, normals: FloatArray, a: FloatArray, b: FloatArray, tolerance: float
) -> BoolArray:
    """Whether the Sampson distance (K, N) for each direction of motion (K, 3) is small."""
    residual = np.abs(directions @ normals.T)
    tx, ty, tz = (directions[:, i, None] for i in range(3))

    def squared_gradient(m: FloatArray) -> FloatArray:
        x, y = m[:, 0], m[:, 1]
        squared: FloatArray = (ty - tz * y) ** 2 + (tz * x - tx) ** 2
        return squared

    gradient = np.sqrt(squared_gradient(a) + squared_gradient(b))
    close: BoolArray = residual < tolerance * np.maximum(gradient, 1e-9)
    return close


def map_inliers(
    points: FloatArray,
    normalized: FloatArray,
    guess: gtsam.Pose3,
    focal_px: float,
    config: FrontendConfig,
) -> BoolArray:
    """Which observations fit one pose against known points, by PnP with RANSAC.

    Args:
        points: (N, 3) in the world.
        normalized: (N, 2) where the camera sees them.
        guess: camera_T_world to start from.
        focal_px: focal length.
        config: `map_check_px`.

    Returns:
        (N,) True for inliers; all where there are too few to tell, or no pose fits most of them.
    """
    everything = np.ones(len(points), np.bool_)
    if len(points) < MIN_POINTS or config.map_check_px is None:
        return everything
    found, _, _, inliers = cv2.solvePnPRansac(
        points,
        normalized,
        np.eye(3),
        None,
        # copies, because OpenCV overwrites them
        rvec=np.array(gtsam.Rot3.Logmap(guess.rotation())).reshape(3, 1),
        tvec=np.array(guess.translation()).reshape(3, 1),
        useExtrinsicGuess=True,
        iterationsCount=_PNP_ITERATIONS,
        reprojectionError=config.map_check_px / focal_px,
        confidence=CONFIDENCE,
    )
    if not found or inliers is None or 2 * len(inliers) < len(points):
        return everything
    fits = np.zeros(len(points), np.bool_)
    fits[np.ravel(inliers)] = True
    return fits


def eight_point(m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """F (3, 3) with m_bᵀ F m_a ≈ 0 in the least squares sense, of rank 2.

    Normalised coordinates are of the order of one, so the linear system is conditioned well enough
    as it stands (Hartley 1997).
    """
    # OpenCV's solvers of small matrices take a quarter of the time of LAPACK's in NumPy
    _, _, vectors = cv2.eigen(constraint_moments(_contiguous(m_a), _contiguous(m_b)))
    s, U, Vt = cv2.SVDecomp(vectors[8].reshape(3, 3))
    s[2, 0] = 0.0
    F: FloatArray = (U * s.T) @ Vt
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
    return sampson_distances(_contiguous(E), _contiguous(m_a), _contiguous(m_b))


def _contiguous(values: FloatArray) -> FloatArray:
    """As kernels take them."""
    return np.ascontiguousarray(values, np.float64)
