# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Corners that were lost are looked for again, from the image in which they were last seen well.

A fast turn blurs a few images, and corners are lost in them that are in view again right after.
Lucas-Kanade compares two images and does not mind how many were taken in between, so some past
images are remembered with their corners. Those that are missing are tracked from there to the new
image, from where the rotation between the two puts them. One that is not found again in a few
images that can be tracked well is hidden, and is left alone until it has been out of view. While
nothing is found, fewer and fewer images are searched, unless many corners are lost at once, or more
are missing than are followed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.association import inside
from slam_graph.frontend.extraction import BORDER_PX
from slam_graph.frontend.image_rotation import ImageRotation, SmallImage
from slam_graph.frontend.keypoints import Pixels, Tracks
from slam_graph.frontend.lucas_kanade import LucasKanade
from slam_graph.frontend.outliers import MIN_POINTS
from slam_graph.kernels.ascending import are_among
from slam_graph.sensors import Camera

_IMAGES = 8
"""How many past images are remembered."""
_SHARE = 0.6
"""An image is remembered when fewer than this part of the corners of the last one are left."""
_LEAST = 10
"""Fewer missing corners that should be in view are not looked for."""
_TRIES = 3
"""A corner is looked for in so many good images."""
_GOOD = 0.75
"""An image is good if this part of the corners is left that there were after the one before."""
_LONGEST_PAUSE = 32
"""As many images are left out at most between two that are searched."""
_FITTING = 0.7
"""Part of the corners that must fit the motion. A wrong one is on its epipolar line by chance once
in some twenty times; where few fit, those that do are such."""

Inliers = Callable[[FloatArray, FloatArray], BoolArray]
"""Which matches (N, 2), on the plane z = 1 of two images, are of one rigid motion."""


