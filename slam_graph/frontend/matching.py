# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Data association by matching: keypoints found again by their descriptors near a prediction."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts are imported when they are first used

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.association import Association, Candidates, inside
from slam_graph.frontend.descriptors import Descriptor, Vectors
from slam_graph.frontend.epipolar_test import distances_px, fitted_motion
from slam_graph.frontend.extraction import BORDER_PX, FeatureExtractor
from slam_graph.frontend.frontend_config import DESCRIPTORS, FrontendConfig
from slam_graph.frontend.keypoints import Image, Keypoints, Pixels, Tracks, spread
from slam_graph.frontend.outliers import MIN_POINTS
from slam_graph.frontend.prediction import Prediction, neighbour_flow
from slam_graph.kernels.spacing import in_mask
from slam_graph.sensors import Camera

_KEYPOINTS = 500
"""Keypoints described in each image: two to three times the default number of features, so that
most features are among them."""

_KEYPOINT_DISTANCE_PX = 5.0
"""Least distance of these keypoints: closer than features, so that each is found again."""

_SEARCH_RADIUS_PX = 20.0
"""A match lies within this distance of the prediction, which the gyroscope makes good to a few
pixels."""

_RATIO = 0.85
"""Ratio test (Lowe 2004): the best match is closer than this share of the distance to the second
best. Less strict than Lowe's 0.8, because the search window leaves few rivals."""

_MEMORY_FRAMES = 5
"""Frames in which a feature without a match is still looked for; later the prediction of where it
is has drifted."""

_SAME_PX = 3.0
"""Keypoints this close are the same corner at two scales, and do not rival one another."""


def descriptor_distances(a: Vectors, b: Vectors) -> FloatArray:
    """Distances (N, M) of descriptors (N, D) and (M, D).

    The number of bits that differ where they are uint8, Euclidean otherwise.
    """
    if a.dtype != np.uint8:
        distances: FloatArray = scipy.spatial.distance.cdist(a, b)
        return distances
    words_a, words_b = (np.ascontiguousarray(v).view(np.uint64) for v in (a, b))
    bits = np.bitwise_count(words_a[:, None] ^ words_b[None])
    return np.asarray(bits.sum(axis=2), np.float64)


def _stacked(a: Vectors, b: Vectors) -> Vectors:
    """Descriptors (N, D) and (M, D) as one array; where there are none, D may be any number."""
    if len(a) == 0 or len(b) == 0:
        return b if len(a) == 0 else a
    return np.concatenate([a, b])


def match(
    features: Vectors,
    keypoints: Vectors,
    guess: Pixels,
    pixels: Pixels,
    max_distance: float,
    search_radius_px: float = _SEARCH_RADIUS_PX,
    mutual: bool = True,
) -> IntArray:
    """Match descriptors within a search window, with the ratio test and the mutual check.

    Args:
        features: (N, D) descriptors to find.
        keypoints: (M, D) descriptors to choose from.
        guess: (N, 2) predicted pixels of the features, in the image of the keypoints.
        pixels: (M, 2) pixels of the keypoints.
        max_distance: largest distance of two descriptors that match.
        search_radius_px: largest distance of a match from the guess.
        mutual: whether a match must be the best one seen from either image.

    Returns:
        (N,) index of the match, or -1; no index twice.
    """
    n, m = len(features), len(keypoints)
    if n == 0 or m == 0:
        return np.full(n, -1, np.int64)
    distance = descriptor_distances(features, keypoints)
    distance[scipy.spatial.distance.cdist(guess, pixels) > search_radius_px] = np.inf
    rows = np.arange(n)
    best = np.argmin(distance, axis=1)
    shortest = distance[rows, best]
    apart_px = scipy.spatial.distance.cdist(pixels, pixels)[best]
    rivals = np.where(apart_px < _SAME_PX, np.inf, distance)
    good = (shortest <= max_distance) & (shortest < _RATIO * np.min(rivals, axis=1))
    if mutual:
        good &= np.argmin(distance, axis=0)[best] == rows
    # of several features that chose the same keypoint, the closest gets it
    order = np.lexsort((shortest, ~good))
    _, first = np.unique(best[order], return_index=True)
    closest = np.zeros(n, np.bool_)
    closest[order[first]] = True
    return np.where(good & closest, best, -1)


