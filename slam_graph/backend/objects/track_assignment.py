# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which tracks are of which object: each is of the one whose motion it fits best.

Squared errors of a track under the motion of an object are compared with those under the motions of
the other objects, and of a static point. Twice the logarithm of the ratio of the likelihoods is
their difference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray, ascending_union
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.gating import threshold
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.motion_test import MotionTest, Verdict
from slam_graph.backend.objects.track_labels import TrackLabels
from slam_graph.backend.objects.track_window import TrackWindow, quantile
from slam_graph.backend.objects.tracked_object import TrackedObject

MARGIN = 12.0
"""Twice the logarithm of the ratio of likelihoods from which a track is of one world and not of
another: 1 in 400."""
FITS = 1e-4
"""Probability of the errors of a track that fits."""
_CLEARLY = 2.0
"""Factor on that limit for tracks that are of an object already."""
_BEST = 0.3
"""Share of the tracks of an object that is of it beyond doubt."""


class TrackAssignment:
    """Gives tracks to objects, and takes them away.

    Args:
        window: the last frames.
        labels: masks of the last frame.
        ego: the motion of the platform over the frames.
        sigma_px: standard deviation of the observations.
    """

    def __init__(
        self, window: TrackWindow, labels: TrackLabels, ego: EgoMotion, sigma_px: float
    ) -> None:
        self._window, self._labels, self._sigma_px = window, labels, sigma_px
        self._static = dict(zip(ego.stamps_ns, ego.poses, strict=True))
        self._found: dict[int, tuple[IntArray, FloatArray, IntArray]] = {}  # by object

    def join(self, objects: Sequence[TrackedObject], test: MotionTest) -> None:
        """Tracks go to the object whose motion they fit, if they fit no other one, nor the world.

        Those of one object go over to another if they fit that clearly better.
        """
        if not objects:
            return
        own = members_of(objects)
        free = test.ids[(test.verdicts != Verdict.STATIC) & ~is_in(test.ids, own)]
        ids = ascending_union(free, own)
        for item in objects:
            self._found[item.number] = self._window.misfit(ids, item.poses, self._sigma_px)
        squares = np.stack([self._squares(item, ids) for item in objects])
        best, rows = np.argmin(squares, axis=0), np.arange(len(ids))
        least = squares[best, rows]
        others = squares.copy()
        others[best, rows] = np.inf
        clear = _clearly(least, others.min(axis=0))
        is_free, before = is_in(ids, free), _of_own(objects, ids, squares)
        # masks tell what is of the object, and not static
        alone = None if self._labels.given else self._as_static(ids, clear & is_free)
        for k, item in enumerate(objects):
            mine = clear & (best == k)
            new = mine & is_free
            if alone is not None:
                new &= _clearly(least, alone, self._scale(item))
            over = mine & ~is_free & ~is_in(ids, item.members) & _clearly(least, before)
            for other in objects:
                other.members = other.members[~is_in(other.members, ids[over])]
            item.members = ascending_union(item.members, ids[new | over])

    def leaving(self, item: TrackedObject) -> IntArray:
        """Ids (N,) of the tracks that are not of an object any more.

        They do not fit it, have another label, or are static where the object moves. `join` has to
        be called first: it finds how well tracks fit.
        """
        fit, squares, dof = self._misfit(item, item.members)
        unfit = squares > _CLEARLY * _scale(squares, dof) * threshold(dof, 1.0 - FITS)
        leaving = ascending_union(fit[unfit], self._labels.contradicted(item.members, item.label))
        if not item.moving:
            return leaving
        rest = ~unfit & (squares > MARGIN)  # no other can be static: errors are not negative
        fit, squares = fit[rest], squares[rest]
        frames = {stamp: pose for stamp, pose in self._static.items() if stamp in item.poses}
        same, alone, dof = self._window.misfit(fit, frames, self._sigma_px)
        alone, limit = _for(fit, same, alone), _for(fit, same, threshold(dof, 1.0 - FITS))
        static = (squares - alone > MARGIN) & (alone < limit)
        return ascending_union(leaving, fit[static])

    def _misfit(self, item: TrackedObject, ids: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
        """How well tracks fit the motion of an object, as `join` has found.

        Args:
            item: the object.
            ids: of tracks that `join` looked at: free ones, and those of objects.

        Returns:
            As `TrackWindow.misfit`.
        """
        found, squares, dof = self._found[item.number]
        rows = is_in(found, ids)
        return found[rows], squares[rows], dof[rows]

    def _squares(self, item: TrackedObject, ids: IntArray) -> FloatArray:
        """Squared errors (N,) of tracks under the motion of an object.

        They are infinite where a track does not fit, or is not of its mask.
        """
        fit, errors, dof = self._misfit(item, self._labels.allowed(ids, item.label))
        limit = self._scale(item) * threshold(dof, 1.0 - FITS)
        return _for(ids, fit, np.where(errors < limit, errors, np.inf))

    def _as_static(self, ids: IntArray, wanted: BoolArray) -> FloatArray:
        """Squared errors (N,) of tracks as static points; infinite where they are not wanted."""
        fit, errors, _ = self._window.misfit(ids[wanted], self._static, self._sigma_px)
        return _for(ids, fit, errors)

    def _scale(self, item: TrackedObject) -> float:
        """Squared errors of the tracks of an object over what is expected, by its poses as known.

        At first the poses are known badly, and no track fits them as well as it will.
        """
        _, squares, dof = self._misfit(item, item.members)
        return _scale(squares, dof)


def members_of(objects: Sequence[TrackedObject]) -> IntArray:
    """Ids (N,) of the tracks of objects, ascending."""
    return ascending_union(*(item.members for item in objects))


def _of_own(objects: Sequence[TrackedObject], ids: IntArray, squares: FloatArray) -> FloatArray:
    """Squared errors (N,) of tracks under the motion of the object that they are of."""
    own = np.full(len(ids), np.inf)
    for row, item in zip(squares, objects, strict=True):
        mine = is_in(ids, item.members)
        own[mine] = row[mine]
    return own


def _clearly(squares: FloatArray, others: FloatArray, scale: float = 1.0) -> BoolArray:
    """Whether squared errors (N,) are finite, and clearly less than others (N,)."""
    known = np.isfinite(squares)
    return known & (others > np.where(known, squares, 0.0) + scale * MARGIN)


def _scale(squares: FloatArray, dof: IntArray) -> float:
    """Squared errors of the tracks that fit best, over what is expected; at least 1."""
    if len(dof) == 0:
        return 1.0
    return max(1.0, quantile(squares / dof, _BEST))


def _for(ids: IntArray, found: IntArray, values: FloatArray | IntArray) -> FloatArray:
    """Values (N,) for ids (N,) where some were found (both ascending); infinite for the others."""
    result = np.full(len(ids), np.inf)
    result[is_in(ids, found)] = values
    return result
