# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Data association by tracking: corners followed from image to image by pyramidal Lucas-Kanade."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.frontend.association import Association, Candidates, inside
from slam_graph.frontend.extraction import BORDER_PX, FeatureExtractor
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.keypoints import Image, Pixels, Tracks, contiguous
from slam_graph.frontend.prediction import Prediction, neighbour_flow
from slam_graph.frontend.reference_patches import ReferencePatches
from slam_graph.kernels.halvings import halved, halvings_room
from slam_graph.kernels.window_tracking import WINDOW_PX, track_windows

_ITERATIONS = 15
"""Most iterations on each level of the pyramid; few are needed from a good prediction."""

_STEP_PX = 0.05
"""Iterations end when a step is smaller than this. With 0.02 tracks are no better where reference
patches move the features afterwards."""

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ITERATIONS, _STEP_PX)

_MIN_EIGENVALUE = 1e-3
"""Windows with less gradient than this are not tracked (OpenCV's `minEigThreshold`)."""

_GUIDED_LEVELS = 1
"""Pyramid levels where the guess is good; more of them lead away from it."""

_BACKWARD_LEVELS = 0
"""Pyramid levels of the backward pass: it starts at the point where it should end."""

_SURPLUS = 2
"""Corners tried for each new feature that is wanted: not all can be tracked back."""

BLUR_PER_PX = 0.02
"""By how much a corner is harder to place for each pixel that it moved from image to image: the
longer the way, the longer its blur, along which its place is uncertain."""

_CORNER_QUALITY = 0.02
"""Smallest corner on an object that moves, relative to the best one there."""

_VERIFICATION = 0.3
"""Errors allowed to a new corner, as a share of those allowed to one that is tracked already. There
are more corners than are needed, and one that barely passes is soon lost."""


@dataclass(frozen=True, eq=False)
class Flow:
    """Where points of one image are in another.

    Attributes:
        points: (N, 2) float32 pixels in the other image.
        found: (N,) whether Lucas-Kanade converged inside the image, forward and back.
        error_px: (N,) distance between a point and itself after tracking it forward and back;
            infinite where it was not found.
    """

    points: Pixels
    found: BoolArray
    error_px: NDArray[np.float32]


def lengths(flow: NDArray[Any]) -> NDArray[Any]:
    """Lengths (N,) of vectors (N, 2); NumPy's function takes several times as long."""
    squares = flow * flow
    return np.asarray(np.sqrt(squares[:, 0] + squares[:, 1]))


class _Pyramid:
    """The halvings of an image, made when they are needed.

    Args:
        image: which must not change.
        levels: most of them.

    Attributes:
        image: as the kernel wants it.
        halvings: one behind another.
    """

    def __init__(self, image: Image, levels: int) -> None:
        self._of = image
        self.image = contiguous(image)
        self.halvings: Image = np.empty(halvings_room(image.shape, levels), np.uint8)
        self._made = 0

    def is_of(self, image: Image) -> bool:
        """Whether it is that of an image."""
        return image is self._of

    def reach(self, levels: int) -> None:
        """Make so many levels, if they are not there."""
        if levels <= self._made:
            return
        larger = halved(self.image, self.halvings, self._made)
        for level in range(self._made + 1, levels + 1):
            smaller = halved(self.image, self.halvings, level)
            cv2.pyrDown(larger, smaller)
            larger = smaller
        self._made = levels


class LucasKanade:
    """Pyramidal Lucas-Kanade (Bouguet 2000) with a forward-backward check (Kalal et al. 2010).

    Args:
        config: settings.
        images: how many images are in use at a time: those before and those now.
    """

    def __init__(self, config: FrontendConfig, images: int) -> None:
        self._window_px = config.window_px
        self._levels = max(config.pyramid_levels, _GUIDED_LEVELS)
        self._pyramids: deque[_Pyramid] = deque(maxlen=images)

    def flow(
        self, source: Image, target: Image, points: Pixels, guess: Pixels, levels: int
    ) -> Flow:
        """Find `points` of `source` in `target`.

        Args:
            source: (height, width) image.
            target: image of the same scale, of any size.
            points: (N, 2) float32 pixels in `source`.
            guess: (N, 2) where to start in `target`.
            levels: of the pyramid, besides the image itself; at most the larger one of
                `pyramid_levels` and 1.
        """
        if len(points) == 0:
            return Flow(points, np.zeros(0, np.bool_), np.zeros(0, np.float32))
        if self._window_px != WINDOW_PX:
            return self._flow_by_opencv(source, target, points, guess, levels)
        shortest = min(*source.shape, *target.shape)
        while levels > 0 and -(-shortest >> levels) <= WINDOW_PX:
            levels -= 1  # a level, of a size rounded up, must be larger than the window
        one, other = self._pyramid(source, levels), self._pyramid(target, levels)
        points = np.ascontiguousarray(points, np.float32)
        start = np.ascontiguousarray(guess, np.float32)
        images = one.image, one.halvings, other.image, other.halvings
        limits = BORDER_PX, _ITERATIONS, _STEP_PX, _MIN_EIGENVALUE
        return Flow(*track_windows(*images, points, start, levels, *limits))

    def _pyramid(self, image: Image, levels: int) -> _Pyramid:
        """The pyramid of an image, with at least so many levels."""
        for found in self._pyramids:
            if found.is_of(image):
                break
        else:
            found = _Pyramid(image, max(levels, self._levels))
            self._pyramids.append(found)
        found.reach(levels)
        return found

    def _flow_by_opencv(
        self, source: Image, target: Image, points: Pixels, guess: Pixels, levels: int
    ) -> Flow:
        """The same for windows of any size, in more time."""
        shape = target.shape
        source, target = _of_one_size(source, target)
        forward, found = self._by_opencv(source, target, points, guess, levels)
        found &= inside(forward, shape, BORDER_PX)
        back, returned = self._by_opencv(target, source, forward, points, _BACKWARD_LEVELS)
        found &= returned
        error_px = np.where(found, np.linalg.norm(back - points, axis=1), np.float32(np.inf))
        return Flow(forward, found, error_px)

    def _by_opencv(
        self, source: Image, target: Image, points: Pixels, start: Pixels, levels: int
    ) -> tuple[Pixels, BoolArray]:
        """Where points (N, 2) are in another image, and whether they were found (N,)."""
        moved, status, _ = cv2.calcOpticalFlowPyrLK(
            source,
            target,
            points,
            start.astype(np.float32),  # a copy: it is overwritten
            winSize=(self._window_px, self._window_px),
            maxLevel=levels,
            criteria=_CRITERIA,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=_MIN_EIGENVALUE,
        )
        return np.asarray(moved, np.float32), status[:, 0] == 1