@dataclass(frozen=True, eq=False)
class _Described:
    """The keypoints of an image, their descriptors, and which are features.

    Attributes:
        keypoints: N of them.
        vectors: (N, D) descriptors.
        free: (N,) whether a keypoint belongs to no feature; changed in place.
    """

    keypoints: Keypoints
    vectors: Vectors
    free: BoolArray

    @staticmethod
    def empty() -> _Described:
        """No keypoints."""
        nothing = np.zeros((0, 1), np.uint8)
        return _Described(Keypoints.concatenate([]), nothing, np.zeros(0, np.bool_))

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, eq=False)
class _Lost:
    """Features without a match in the last images.

    Attributes:
        ids: (N,) ascending.
        vectors: (N, D) descriptors.
        pixels: (N, 2) predicted in the last image.
        normalized: (N, 2) where they were last seen.
        seen: (N,) number of the image in which they were last seen.
    """

    ids: IntArray
    vectors: Vectors
    pixels: Pixels
    normalized: FloatArray
    seen: IntArray

    def select(self, which: BoolArray | IntArray) -> _Lost:
        """Those where a mask (N,) is true, or those with given indices."""
        return _Lost(
            self.ids[which],
            self.vectors[which],
            self.pixels[which],
            self.normalized[which],
            self.seen[which],
        )

    def joined(self, other: _Lost) -> _Lost:
        """These and others, in the order of their ids."""
        ids = np.concatenate([self.ids, other.ids])
        return _Lost(
            ids,
            _stacked(self.vectors, other.vectors),
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.normalized, other.normalized]),
            np.concatenate([self.seen, other.seen]),
        ).select(np.argsort(ids, kind="stable"))


