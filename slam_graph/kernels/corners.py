# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The strongest local maxima of a score that keep their distance, as `cv2.goodFeaturesToTrack`."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["strongest_maxima", "strongest_maxima_numpy"]

_at = np.uintp
"""An index without a sign. Numba would test others for negative ones, and not use vectors."""

_Scores = NDArray[np.float32]
_Row = NDArray[np.float32]
_Mask = NDArray[np.uint8]
_Flags = NDArray[np.uint8]
_NO, _YES = np.uint8(0), np.uint8(1)


# Rows, in loops without branches, which are made of vectors


@compiled()
def _raise_to(highest: _Row, scores: _Row, allowed: _Flags) -> None:
    """The larger ones of what was highest and the scores that are allowed."""
    for u in range(len(highest)):
        s, other = scores[_at(u)], highest[_at(u)]
        highest[_at(u)] = s if (s > other) & (allowed[_at(u)] != _NO) else other


@compiled()
def _column_maxima(above: _Row, here: _Row, below: _Row, highest: _Row) -> None:
    """The largest of three scores in a column."""
    for u in range(len(highest)):
        one, other, s = above[_at(u)], below[_at(u)], here[_at(u)]
        other = one if one > other else other
        highest[_at(u)] = s if s > other else other


@compiled()
def _row_maxima(
    scores: _Row, highest: _Row, allowed: _Flags, limit: np.float32, result: _Flags
) -> None:
    """Where a score is allowed, above a limit, and that of the highest columns around it."""
    for u in range(1, len(scores) - 1):
        left, middle, right = highest[_at(u - 1)], highest[_at(u)], highest[_at(u + 1)]
        other = left if left > right else right
        other = middle if middle > other else other
        s = scores[_at(u)]
        good = (s > limit) & (s >= other) & (allowed[_at(u)] != _NO)
        result[_at(u)] = _YES if good else _NO


@compiled("f4[:, ::1](f4[:, ::1], u1[:, ::1], i8, f8, f8, f8)")
def strongest_maxima(
    scores: _Scores, allowed: _Mask, count: int, share: float, smallest: float, distance_px: float
) -> _Scores:
    """The strongest pixels that are as strong as their eight neighbours and keep their distance.

    A maximum that keeps its distance from all stronger ones that were taken is taken too, also if
    it is weaker than `smallest`; but those are not returned. Of two that are equally strong the one
    further down or to the right comes first.

    Args:
        scores: (height, width).
        allowed: of the same size, zero where no point may be. The edge of the image is left out.
        count: most that are wanted.
        share: of the largest score that is allowed; weaker ones do not count.
        smallest: score of those that are returned.
        distance_px: smallest distance between two of them.

    Returns:
        (N, 3) column, row and score, the best first.
    """
    height, width = scores.shape
    highest, is_maximum = np.empty(width, np.float32), np.empty(width, np.uint8)
    for u in range(width):
        highest[u] = 0.0
    for v in range(height):
        _raise_to(highest, scores[v], allowed[v])
    largest = np.float32(0.0)
    for u in range(width):
        largest = highest[u] if highest[u] > largest else largest
    limit = np.float32(float(largest) * share)
    found = np.empty((height * width, 3), np.float32)
    n = 0
    for v in range(1, height - 1):
        _column_maxima(scores[v - 1], scores[v], scores[v + 1], highest)
        _row_maxima(scores[v], highest, allowed[v], limit, is_maximum)
        for u in range(1, width - 1):
            if is_maximum[u] == 0:
                continue
            found[n, 0], found[n, 1], found[n, 2] = u, v, scores[v, u]
            n += 1
    chosen = np.empty((count, 3), np.float32)
    near = np.float32(min(distance_px * distance_px, 1e12))
    for taken in range(count):
        best, most = -1, np.float32(0.0)
        for k in range(n):
            if found[k, 2] > 0.0 and found[k, 2] >= most:
                best, most = k, found[k, 2]
        if best < 0 or float(most) < smallest:
            return chosen[:taken].copy()
        column, row = found[best, 0], found[best, 1]
        chosen[taken, 0], chosen[taken, 1], chosen[taken, 2] = column, row, most
        found[best, 2] = 0.0
        for k in range(n):  # those too near to it are no more
            x, y = found[k, 0] - column, found[k, 1] - row
            if x * x + y * y < near:
                found[k, 2] = 0.0
    return chosen


def strongest_maxima_numpy(
    scores: _Scores, allowed: _Mask, count: int, share: float, smallest: float, distance_px: float
) -> FloatArray:
    """`strongest_maxima` in NumPy."""
    inside = np.zeros(scores.shape, np.bool_)
    inside[1:-1, 1:-1] = True
    largest = max(scores[allowed != 0], default=np.float32(0.0))
    limit = max(np.float32(0.0), np.float32(float(largest) * share))
    neighbours = cv2.dilate(scores, np.ones((3, 3), np.uint8))
    v, u = np.nonzero((scores > limit) & (scores >= neighbours) & (allowed != 0) & inside)
    rows = np.column_stack([u, v, scores[v, u]])[::-1]
    rows = rows[np.argsort(-rows[:, 2], kind="stable")]
    chosen: list[int] = []
    for k, row in enumerate(rows):
        apart = np.hypot(*(rows[chosen, :2] - row[:2]).T) >= distance_px
        if len(chosen) < count and np.all(apart):
            chosen.append(k)
    best = rows[chosen]
    return np.asarray(best[best[:, 2] >= smallest], np.float64)
