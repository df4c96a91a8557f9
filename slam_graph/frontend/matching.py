# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matching: the same points in another image, by their descriptors near where they should be."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from slam_graph.frontend.association import Births, Match, inside
from slam_graph.frontend.descriptors import DESCRIPTORS, Descriptor, Vectors
from slam_graph.frontend.extraction import CornerExtractor
from slam_graph.frontend.frontend_config import FrontendConfig, MatchingConfig
from slam_graph.frontend.keypoints import Indices, Keypoints, Mask, Points
from slam_graph.frontend.outliers import MIN_POINTS, eight_point, epipolar_distance
from slam_graph.frontend.prediction import Prediction, neighbour_flow
from slam_graph.frontend.tracked_features import Image, Tracks
from slam_graph.sensors.camera import Camera

SAME_PX = 3.0
"""Keypoints this close are the same corner at two scales, and do not rival one another."""


def descriptor_distances(a: Vectors, b: Vectors) -> NDArray[np.float64]:
    """Distances (N, M) of descriptors (N, D) and (M, D).

    The number of bits that differ where they are uint8, Euclidean otherwise.
    """
    if a.dtype != np.uint8:
        distances: NDArray[np.float64] = cdist(a, b)
        return distances
    words_a, words_b = (np.ascontiguousarray(v).view(np.uint64) for v in (a, b))
    bits = np.bitwise_count(words_a[:, None] ^ words_b[None])
    return np.asarray(bits.sum(axis=2), np.float64)


def match(
    wanted: Vectors,
    offered: Vectors,
    guess: Points,
    pixels: Points,
    descriptor: Descriptor,
    config: MatchingConfig,
) -> Indices:
    """Match descriptors under a search window, the ratio test and the mutual check.

    Args:
        wanted: (N, D) descriptors to find.
        offered: (M, D) descriptors to choose from.
        guess: (N, 2) where the first should be, in the image of the second.
        pixels: (M, 2) where the second are.
        descriptor: its largest distance.
        config: window, ratio and mutual check.

    Returns:
        (N,) index of the match, or -1; no index twice.
    """
    n, m = len(wanted), len(offered)
    if n == 0 or m == 0:
        return np.full(n, -1, np.int64)
    distance = descriptor_distances(wanted, offered)
    distance[cdist(guess, pixels) > config.search_radius_px] = np.inf
    rows = np.arange(n)
    best = np.argmin(distance, axis=1)
    shortest = distance[rows, best]
    rivals = np.where(cdist(pixels, pixels)[best] < SAME_PX, np.inf, distance)
    good = (shortest <= descriptor.max_distance) & (
        shortest < config.ratio * np.min(rivals, axis=1)
    )
    if config.mutual:
        good &= np.argmin(distance, axis=0)[best] == rows
    # of several that chose the same one, the closest gets it
    order = np.lexsort((shortest, ~good))
    _, first = np.unique(best[order], return_index=True)
    closest = np.zeros(n, np.bool_)
    closest[order[first]] = True
    return np.where(good & closest, best, -1)


@dataclass(frozen=True, eq=False)
class Described:
    """The keypoints of an image and their descriptors, (N, D)."""

    keypoints: Keypoints
    vectors: Vectors

    def select(self, which: Mask | Indices) -> Described:
        """Some of them."""
        return Described(self.keypoints.select(which), self.vectors[which])

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, eq=False)
class Missing:
    """Features that were not seen of late.

    Attributes:
        ids: (N,) ascending.
        vectors: (N, D) descriptors.
        pixels: (N, 2) where they should be.
        normalized: (N, 2) where they were when they were last seen.
        seen: (N,) number of that image.
    """

    ids: NDArray[np.int64]
    vectors: Vectors
    pixels: Points
    normalized: NDArray[np.float64]
    seen: NDArray[np.int64]

    def select(self, which: Mask | Indices) -> Missing:
        """Some of them."""
        return Missing(
            self.ids[which],
            self.vectors[which],
            self.pixels[which],
            self.normalized[which],
            self.seen[which],
        )

    def joined(self, other: Missing) -> Missing:
        """These and others, in the order of their ids."""
        if len(self.ids) == 0:
            return other
        ids = np.concatenate([self.ids, other.ids])
        return Missing(
            ids,
            np.concatenate([self.vectors, other.vectors]),
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.normalized, other.normalized]),
            np.concatenate([self.seen, other.seen]),
        ).select(np.argsort(ids, kind="stable"))


