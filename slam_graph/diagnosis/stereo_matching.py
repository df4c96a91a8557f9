# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matches between the first two cameras that use no calibration, so that they can check it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.sensors import FeatureFrame

_KEYPOINTS = 700
"""SIFT keypoints of an image."""
_PART_PX, _OVERLAP_PX = 400, 40
"""Largest part of an image that SIFT gets, and how far it sees beyond it on each side."""
_RATIO = 0.8
"""Lowe's ratio: the best match must be so much nearer than the second."""
_RANSAC_PX, _CONFIDENCE = 2.0, 0.999
"""Tolerance of the fundamental matrix, which lens distortion bends a little."""
_MIN_MATCHES = 15


@dataclass(frozen=True, slots=True, eq=False)
class StereoMatches:
    """The same points in two cameras at one time.

    Attributes:
        stamp_ns: time.
        first, second: (N, 2) pixels in the first and in the second camera.
    """

    stamp_ns: int
    first: FloatArray
    second: FloatArray

    @staticmethod
    def of_tracks(frame: FeatureFrame) -> StereoMatches:
        """The features that a frame of tracks has in both cameras."""
        one, two = frame.cameras[:2]
        _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
        return StereoMatches(frame.stamp_ns, one.pixels[i], two.pixels[j])


def match_images(
    stamp_ns: int, first: NDArray[np.uint8], second: NDArray[np.uint8]
) -> StereoMatches:
    """Matches of two grey images by SIFT, mutual, and consistent with one epipolar geometry."""
    (one, of_one), (two, of_two) = _keypoints(first), _keypoints(second)
    none = StereoMatches(stamp_ns, np.zeros((0, 2)), np.zeros((0, 2)))
    if min(len(one), len(two)) < _MIN_MATCHES:
        return none
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(of_two, of_one)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, other in matcher.knnMatch(of_one, of_two, k=2)
        if best.distance < _RATIO * other.distance and back.get(best.trainIdx) == best.queryIdx
    ]
    if len(pairs) < _MIN_MATCHES:
        return none
    a = one[[i for i, _ in pairs]]
    b = two[[j for _, j in pairs]]
    _, inlier = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, _RANSAC_PX, _CONFIDENCE)
    if inlier is None:
        return none
    keep = inlier.ravel().astype(bool)
    return StereoMatches(stamp_ns, a[keep], b[keep])


def _keypoints(image: NDArray[np.uint8]) -> tuple[FloatArray, NDArray[np.float32]]:
    """The strongest SIFT keypoints of an image, pixels (N, 2), and their descriptors (N, 128).

    SIFT takes 240 bytes a pixel for its scale space, so it gets one part of the image at a time.
    """
    sift = cv2.SIFT.create(_KEYPOINTS)
    pixels, strengths, descriptors = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros((0, 128), "f4")]
    for top, bottom in _parts(image.shape[0]):
        for left, right in _parts(image.shape[1]):
            y, x = max(top - _OVERLAP_PX, 0), max(left - _OVERLAP_PX, 0)
            part = image[y : bottom + _OVERLAP_PX, x : right + _OVERLAP_PX]
            found, described = sift.detectAndCompute(part, None)
            if described is None:
                continue
            at = cv2.KeyPoint.convert(found) + np.array([x, y])
            inside = ((at >= (left, top)) & (at < (right, bottom))).all(axis=1)
            pixels.append(at[inside])
            strengths.append(np.array([point.response for point in found])[inside])
            descriptors.append(described[inside])
    strongest = np.argsort(-np.concatenate(strengths), kind="stable")[:_KEYPOINTS]
    return np.concatenate(pixels)[strongest], np.concatenate(descriptors)[strongest]


def _parts(size: int) -> list[tuple[int, int]]:
    """Begin and end of equal parts of an image's width or height."""
    ends = np.linspace(0, size, -(-size // _PART_PX) + 1).round().astype(int)
    return [(int(a), int(b)) for a, b in pairwise(ends)]
