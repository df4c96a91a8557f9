# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features that move by themselves: tracked like the others, and reported apart from them.

A track that RANSAC rejects between two images is a wrong match, or it moves. If moving objects are
estimated it is kept, apart from the others in this frame: forward and backward Lucas-Kanade and the
stereo test go on to find wrong matches. In the next frame it is tested again. A track that the back
end says to move stays apart, and is tested no more, until the back end says that it is static.
Before there is a state nobody could say so, and all outliers are rejected.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.keypoints import Image, Pixels
from slam_graph.sensors import FeatureObservations

MOST = 150
"""Moving features that are tracked; of more the youngest are left out."""
_FindCorners = Callable[[Image, int, float], Pixels]


class MovingTracks:
    """Which of the features move.

    Args:
        wanted: whether they are kept at all.

    Attributes:
        ids: (N,) of those that are apart in this frame, ascending.
        keeps: whether outliers are kept now: not before there is a state.
        hulls: (K, 2) polygons around objects in the first camera, pixels, and how many features are
            wanted in each.
    """

    def __init__(self, wanted: bool) -> None:
        self.wanted = wanted
        self.keeps = False
        self.ids: IntArray = np.zeros(0, np.int64)
        self.hulls: list[tuple[FloatArray, int]] = []
        self._known = self.ids

    def __contains__(self, feature: int) -> bool:
        return bool(np.isin(feature, self.ids))

    def among(self, ids: IntArray) -> BoolArray:
        """Which features (N,) move."""
        if len(self.ids) == 0:
            return np.zeros(len(ids), np.bool_)
        return np.isin(ids, self.ids)

    def next_frame(self) -> None:
        """Features that were outliers in the frame before are tested again."""
        self.ids = self._known

    def suspect(self, ids: IntArray) -> None:
        """Features that are outliers in this frame."""
        if len(ids):
            self.ids = np.union1d(self.ids, ids)

    def add(self, ids: IntArray) -> None:
        """Features that move, by the back end or by where they are."""
        if self.wanted and len(ids):
            self._known = np.union1d(self._known, ids)
            self.ids = np.union1d(self.ids, ids)

    def remove(self, ids: IntArray) -> None:
        """Features that are static after all."""
        if len(ids):
            self._known = np.setdiff1d(self._known, ids)
            self.ids = np.setdiff1d(self.ids, ids)

    def surplus(self, alive: IntArray) -> IntArray:
        """Forget features that are not tracked any more; ids (N,) of those that are too many."""
        self.ids = self.ids[np.isin(self.ids, alive)]
        self.ids, late = self.ids[:MOST], self.ids[MOST:]
        self._known = self._known[np.isin(self._known, self.ids)]
        return late

    def apart(
        self, found: list[FeatureObservations]
    ) -> tuple[tuple[FeatureObservations, ...], tuple[FeatureObservations, ...]]:
        """The observations of each camera of features that are static, and of those that move."""
        if not self.wanted:
            return tuple(found), ()
        moving = [np.isin(seen.ids, self.ids) for seen in found]
        static = tuple(seen.select(~rows) for seen, rows in zip(found, moving, strict=True))
        return static, tuple(seen.select(rows) for seen, rows in zip(found, moving, strict=True))

    def corners(
        self, taken: Pixels, shape: tuple[int, ...], distance_px: float, find: _FindCorners
    ) -> Pixels:
        """New corners (N, 2) in the hulls, which are wanted there beside those that are taken.

        Args:
            taken: (M, 2) pixels of the features that are tracked.
            shape: (height, width) of the image of the first camera.
            distance_px: smallest distance between features.
            find: at most so many corners, at such a distance, where a mask is not zero.
        """
        found = [np.zeros((0, 2), np.float32)]
        for hull, wanted in self.hulls:
            polygon = np.round(hull).astype(np.int32).reshape(-1, 1, 2)
            inside = [
                cv2.pointPolygonTest(polygon, p, measureDist=False) >= 0 for p in taken.tolist()
            ]
            missing = wanted - sum(inside)
            if missing <= 0:
                continue
            mask = np.zeros(shape, np.uint8)
            cv2.fillPoly(mask, [polygon], 255)
            for x, y in taken.tolist():
                cv2.circle(mask, (round(x), round(y)), round(distance_px), 0, -1)
            found.append(find(mask, missing, distance_px))
        return np.concatenate(found)