class DescriptorMatching:
    """Finds the features of one camera by their descriptors: an `Associator`.

    Args:
        camera: for its distortion.
        extractor: spreads new features over the image.
        config: `method` names the descriptor.
        mask: (height, width), zero where no features are wanted.

    Raises:
        ConfigError: if detector or descriptor need a library that is not installed.
    """

    def __init__(
        self,
        camera: Camera,
        extractor: FeatureExtractor,
        config: FrontendConfig,
        mask: Image | None,
    ) -> None:
        self._camera = camera
        self._extractor = extractor
        self._epipolar_px = config.epipolar_px
        self._dense = FeatureExtractor(
            config, camera.width, camera.height, mask, _KEYPOINT_DISTANCE_PX
        )
        self._descriptor: Descriptor = DESCRIPTORS[config.method]()
        self._current = self._last = _Described.empty()
        self._ids = np.zeros(0, np.int64)  # of the features, ascending
        self._vectors: Vectors = np.zeros((0, 1), np.uint8)  # their descriptors
        self._matched = np.zeros(0, np.int64)  # index of the keypoint of each feature, or -1
        self._proposed = np.zeros(0, np.int64)  # indices of the keypoints that were proposed
        self._lost: _Lost | None = None
        self._history: deque[Tracks] = deque(maxlen=_MEMORY_FRAMES + 1)
        self._images = 0

    def follow(self, before: Tracks, image: Image, guess: Prediction) -> Association:
        """Find features in the next image."""
        keypoints = self._dense.candidates(image, _KEYPOINTS)
        kept, vectors = self._descriptor.describe(image, keypoints)
        self._last = self._current
        self._current = _Described(keypoints.select(kept), vectors, np.ones(len(kept), np.bool_))
        self._images += 1
        pixels = self._current.keypoints.pixels
        chosen = np.full(len(before), -1, np.int64)
        known = np.isin(before.ids, self._ids)
        features = self._vectors[np.searchsorted(self._ids, before.ids[known])]
        chosen[known] = self._match(features, guess.points[known], np.arange(len(pixels)))
        good = chosen >= 0
        points = guess.points.copy()
        points[good] = pixels[chosen[good]]
        good[good] = inside(points[good], image.shape, BORDER_PX)
        self._matched = chosen
        return Association(points, good, {"lost_match": ~good})

    def recover(self, before: Tracks, after: Tracks) -> tuple[IntArray, Pixels]:
        """Features that found no match at first, or not in the last few images."""
        here, there = before.common(after)
        chosen = self._matched[here]
        self._current.free[chosen] = False
        lost = self._remember_lost(before, after)
        found = np.full(len(lost.ids), -1, np.int64)
        if len(here) >= MIN_POINTS:
            flow = neighbour_flow(before.pixels[here], after.pixels[there], lost.pixels)
            lost = replace(lost, pixels=lost.pixels + flow)
            found = self._match(lost.vectors, lost.pixels, np.flatnonzero(self._current.free))
            found[~self._fits(lost, found, after)] = -1
        self._update(after.ids[there], chosen)
        seen = found >= 0
        self._current.free[found[seen]] = False
        self._update(lost.ids[seen], found[seen])
        young = self._images - lost.seen <= _MEMORY_FRAMES
        size = (self._camera.height, self._camera.width)
        self._lost = lost.select(~seen & young & inside(lost.pixels, size, 0))
        self._history.append(after)
        return lost.ids[seen], self._current.keypoints.pixels[found[seen]]

    def propose(self, before: Tracks, after: Tracks, verify: bool) -> Candidates:
        """Keypoints that are no feature; if verified, they match such a one in the image before."""
        free = np.flatnonzero(self._current.free)
        origins: Pixels | None = None
        if verify and len(self._last):
            here, there = after.common(before)
            pixels = self._current.keypoints.pixels[free]
            guess = pixels + neighbour_flow(after.pixels[here], before.pixels[there], pixels)
            last_pixels = self._last.keypoints.pixels[self._last.free]
            found = match(
                self._current.vectors[free],
                self._last.vectors[self._last.free],
                guess,
                last_pixels,
                self._descriptor.max_distance,
            )
            free, found = free[found >= 0], found[found >= 0]
            origins = last_pixels[found]
        chosen = self._extractor.fill(self._current.keypoints.select(free), after.pixels)
        self._proposed = free[chosen]
        points = self._current.keypoints.pixels[self._proposed]
        return Candidates(points, None if origins is None else origins[chosen])

    def accept(self, ids: IntArray, chosen: BoolArray) -> None:
        """Remember the descriptors of new features."""
        self._current.free[self._proposed[chosen]] = False
        self._update(ids, self._proposed[chosen])

    def corners(self, image: Image, mask: Image, count: int, distance_px: float) -> Pixels:
        """The keypoints (N, 2) that a mask shows and that are no feature, the strongest first."""
        free = self._current.keypoints.select(self._current.free)
        there = free.select(in_mask(mask, np.ascontiguousarray(free.pixels)))
        pixels = there.pixels[np.argsort(-there.scores, kind="stable")]
        return pixels[spread(pixels, count, distance_px)]

    def accept_corners(self, ids: IntArray, points: Pixels) -> None:
        """Remember the descriptors of new features, which are keypoints."""
        if len(ids) == 0:
            return
        known = self._current.keypoints.pixels
        keypoints = np.argmin(scipy.spatial.distance.cdist(points, known), axis=1)
        self._current.free[keypoints] = False
        self._update(ids, keypoints)

    def forget(self, ids: IntArray) -> None:
        """Do not look for these features any more."""
        if self._lost is not None:
            self._lost = self._lost.select(~np.isin(self._lost.ids, ids))

    def _match(self, features: Vectors, guess: Pixels, among: IntArray) -> IntArray:
        """For each feature (N,) the index of its match among some keypoints, or -1."""
        found = match(
            features,
            self._current.vectors[among],
            guess,
            self._current.keypoints.pixels[among],
            self._descriptor.max_distance,
        )
        return np.where(found >= 0, among[found], -1) if len(among) else found

    def _update(self, ids: IntArray, keypoints: IntArray) -> None:
        """Replace the descriptors of features by those of their keypoints in this image."""
        old = ~np.isin(self._ids, ids)
        vectors = self._current.vectors[keypoints]
        joined = np.concatenate([self._ids[old], ids])
        order = np.argsort(joined, kind="stable")
        self._ids, self._vectors = joined[order], _stacked(self._vectors[old], vectors)[order]

    def _remember_lost(self, before: Tracks, after: Tracks) -> _Lost:
        """The lost features and those just lost; the descriptors of all others are dropped."""
        gone = before.select(~np.isin(before.ids, after.ids) & np.isin(before.ids, self._ids))
        vectors = self._vectors[np.searchsorted(self._ids, gone.ids)]
        seen = np.full(len(gone), self._images - 1)
        new = _Lost(gone.ids, vectors, gone.pixels, gone.normalized, seen)
        kept = np.isin(self._ids, after.ids)
        self._ids, self._vectors = self._ids[kept], self._vectors[kept]
        return new if self._lost is None else self._lost.joined(new)

    def _fits(self, lost: _Lost, found: IntArray, after: Tracks) -> BoolArray:
        """Which of the features (N,) that were found again fit the motion since they were seen."""
        fits = np.zeros(len(found), np.bool_)
        for number in np.unique(lost.seen[found >= 0]).tolist():
            back = self._images - number
            if back > len(self._history):
                continue
            then = self._history[-back]
            here, there = after.common(then)
            if len(here) < MIN_POINTS:
                continue
            F = fitted_motion(self._camera, then.normalized[there], after.normalized[here])
            rows = np.flatnonzero((found >= 0) & (lost.seen == number))
            pixels = self._current.keypoints.pixels[found[rows]].astype(np.float64)
            m = self._camera.undistort(pixels)
            off_px = distances_px(self._camera, F, lost.normalized[rows], m)
            fits[rows] = off_px < self._epipolar_px
        return fits