def _of_one_size(one: Image, other: Image) -> tuple[Image, Image]:
    """Two images, continued to the right and below to the same size, as OpenCV wants them."""
    if one.shape == other.shape:
        return one, other
    height, width = np.maximum(one.shape, other.shape)

    def continued(image: Image) -> Image:
        below, right = height - image.shape[0], width - image.shape[1]
        wider = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE)
        return np.asarray(wider, np.uint8)

    return continued(one), continued(other)


class CornerTracking:
    """Tracks the corners of one camera by Lucas-Kanade: an `Associator`."""

    def __init__(
        self,
        extractor: FeatureExtractor,
        lucas_kanade: LucasKanade,
        config: FrontendConfig,
        blur: float = 0.0,
    ) -> None:
        """Track with the settings of the front end.

        Args:
            extractor: finds new corners.
            lucas_kanade: tracks them.
            config: settings.
            blur: what `forward_backward_px` grows by, for each pixel that a corner has moved.
        """
        self._blur = blur
        self._extractor = extractor
        self._lucas_kanade = lucas_kanade
        self._levels = config.pyramid_levels
        self._largest_px = config.forward_backward_px
        self._patches = ReferencePatches() if config.reference_patches else None

    def follow(self, before: Tracks, image: Image, guess: Prediction) -> Association:
        """Find features in the next image."""
        n = len(before)
        points = np.zeros((n, 2), np.float32)
        found, good = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        if before.image is None:
            return Association(points, good, {})
        # A good guess needs no pyramid, which can lead away from it; what is not found near it is
        # looked for again like the features without one.
        guided = min(_GUIDED_LEVELS, self._levels)
        for levels, tried in ((guided, guess.trusted), (self._levels, None)):
            rows = (~good if tried is None else tried).nonzero()[0]
            if len(rows) == 0:
                continue
            start, near, everything = before.pixels, guess.points, len(rows) == n
            if not everything:
                start, near = start.take(rows, axis=0), near.take(rows, axis=0)
            flow = self._lucas_kanade.flow(before.image, image, start, near, levels)
            close = flow.found & (flow.error_px < self._tolerance_px(start, flow.points))
            if everything:
                points, found, good = flow.points, flow.found, close
            else:
                points[rows], found[rows], good[rows] = flow.points, flow.found, close
        if self._patches is not None and n > 0:
            points = self._patches.placed(before, image, points, good)
        return Association(points, good, {"lost_klt": ~found, "lost_fb": found & ~good})

    def recover(self, before: Tracks, after: Tracks) -> tuple[IntArray, Pixels]:
        """None: a corner without a descriptor cannot be recognised once it is lost."""
        return np.zeros(0, np.int64), np.zeros((0, 2), np.float32)

    def propose(self, before: Tracks, after: Tracks, verify: bool) -> Candidates:
        """New corners; if they are verified, those that can be tracked back."""
        assert after.image is not None
        if not verify or before.image is None:
            return Candidates(self._extractor.extract(after.image, after.pixels).points, None)
        found = self._extractor.extract(after.image, after.pixels, _SURPLUS)
        points = found.points
        here, there = after.common(before)
        known = after.pixels.take(here, axis=0), before.pixels.take(there, axis=0)
        guess = points + neighbour_flow(*known, points)
        flow = self._lucas_kanade.flow(after.image, before.image, points, guess, _GUIDED_LEVELS)
        limit_px = _VERIFICATION * self._tolerance_px(points, flow.points)
        good = found.within_quotas(flow.found & (flow.error_px < limit_px))
        chosen = good.nonzero()[0]
        origins = flow.points.take(chosen, axis=0)
        return Candidates(points.take(chosen, axis=0), origins, _VERIFICATION)

    def _tolerance_px(self, start: Pixels, end: Pixels) -> Pixels | float:
        """Errors (N,) allowed to corners, forth and back."""
        if self._blur == 0.0:
            return self._largest_px
        return np.asarray(self._largest_px + self._blur * lengths(end - start), np.float32)

    def accept(self, ids: IntArray, chosen: BoolArray) -> None:
        """Nothing to remember: the patch of a corner is taken when it is first followed."""

    def corners(self, image: Image, mask: Image, count: int, distance_px: float) -> Pixels:
        """The corners (N, 2) that a mask shows, the strongest first."""
        found = cv2.goodFeaturesToTrack(image, count, _CORNER_QUALITY, distance_px, mask=mask)
        return np.asarray([] if found is None else found, np.float32).reshape(-1, 2)

    def accept_corners(self, ids: IntArray, points: Pixels) -> None:
        """Nothing to remember, as with `accept`."""

    def forget(self, ids: IntArray) -> None:
        """Drop the patches of these."""
        if self._patches is not None:
            self._patches.forget(ids)