class DescriptorMatching:
    """Follows the keypoints of one camera by their descriptors.

    Args:
        camera: for its distortion.
        extractor: spreads new features over the image.
        config: options; `method` names the descriptor.
        mask: (height, width), zero where no features are wanted.

    Raises:
        ConfigError: if detector or descriptor need a library that is not installed.
    """

    def __init__(
        self,
        camera: Camera,
        extractor: CornerExtractor,
        config: FrontendConfig,
        mask: Image | None,
    ) -> None:
        self._camera = camera
        self._extractor = extractor
        self._config = config
        self._matching = config.matching
        dense = config.model_copy(update={"min_distance_px": config.matching.distance_px})
        self._dense = CornerExtractor(dense, camera.width, camera.height, mask)
        self._descriptor = DESCRIPTORS[config.method]()
        nothing = Keypoints.concatenate([])
        self._offered = self._last = Described(nothing, np.zeros((0, 1), np.uint8))
        self._free = self._last_free = np.zeros(0, np.bool_)
        self._ids = np.zeros(0, np.int64)
        self._vectors: Vectors = np.zeros((0, 1), np.uint8)
        self._taken = np.zeros(0, np.int64)
        self._born = np.zeros(0, np.int64)
        self._missing: Missing | None = None
        self._history: deque[Tracks] = deque(maxlen=self._matching.memory_frames + 1)
        self._images = 0

    def follow(self, before: Tracks, image: Image, guess: Prediction) -> Match:
        """Find features in the next image."""
        self._last, self._last_free = self._offered, self._free
        keypoints = self._dense.candidates(image, self._matching.candidates)
        kept, vectors = self._descriptor.describe(image, keypoints)
        self._offered = Described(keypoints.select(kept), vectors)
        self._free = np.ones(len(kept), np.bool_)
        self._images += 1
        pixels = self._offered.keypoints.pixels
        chosen = np.full(len(before), -1, np.int64)
        known = np.isin(before.ids, self._ids)
        wanted = self._vectors[np.searchsorted(self._ids, before.ids[known])]
        chosen[known] = self._match(wanted, guess.points[known], np.arange(len(pixels)))
        good = chosen >= 0
        points = guess.points.copy()
        points[good] = pixels[chosen[good]]
        good[good] = inside(points[good], image.shape, self._config.border_px)
        self._taken = chosen
        return Match(points, good, {"lost_match": ~good})

    def recover(self, before: Tracks, after: Tracks) -> tuple[NDArray[np.int64], Points]:
        """Features that found no match at first, or not in the last few images."""
        here, there = before.common(after)
        chosen = self._taken[here]
        self._free[chosen] = False
        self._remember_missing(before, after)
        missing = self._missing
        found = np.full(0 if missing is None else len(missing.ids), -1, np.int64)
        if missing is not None and len(here) >= MIN_POINTS:
            guess = missing.pixels + neighbour_flow(
                before.pixels[here], after.pixels[there], missing.pixels
            )
            missing = Missing(missing.ids, missing.vectors, guess, missing.normalized, missing.seen)
            found = self._match(missing.vectors, guess, np.flatnonzero(self._free))
            found[~self._fits(missing, found, after)] = -1
        self._update(after.ids[there], chosen)
        if missing is None:
            return np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        seen = found >= 0
        self._free[found[seen]] = False
        self._update(missing.ids[seen], found[seen])
        young = self._images - missing.seen <= self._matching.memory_frames
        size = (self._camera.height, self._camera.width)
        self._missing = missing.select(~seen & young & inside(missing.pixels, size, 0))
        self._history.append(after)
        return missing.ids[seen], self._offered.keypoints.pixels[found[seen]]

    def births(self, before: Tracks, after: Tracks, verify: bool) -> Births:
        """Keypoints that are no feature yet, and match one of the image before that is none."""
        free = np.flatnonzero(self._free)
        origins: Points | None = None
        if verify and len(self._last):
            here, there = after.common(before)
            pixels = self._offered.keypoints.pixels[free]
            guess = pixels + neighbour_flow(after.pixels[here], before.pixels[there], pixels)
            last = self._last.select(self._last_free)
            found = match(
                self._offered.vectors[free],
                last.vectors,
                guess,
                last.keypoints.pixels,
                self._descriptor,
                self._matching,
            )
            free, found = free[found >= 0], found[found >= 0]
            origins = last.keypoints.pixels[found]
        chosen = self._extractor.fill(self._offered.keypoints.select(free), after.pixels)
        self._born = free[chosen]
        points = self._offered.keypoints.pixels[self._born]
        return Births(points, None if origins is None else origins[chosen])

    def adopt(self, ids: NDArray[np.int64], chosen: Mask) -> None:
        """Remember what new features look like."""
        self._free[self._born[chosen]] = False
        self._update(ids, self._born[chosen])

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Do not look for some features any more."""
        if self._missing is not None:
            self._missing = self._missing.select(~np.isin(self._missing.ids, ids))

    def _match(self, wanted: Vectors, guess: Points, among: Indices) -> Indices:
        """Index of the match of each feature (N,) among some keypoints, or -1."""
        found = match(
            wanted,
            self._offered.vectors[among],
            guess,
            self._offered.keypoints.pixels[among],
            self._descriptor,
            self._matching,
        )
        return np.where(found >= 0, among[found], -1) if len(among) else found

    def _update(self, ids: NDArray[np.int64], keypoints: Indices) -> None:
        """Features look now as these keypoints do."""
        old = ~np.isin(self._ids, ids)
        vectors = self._offered.vectors[keypoints]
        joined = np.concatenate([self._ids[old], ids])
        order = np.argsort(joined, kind="stable")
        if old.any():
            vectors = np.concatenate([self._vectors[old], vectors])
        self._ids, self._vectors = joined[order], vectors[order]

    def _remember_missing(self, before: Tracks, after: Tracks) -> None:
        """Note the features that have just gone missing, and forget what all others look like."""
        gone = before.select(~np.isin(before.ids, after.ids) & np.isin(before.ids, self._ids))
        vectors = self._vectors[np.searchsorted(self._ids, gone.ids)]
        seen = np.full(len(gone), self._images - 1)
        new = Missing(gone.ids, vectors, gone.pixels, gone.normalized, seen)
        self._missing = new if self._missing is None else self._missing.joined(new)
        kept = np.isin(self._ids, after.ids)
        self._ids, self._vectors = self._ids[kept], self._vectors[kept]

    def _fits(self, missing: Missing, found: Indices, after: Tracks) -> Mask:
        """Which of the features (N,) that were found again fit the motion since they were seen."""
        fits = np.zeros(len(found), np.bool_)
        limit = self._config.epipolar_px / self._camera.fx
        for number in np.unique(missing.seen[found >= 0]).tolist():
            back = self._images - number
            if back > len(self._history):
                continue
            then = self._history[-back]
            here, there = after.common(then)
            if len(here) < MIN_POINTS:
                continue
            F = eight_point(then.normalized[there], after.normalized[here])
            rows = np.flatnonzero((found >= 0) & (missing.seen == number))
            pixels = self._offered.keypoints.pixels[found[rows]].astype(np.float64)
            m = self._camera.undistort(pixels)
            fits[rows] = epipolar_distance(F, missing.normalized[rows], m) < limit
        return fits
