# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matches across the rig: the features of the reference camera in another camera's image.

Every frame is matched anew, from left to right, so that the disparity of a feature does not drift
as it would if both cameras followed it for themselves (measured on EuRoC: the median epipolar error
is 0.18 instead of 0.24 px). Lucas-Kanade starts from the disparity that the feature had before;
features without one are searched along their epipolar line.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.frontend.config import FrontendConfig
from slam_graph.frontend.epipolar_search import EpipolarSearch, reduce
from slam_graph.frontend.extraction import CornerExtractor
from slam_graph.frontend.lucas_kanade import LucasKanade
from slam_graph.frontend.outliers import epipolar_distance, essential_matrix, triangulated_depths
from slam_graph.frontend.tracks import Image, Tracks
from slam_graph.sensors.camera import Camera

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEVELS = 1
"""Pyramid levels of Lucas-Kanade: the guess is good, and more levels lead away from it."""

RETRY_FRAMES = 2
"""A feature that found no match is searched again on one frame out of so many."""

MIN_SCORE = 0.6
"""Smallest normalised cross-correlation of a guess that is worth following up."""


@dataclass(frozen=True)
class MatchCounts:
    """What became of the features of the reference camera: matched, and refused by geometry."""

    matched: int = 0
    rejected: int = 0


class StereoMatcher:
    """Finds the features of the reference camera in one other camera, frame after frame.

    Attributes:
        counts: of the last frame.
    """

    def __init__(
        self,
        camera: Camera,
        other_T_reference: gtsam.Pose3,
        lucas_kanade: LucasKanade,
        extractor: CornerExtractor,
        config: FrontendConfig,
    ) -> None:
        """Prepare for the first frame.

        Args:
            camera: the other camera.
            other_T_reference: pose of the reference camera in the other one's frame.
            lucas_kanade: does the search.
            extractor: of the other camera, for its mask.
            config: thresholds.
        """
        self._camera = camera
        self._other_T_reference = other_T_reference
        self._baseline_m = float(np.linalg.norm(other_T_reference.translation()))
        self._E = essential_matrix(other_T_reference)
        self._lucas_kanade = lucas_kanade
        self._extractor = extractor
        self._config = config
        self._search = EpipolarSearch(camera, other_T_reference, config.stereo_min_depth_m)
        self._ids = np.zeros(0, np.int64)
        self._offsets = np.zeros((0, 2), np.float32)
        self._frames = 0
        self.counts = MatchCounts()

    def match(self, reference: Tracks, image: Image, stamp_ns: int, first_new_id: int) -> Tracks:
        """The features of the reference camera that another camera sees at the same time.

        Args:
            reference: features of the reference camera.
            image: of the other camera.
            stamp_ns: its time.
            first_new_id: features from this id on have not been matched before.
        """
        self._frames += 1
        self.counts = MatchCounts()
        reference_image = reference.image
        if reference_image is None or len(reference) == 0:
            return Tracks.empty(image, stamp_ns)
        worthwhile, guess = self._guess(reference, reference_image, image, first_new_id)
        reference, guess = reference.select(worthwhile), guess[worthwhile]
        match = self._lucas_kanade.flow(reference_image, image, reference.pixels, guess, LEVELS)
        keep = match.found & (match.error_px < self._config.forward_backward_px)
        keep[keep] = self._extractor.allows(match.points[keep])
        reference, pixels = reference.select(keep), match.points[keep]
        normalized = self._camera.undistort(pixels.astype(np.float64))
        good = self._inliers(reference.normalized, normalized)
        self.counts = MatchCounts(int(np.sum(good)), int(np.sum(~good)))
        matches = Tracks.of(image, stamp_ns, reference.ids, pixels, normalized).select(good)
        self._ids, self._offsets = matches.ids, matches.pixels - reference.pixels[good]
        return matches

    def _guess(
        self, reference: Tracks, reference_image: Image, image: Image, first_new_id: int
    ) -> tuple[Mask, NDArray[np.float32]]:
        """Which features (N,) to look for, and where to start (N, 2)."""
        guess = reference.pixels.copy()
        known = np.isin(reference.ids, self._ids)
        guess[known] += self._offsets[np.searchsorted(self._ids, reference.ids[known])]
        due = (reference.ids + self._frames) % RETRY_FRAMES == 0
        seek = ~known & (due | (reference.ids >= first_new_id))
        if seek.any():
            points, score = self._search.search(
                reduce(reference_image),
                reduce(image),
                reference.pixels[seek],
                reference.normalized[seek],
            )
            guess[seek] = points
            seek[seek] = score > MIN_SCORE
        return known | seek, guess

    def _inliers(self, m_reference: FloatArray, m_other: FloatArray) -> Mask:
        """Which matches (N, 2) fit the calibration of the rig, (N,)."""
        focal_px = self._camera.fx
        distance_px = epipolar_distance(self._E, m_reference, m_other) * focal_px
        depth_m = triangulated_depths(self._other_T_reference, m_reference, m_other)[:, 0]
        # In terms of disparity, because far points may come out a little beyond infinity
        disparity_px = focal_px * self._baseline_m / depth_m
        nearest_px = focal_px * self._baseline_m / self._config.stereo_min_depth_m
        tolerance_px = self._config.stereo_epipolar_px
        good: Mask = distance_px < tolerance_px
        return good & (disparity_px < nearest_px) & (disparity_px > -tolerance_px)
