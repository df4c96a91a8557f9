# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Corners that were lost are looked for again, from the image in which they were last seen well.

A fast turn blurs a few images, and corners are lost in them that are in view again right after.
Lucas-Kanade compares two images and does not mind how many were taken in between, so some past
images are remembered with their corners. Those that are missing are tracked from there to the new
image, from where the rotation between the two puts them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.association import inside
from slam_graph.frontend.extraction import BORDER_PX
from slam_graph.frontend.image_rotation import ImageRotation
from slam_graph.frontend.keypoints import Pixels, Tracks
from slam_graph.frontend.lucas_kanade import LucasKanade
from slam_graph.frontend.outliers import MIN_POINTS
from slam_graph.sensors import Camera

_IMAGES = 8
"""How many past images are remembered."""
_SHARE = 0.6
"""An image is remembered when fewer than this part of the corners of the last one are left."""
_LEAST = 10
"""Fewer missing corners that should be in view are not looked for."""
_FITTING = 0.7
"""Part of the corners that must fit the motion. A wrong one is on its epipolar line by chance once
in some twenty times; where few fit, those that do are such."""

Inliers = Callable[[FloatArray, FloatArray], BoolArray]
"""Which matches (N, 2), on the plane z = 1 of two images, are of one rigid motion."""


@dataclass(eq=False)
class _Remembered:
    """A past image with its corners, and now_R_then (3, 3) of the camera."""

    tracks: Tracks
    turn: FloatArray


class LostFeatures:
    """Finds the corners of one camera again.

    Args:
        camera: the camera.
        rotation: aligns images.
        lucas_kanade: tracks.
        levels: of the pyramid.
        largest_px: error of a corner that is tracked forth and back.
    """

    def __init__(
        self,
        camera: Camera,
        rotation: ImageRotation,
        lucas_kanade: LucasKanade,
        levels: int,
        largest_px: float,
    ) -> None:
        self._camera, self._rotation, self._lucas_kanade = camera, rotation, lucas_kanade
        self._levels, self._largest_px = levels, largest_px
        self._past: list[_Remembered] = []

    def turn(self, end_R_start: FloatArray) -> None:
        """Take the rotation (3, 3) of the camera since the image before."""
        for past in self._past:
            past.turn = end_R_start @ past.turn

    def remember(self, tracks: Tracks) -> None:
        """Keep an image if it shows much that the last one that was kept did not."""
        if len(tracks) < _LEAST:
            return
        if self._past:
            left = len(tracks.common(self._past[-1].tracks)[0])
            if left > _SHARE * len(self._past[-1].tracks):
                return
        self._past = [*self._past[1 - _IMAGES :], _Remembered(tracks, np.eye(3))]

    def forget(self, ids: IntArray) -> None:
        """Do not look for these any more."""
        for past in self._past:
            past.tracks = past.tracks.select(~np.isin(past.tracks.ids, ids))

    def found(self, after: Tracks, inliers: Inliers) -> tuple[IntArray, Pixels]:
        """Ids (N,), ascending, and pixels (N, 2) of missing corners that are found again.

        Args:
            after: the new image, and the corners that were followed into it.
            inliers: the test that they have in common with those that were followed.
        """
        nothing = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        if after.image is None:
            return nothing
        seen = [self._in_view(past, after) for past in self._past]
        if not seen or max(map(len, seen)) < _LEAST:
            return nothing
        best = max(range(len(seen)), key=lambda k: (len(seen[k]), k))
        past, rows = self._past[best], seen[best]
        assert past.tracks.image is not None
        past.turn = self._rotation.aligned(past.tracks.image, after.image, past.turn)
        missing = past.tracks.select(rows)
        flow = self._lucas_kanade.flow(
            past.tracks.image,
            after.image,
            missing.pixels,
            self._places(past.turn, missing),
            self._levels,
        )
        good = np.flatnonzero(flow.found & (flow.error_px < self._largest_px))
        here, there = after.common(past.tracks)
        start = np.concatenate([missing.normalized[good], past.tracks.normalized[there]])
        ends = self._camera.undistort(flow.points[good].astype(np.float64))
        end = np.concatenate([ends, after.normalized[here]])
        if len(good) < MIN_POINTS or len(start) < 2 * MIN_POINTS:
            return nothing
        fits = inliers(start, end)[: len(good)]
        if np.count_nonzero(fits) < max(MIN_POINTS, _FITTING * len(good)):
            return nothing
        return missing.ids[good[fits]], flow.points[good[fits]]

    def _places(self, turn: FloatArray, tracks: Tracks) -> Pixels:
        """Where the rotation puts corners (N, 2); far outside of the image if behind it."""
        rays = np.column_stack([tracks.normalized, np.ones(len(tracks))]) @ turn.T
        ahead = rays[:, 2] > 0.2
        places = np.full((len(tracks), 2), -1e3)
        places[ahead] = self._camera.distort(rays[ahead, :2] / rays[ahead, 2:])[0]
        return places.astype(np.float32)

    def _in_view(self, past: _Remembered, after: Tracks) -> IntArray:
        """Rows of the corners of a past image that are missing and should be in the new one."""
        assert after.image is not None
        missing = ~np.isin(past.tracks.ids, after.ids)
        there = inside(self._places(past.turn, past.tracks), after.image.shape, BORDER_PX)
        return np.flatnonzero(missing & there)
