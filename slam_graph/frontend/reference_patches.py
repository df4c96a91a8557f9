# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features placed by the patch in which they were first seen, so that their tracks do not drift.

Lucas-Kanade from image to image adds the error of each image to those before: after twenty images
a track is several tenths of a pixel beside its corner. So each feature keeps the patch around it of
its first image. What Lucas-Kanade found is refined until the new image shows that patch, under an
affine warp that follows the change of view (as SVO does: Forster, Pizzoli & Scaramuzza 2014,
section IV.B; the warp is estimated here, where SVO takes it from the map). Where that fails, or the
view has changed too much, the feature stays where it was tracked to, with a new patch from there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.association import inside
from slam_graph.frontend.keypoints import Image, Pixels, Tracks
from slam_graph.kernels.ascending import are_among
from slam_graph.kernels.patch_alignment import PATCH_PX, ROW_PX, align_patches
from slam_graph.kernels.patch_templates import fill_templates

_ITERATIONS, _STEP_PX = 2, 0.05
"""Most steps, and a step that is the last one: Lucas-Kanade leaves little to do."""
_LEAST_CORRELATION = 0.8
"""What is less alike is not taken for the same patch."""
_SMALLEST, _LARGEST = 0.4, 2.5
"""Change of the area of a patch beyond which a new one shows more."""
_MOST_MISSING = 3
"""Patches that are kept for each feature that is tracked: of those that are lost, too."""

_HALF = PATCH_PX // 2


class ReferencePatches:
    """The patches of the features of one camera."""

    def __init__(self) -> None:
        self._ids: IntArray = np.zeros(0, np.int64)  # ascending
        self._slots: IntArray = np.zeros(0, np.int64)  # where each of them is in what follows
        self._free: list[int] = []
        self._templates = np.zeros((0, 3, PATCH_PX * ROW_PX), np.float32)
        self._systems: FloatArray = np.zeros((0, 8, 6))
        self._warps: FloatArray = np.zeros((0, 2, 2))

    def placed(self, before: Tracks, image: Image, points: Pixels, good: BoolArray) -> Pixels:
        """Pixels (N, 2) of features in a new image, by their patches.

        Args:
            before: the image before and its features.
            image: the new one.
            points: (N, 2) where these were tracked to.
            good: (N,) which were; others stay where they are.
        """
        assert before.image is not None
        self._make_room(before.ids)
        new = np.flatnonzero(~are_among(before.ids, self._ids))
        self._add(before.image, before.ids[new], before.pixels[new])
        rows = np.flatnonzero(good & are_among(before.ids, self._ids))
        slots = self._slots[np.searchsorted(self._ids, before.ids[rows])]
        places = points[rows].astype(np.float64)
        found, correlations = align_patches(
            _for_kernels(image),
            *(self._templates, self._systems, self._warps, slots),
            *(places, _ITERATIONS, _STEP_PX),
        )
        (a, b), (c, d) = self._warps[slots].transpose(1, 2, 0)
        areas = a * d - b * c
        found &= (correlations > _LEAST_CORRELATION) & (areas > _SMALLEST) & (areas < _LARGEST)
        points = points.copy()
        points[rows[found]] = places[found]
        self._remove(are_among(self._ids, before.ids[rows[~found]]))  # new ones in the next image
        return points

    def forget(self, ids: IntArray) -> None:
        """Drop the patches of features that do not come back."""
        self._remove(are_among(self._ids, np.sort(ids)))

    def _make_room(self, ids: IntArray) -> None:
        """Forget features other than some, if there are many: a few are found again."""
        if len(self._ids) > _MOST_MISSING * len(ids) + _MOST_MISSING:
            self._remove(~are_among(self._ids, ids))

    def _remove(self, which: BoolArray) -> None:
        self._free += self._slots[which].tolist()
        self._ids, self._slots = self._ids[~which], self._slots[~which]

    def _add(self, image: Image, ids: IntArray, pixels: Pixels) -> None:
        """Take the patches around pixels (N, 2) of an image, where it has enough contrast."""
        within = inside(pixels, image.shape, _HALF + 3)
        ids, slots = ids[within], self._taken(int(np.count_nonzero(within)))
        room = self._templates, self._systems, self._warps
        pixels = np.ascontiguousarray(pixels[within], np.float32)
        rich = fill_templates(_for_kernels(image), pixels, slots, *room)
        self._free += slots[~rich].tolist()
        ids, slots = ids[rich], slots[rich]
        ids, slots = np.concatenate([self._ids, ids]), np.concatenate([self._slots, slots])
        order = np.argsort(ids, kind="stable")
        self._ids, self._slots = ids[order], slots[order]

    def _taken(self, count: int) -> IntArray:
        """So many slots that were free; there are more if need be."""
        had = len(self._templates)
        if len(self._free) < count:
            more = max(count, had)
            self._free += range(had, had + more)
            self._templates = np.concatenate([self._templates, _empty(more, self._templates)])
            self._systems = np.concatenate([self._systems, _empty(more, self._systems)])
            self._warps = np.concatenate([self._warps, _empty(more, self._warps)])
        taken, self._free = self._free[:count], self._free[count:]
        return np.array(taken, np.int64)


def _for_kernels(image: Image) -> Image:
    return np.require(image, requirements=("C", "W"))


def _empty(count: int, like: NDArray[Any]) -> NDArray[Any]:
    return np.zeros((count, *like.shape[1:]), like.dtype)
