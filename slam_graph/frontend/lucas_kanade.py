# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tracking: the same points in another image, by pyramidal Lucas-Kanade."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.frontend.association import Births, Match, inside
from slam_graph.frontend.extraction import CornerExtractor
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.keypoints import Mask, Points
from slam_graph.frontend.prediction import Prediction, neighbour_flow
from slam_graph.frontend.tracked_features import Image, Tracks

GUIDED_LEVELS = 1
"""Pyramid levels where the guess is good; more of them lead away from it."""

SURPLUS = 2
"""So many corners are tried for each new feature: not all can be followed back."""


@dataclass(frozen=True, eq=False)
class Flow:
    """Where points of one image are in another.

    Attributes:
        points: (N, 2) float32 pixels in the other image.
        found: (N,) whether Lucas-Kanade converged inside the image, there and back.
        error_px: (N,) how far tracking back ends from where it started.
    """

    points: Points
    found: Mask
    error_px: NDArray[np.float32]


class LucasKanade:
    """Pyramidal Lucas-Kanade (Bouguet 2000) with a forward-backward check (Kalal et al. 2010)."""

    def __init__(self, config: FrontendConfig) -> None:
        self._config = config
        self._criteria = (
            cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS,
            config.lk_iterations,
            config.lk_epsilon_px,
        )

    def flow(
        self, source: Image, target: Image, points: Points, guess: Points, levels: int
    ) -> Flow:
        """Find `points` of `source` in `target`.

        Args:
            source: (height, width) image.
            target: image of the same size.
            points: (N, 2) float32 pixels in `source`.
            guess: (N, 2) where to start in `target`.
            levels: of the pyramid.
        """
        if len(points) == 0:
            return Flow(points, np.zeros(0, np.bool_), np.zeros(0, np.float32))
        forward, found = self._lucas_kanade(source, target, points, guess, levels)
        found &= inside(forward, target.shape, self._config.border_px)
        # The way back starts where it should end, so it needs no pyramid: what it tests is whether
        # the patch that was found is, seen from the other side, the patch that was looked for.
        levels = self._config.backward_levels
        back, returned = self._lucas_kanade(target, source, forward, points, levels)
        error_px = np.linalg.norm(back - points, axis=1)
        return Flow(forward, found & returned, error_px)

    def _lucas_kanade(
        self, source: Image, target: Image, points: Points, start: Points, levels: int
    ) -> tuple[Points, Mask]:
        window = self._config.window_px
        moved, status, _ = cv2.calcOpticalFlowPyrLK(
            source,
            target,
            points,
            start.astype(np.float32),  # a copy: it is overwritten
            winSize=(window, window),
            maxLevel=levels,
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=self._config.lk_min_eigenvalue,
        )
        return np.asarray(moved, np.float32), status[:, 0] == 1


class CornerTracking:
    """Follows the corners of one camera by Lucas-Kanade."""

    def __init__(self, extractor: CornerExtractor, config: FrontendConfig) -> None:
        self._extractor = extractor
        self._config = config
        self._lucas_kanade = LucasKanade(config)
        self._guided = min(config.guided_levels, config.pyramid_levels)

    def follow(self, before: Tracks, image: Image, guess: Prediction) -> Match:
        """Find features in the next image."""
        n = len(before)
        points = np.zeros((n, 2), np.float32)
        found, good = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        if before.image is None:
            return Match(points, good, {})
        # A guess that is good needs no pyramid, which can lead away from it; what is not found near
        # it is looked for again like the features without one.
        for levels, tried in ((self._guided, guess.trusted), (self._config.pyramid_levels, None)):
            rows = np.flatnonzero(~good if tried is None else tried)
            flow = self._lucas_kanade.flow(
                before.image, image, before.pixels[rows], guess.points[rows], levels
            )
            points[rows], found[rows] = flow.points, flow.found
            good[rows] = flow.found & (flow.error_px < self._config.forward_backward_px)
        return Match(points, good, {"lost_klt": ~found, "lost_fb": found & ~good})

    def recover(self, before: Tracks, after: Tracks) -> tuple[NDArray[np.int64], Points]:
        """Nothing: without an image of it, a corner that was lost cannot be told from others."""
        return np.zeros(0, np.int64), np.zeros((0, 2), np.float32)

    def births(self, before: Tracks, after: Tracks, verify: bool) -> Births:
        """New corners that can be followed back to the image before."""
        assert after.image is not None
        if not verify or before.image is None:
            return Births(self._extractor.extract(after.image, after.pixels).points, None)
        found = self._extractor.extract(after.image, after.pixels, SURPLUS)
        points = found.points
        here, there = after.common(before)
        guess = points + neighbour_flow(after.pixels[here], before.pixels[there], points)
        flow = self._lucas_kanade.flow(after.image, before.image, points, guess, GUIDED_LEVELS)
        limit_px = self._config.verification * self._config.forward_backward_px
        good = found.within_quotas(flow.found & (flow.error_px < limit_px))
        return Births(points[good], flow.points[good], self._config.verification)

    def adopt(self, ids: NDArray[np.int64], chosen: Mask) -> None:
        """Nothing to remember: corners are found again by their image."""

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Nothing to forget."""
