# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features placed by the patch in which they were first seen, so that their tracks do not drift.

Lucas-Kanade from image to image adds the error of each image to those before: after twenty images
a track is several tenths of a pixel beside its corner. So each feature keeps the patch around it of
its first image. What Lucas-Kanade found is refined until the new image shows that patch, under an
affine warp that follows the change of view (as SVO does: Forster, Pizzoli & Scaramuzza 2014,
section IV.B; the warp is estimated here, where SVO takes it from the map). Where that fails the
feature stays where it was tracked to; where it fails in several images, or the view has changed too
much, it gets a new patch from there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.association import inside
from slam_graph.frontend.keypoints import Image, Pixels, Tracks, contiguous
from slam_graph.kernels.ascending import are_among
from slam_graph.kernels.patch_alignment import PATCH_PX, ROW_PX, align_patches, judge_patches
from slam_graph.kernels.patch_templates import fill_templates

_ITERATIONS, _STEP_PX = 2, 0.05
"""Most steps, and a step that is the last one: Lucas-Kanade leaves little to do."""
_LEAST_CORRELATION = 0.8
"""What is less alike is not taken for the same patch."""
_SMALLEST, _LARGEST = 0.4, 2.5
"""Change of the area of a patch beyond which a new one shows more."""
_MOST_STRETCHED = 2.0
"""The same for the ratio of the singular values of its warp, as on a wall that is seen from the
side."""
_MOST_REFUSALS = 3
"""After so many images in a row that do not show it a patch is given up: one image may be blurred,
and a patch from that would be worse."""
_KEPT_IMAGES = 100
"""A patch is kept for so many images in which its feature is not tracked: some are found again."""

_HALF = PATCH_PX // 2


class ReferencePatches:
    """The patches of the features of one camera."""

    def __init__(self) -> None:
        self._image = 0  # number of the last one
        self._ids: IntArray = np.zeros(0, np.int64)  # ascending
        self._slots: IntArray = np.zeros(0, np.int64)  # where each of them is in what follows
        self._free: list[int] = []
        self._templates = np.zeros((0, 3, PATCH_PX * ROW_PX), np.float32)
        self._systems: FloatArray = np.zeros((0, 8, 6))
        self._warps: FloatArray = np.zeros((0, 2, 2))
        self._refusals: IntArray = np.zeros(0, np.int64)  # in a row
        self._last_tracked: IntArray = np.zeros(0, np.int64)  # number of the image

    @property
    def count(self) -> int:
        """How many patches are kept."""
        return len(self._ids)

    def placed(self, before: Tracks, image: Image, points: Pixels, good: BoolArray) -> Pixels:
        """Pixels (N, 2) of features in a new image, by their patches.

        Args:
            before: the image before and its features, with ascending ids.
            image: the new one.
            points: (N, 2) where these were tracked to, in pixels.
            good: (N,) which of them were tracked; others stay where they are.
        """
        self._image += 1
        self._remove(self._last_tracked.take(self._slots) < self._image - _KEPT_IMAGES)
        own = self._slots_of(before)
        rows = (good & (own >= 0)).nonzero()[0]
        slots = own.take(rows)
        places = points.take(rows, axis=0).astype(np.float64)
        warps = self._warps.take(slots, axis=0)
        found, correlations = align_patches(
            contiguous(image),
            *(self._templates, self._systems, self._warps, slots),
            *(places, _ITERATIONS, _STEP_PX),
        )
        given_up = judge_patches(
            *(found, correlations, slots, warps, self._warps, self._refusals),
            *(_LEAST_CORRELATION, _SMALLEST, _LARGEST, _MOST_STRETCHED, _MOST_REFUSALS),
        )
        points, placed = points.copy(), found.nonzero()[0]
        points[rows.take(placed)] = places.take(placed, axis=0)
        self._last_tracked[slots] = self._image
        if np.count_nonzero(given_up):  # they get new ones in the next image
            self._remove(are_among(self._ids, before.ids[rows[given_up]]))
        return points

    def forget(self, ids: IntArray) -> None:
        """Drop the patches of features (N,) that do not come back."""
        self._remove(are_among(self._ids, np.sort(np.asarray(ids, np.int64))))

    def _remove(self, which: BoolArray) -> None:
        if np.count_nonzero(which):
            self._free += self._slots[which].tolist()
            self._ids, self._slots = self._ids[~which], self._slots[~which]

    def _slots_of(self, tracks: Tracks) -> IntArray:
        """Slots (N,) of the patches of features, -1 where there is none; takes those missing."""
        assert tracks.image is not None
        if len(self._ids):
            at = self._ids.searchsorted(tracks.ids)
            slots = self._slots.take(at, mode="clip")
            slots[self._ids.take(at, mode="clip") != tracks.ids] = -1
        else:
            slots = np.full(len(tracks), -1)
        new = (slots < 0).nonzero()[0]
        if len(new):
            slots[new] = self._add(tracks.image, tracks.ids[new], tracks.pixels[new])
        return slots

    def _add(self, image: Image, ids: IntArray, pixels: Pixels) -> IntArray:
        """Take the patches around pixels (N, 2) of an image, where it has enough contrast.

        Returns:
            (N,) where they are; -1 where none was taken.
        """
        within = inside(pixels, image.shape, _HALF + 3).nonzero()[0]
        slots = self._taken(len(within))
        room = self._templates, self._systems, self._warps
        middles = np.ascontiguousarray(pixels[within], np.float32)
        textured = fill_templates(contiguous(image), middles, slots, *room)
        self._free += slots[~textured].tolist()
        taken, slots = within[textured], slots[textured]
        self._refusals[slots], self._last_tracked[slots] = 0, self._image
        kept = np.concatenate([self._ids, ids[taken]])
        order = kept.argsort(kind="stable")
        self._ids, self._slots = kept[order], np.concatenate([self._slots, slots])[order]
        result = np.full(len(ids), -1)
        result[taken] = slots
        return result

    def _taken(self, count: int) -> IntArray:
        """So many slots that were free; there are more if need be."""
        had = len(self._templates)
        if len(self._free) < count:
            more = max(count, had)
            self._free += range(had, had + more)
            self._templates = _longer(self._templates, more)
            self._systems, self._warps = _longer(self._systems, more), _longer(self._warps, more)
            self._refusals = _longer(self._refusals, more)
            self._last_tracked = _longer(self._last_tracked, more)
        taken, self._free = self._free[:count], self._free[count:]
        return np.array(taken, np.int64)


def _longer(rows: NDArray[Any], count: int) -> NDArray[Any]:
    """Rows with so many zeros behind them."""
    return np.concatenate([rows, np.zeros((count, *rows.shape[1:]), rows.dtype)])