@dataclass(eq=False)
class _Remembered:
    """A past image with its corners.

    Attributes:
        tracks: image and corners (N,).
        small: the image as it is aligned.
        turn: now_R_then (3, 3) of the camera.
        tries: (N,) in how many good images each was looked for since it came into view.
    """

    tracks: Tracks
    small: SmallImage
    turn: FloatArray
    tries: IntArray

    def keep(self, which: BoolArray) -> None:
        """Keep some of the corners only."""
        self.tracks, self.tries = self.tracks.select(which), self.tries[which]

    def forget_tries(self, missing: BoolArray) -> None:
        """Begin to count anew for corners but those (N,) that are missing and should be in view."""
        self.tries[~missing] = 0


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
        self._count = 0  # of the corners in the last image
        self._pause = self._left_out = 0  # images to leave out after a search in vain, and so far

    def turn(self, end_R_start: FloatArray) -> None:
        """Take the rotation (3, 3) of the camera since the image before."""
        for past in self._past:
            past.turn = end_R_start @ past.turn

    def remember(self, tracks: Tracks) -> None:
        """Keep an image if it shows much that the last one that was kept did not."""
        self._count = len(tracks)
        if len(tracks) < _LEAST or tracks.image is None:
            return
        if self._past:
            left = len(tracks.common(self._past[-1].tracks)[0])
            if left > _SHARE * len(self._past[-1].tracks):
                return
        small, tries = self._rotation.reduced(tracks.image), np.zeros(len(tracks), np.int64)
        self._past = [*self._past[1 - _IMAGES :], _Remembered(tracks, small, np.eye(3), tries)]

    def forget(self, ids: IntArray) -> None:
        """Do not look for these any more."""
        for past in self._past:
            past.keep(~np.isin(past.tracks.ids, ids))

    def found(self, after: Tracks, inliers: Inliers) -> tuple[IntArray, Pixels]:
        """Ids (N,), ascending, and pixels (N, 2) of missing corners that are found again.

        Args:
            after: the new image, and the corners that were followed into it.
            inliers: the test that they have in common with those that were followed.
        """
        nothing = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        good = len(after) >= _GOOD * self._count
        if not good:
            self._pause = 0
        paused = self._left_out < self._pause
        if paused and not self._may_miss_more(after):
            self._left_out += 1
            return nothing
        sought = self._sought(after)
        most = max(map(len, sought), default=0)
        if paused and most <= len(after):
            self._left_out += 1
            return nothing
        if most < _LEAST:
            return nothing
        best = max(range(len(sought)), key=lambda k: (len(sought[k]), k))
        past, rows = self._past[best], sought[best]
        if good:
            self._count_tries(past.tracks.ids[rows])
        again = self._tracked(past, rows, after, inliers)
        self._left_out, found = 0, again is not None
        if good:
            self._pause = 0 if found else min(2 * self._pause + 1, _LONGEST_PAUSE)
        return nothing if again is None else again

    def _tracked(
        self, past: _Remembered, rows: IntArray, after: Tracks, inliers: Inliers
    ) -> tuple[IntArray, Pixels] | None:
        """Corners of a past image (rows of it) that are found in the new one; None without any."""
        assert past.tracks.image is not None
        assert after.image is not None
        past.turn = self._rotation.aligned(past.small, after.image, past.turn)
        missing = past.tracks.select(rows)
        flow = self._lucas_kanade.flow(
            past.tracks.image,
            after.image,
            missing.pixels,
            self._places(_rays(past.turn, missing)),
            self._levels,
        )
        good = np.flatnonzero(flow.found & (flow.error_px < self._largest_px))
        here, there = after.common(past.tracks)
        start = np.concatenate([missing.normalized[good], past.tracks.normalized[there]])
        ends = self._camera.undistort(flow.points[good].astype(np.float64))
        end = np.concatenate([ends, after.normalized[here]])
        if len(good) < MIN_POINTS or len(start) < 2 * MIN_POINTS:
            return None
        fits = inliers(start, end)[: len(good)]
        if np.count_nonzero(fits) < max(MIN_POINTS, _FITTING * len(good)):
            return None
        return missing.ids[good[fits]], flow.points[good[fits]]

    def _sought(self, after: Tracks) -> list[IntArray]:
        """Rows of the corners of each past image to look for: missing, and should be in view."""
        if after.image is None or not self._past:
            return []
        rays = np.concatenate([_rays(past.turn, past.tracks) for past in self._past])
        ids = np.concatenate([past.tracks.ids for past in self._past])
        visible = inside(self._places(rays), after.image.shape, BORDER_PX)
        missing = visible & ~are_among(ids, after.ids)
        ends = np.cumsum([len(past.tracks) for past in self._past])[:-1]
        parts = zip(self._past, np.split(missing, ends), strict=True)
        sought = []
        for past, of_image in parts:
            past.forget_tries(of_image)
            sought.append(np.flatnonzero(of_image & (past.tries < _TRIES)))
        return sought

    def _may_miss_more(self, after: Tracks) -> bool:
        """Whether more corners of a past image may be sought than are followed, in view or not."""

        def missing(past: _Remembered) -> int:
            away = ~are_among(past.tracks.ids, after.ids) & (past.tries < _TRIES)
            return int(np.count_nonzero(away))

        large = (past for past in self._past if len(past.tracks) > len(after))
        return any(missing(past) > len(after) for past in large)

    def _count_tries(self, ids: IntArray) -> None:
        """Note that corners are looked for, whichever image they are taken from."""
        for past in self._past:
            past.tries[np.isin(past.tracks.ids, ids)] += 1

    def _places(self, rays: FloatArray) -> Pixels:
        """Where rays (N, 3) of the camera hit the image (N, 2); far outside of it if behind."""
        ahead = rays[:, 2] > 0.2
        places = np.full((len(rays), 2), -1e3)
        places[ahead] = self._camera.pixels(rays[ahead, :2] / rays[ahead, 2:])
        return places.astype(np.float32)


def _rays(turn: FloatArray, tracks: Tracks) -> FloatArray:
    """Rays (N, 3) of corners, turned by a rotation (3, 3)."""
    return np.column_stack([tracks.normalized, np.ones(len(tracks))]) @ turn.T
