# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Points of two sets that are near each other."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "median_motions",
    "median_motions_numpy",
    "near_pairs",
    "near_pairs_numpy",
    "nearest",
    "nearest_numpy",
]

_Pixels = NDArray[np.float32]


@compiled()
def _strips(points: FloatArray, distance: float) -> tuple[float, float, int]:
    """Vertical strips of the plane, as many as there are points at most.

    Returns:
        Where the first one begins, their width, at least `distance`, and their number.
    """
    left, right = math.inf, -math.inf
    for j in range(len(points)):
        if math.isfinite(points[j, 0]):
            left, right = min(left, points[j, 0]), max(right, points[j, 0])
    extent = right - left
    if not (left <= right and math.isfinite(extent) and math.isfinite(distance)):
        return 0.0, 1.0, 0
    # wider by more than what is rounded where a point is looked for
    width = max(1.000001 * distance, extent / len(points), 1e-300)
    return left, width, math.floor(extent / width) + 1


@compiled()
def _strip(x: float, left: float, width: float, strips: int) -> int:
    """The strip of a coordinate; outside of -2 to `strips` + 1 it is the nearest of these."""
    return math.floor(min(max((x - left) / width, -2.0), strips + 1.0))


@compiled()
def _resized(pairs: IntArray, count: int) -> IntArray:
    """The rows, as many as there is room for, in an array of another length."""
    rows = np.empty((count, 2), np.int64)
    for k in range(min(count, len(pairs))):
        rows[k, 0], rows[k, 1] = pairs[k, 0], pairs[k, 1]
    return rows


@compiled("i8[:, ::1](f8[:, ::1], f8[:, ::1], f8)")
def near_pairs(first: FloatArray, second: FloatArray, distance: float) -> IntArray:
    """Which points are at most so far apart; none that is not finite, or beyond 1e307.

    Args:
        first: (N, 2).
        second: (M, 2).
        distance: largest distance.

    Returns:
        (P, 2) rows of both, ascending.
    """
    left, width, strips = _strips(first, distance)
    starts, order = np.zeros(strips + 2, np.int64), np.empty(len(first), np.int64)
    for i in range(len(first)):
        if math.isfinite(first[i, 0]):
            starts[_strip(first[i, 0], left, width, strips) + 2] += 1
    for s in range(2, strips + 2):
        starts[s] += starts[s - 1]
    for i in range(len(first)):  # now strip s begins at starts[s + 1], and in the end at starts[s]
        if math.isfinite(first[i, 0]):
            s = _strip(first[i, 0], left, width, strips) + 1
            order[starts[s]] = i
            starts[s] += 1
    pairs, count, limit = np.empty((4 * len(first) + 16, 2), np.int64), 0, distance * distance
    ends = np.zeros(len(first) + 1, np.int64)
    for j in range(len(second)):
        if not math.isfinite(second[j, 0]):
            continue
        own = _strip(second[j, 0], left, width, strips)
        for k in range(starts[max(own - 1, 0)], starts[max(min(own + 2, strips), 0)]):
            i = order[k]
            dx, dy = second[j, 0] - first[i, 0], second[j, 1] - first[i, 1]
            if dx * dx + dy * dy <= limit:
                if count == len(pairs):
                    pairs = _resized(pairs, 2 * count)
                pairs[count, 0], pairs[count, 1] = i, j
                ends[i + 1] += 1
                count += 1
    for i in range(len(first)):
        ends[i + 1] += ends[i]
    found = np.empty((count, 2), np.int64)
    for k in range(count):  # ascending in the second row, so that each place is the next free one
        place = ends[pairs[k, 0]]
        found[place, 0], found[place, 1] = pairs[k, 0], pairs[k, 1]
        ends[pairs[k, 0]] += 1
    return found


def near_pairs_numpy(first: FloatArray, second: FloatArray, distance: float) -> IntArray:
    """`near_pairs` in NumPy."""
    squares = np.sum((second - first[:, None]) ** 2, axis=2)
    return np.argwhere(squares <= distance * distance)


@compiled("i8[:, ::1](f4[:, ::1], f4[:, ::1], i8)")
def nearest(points: _Pixels, places: _Pixels, count: int) -> IntArray:
    """The points that are nearest to each place, by comparing all with all.

    Args:
        points: (N, 2), at least `count`.
        places: (M, 2).
        count: how many are wanted for each place.

    Returns:
        (M, count) rows of the points, the nearest first.
    """
    chosen = np.empty((len(places), count), np.int64)
    squares = np.empty(count)
    for m in range(len(places)):
        x, y = float(places[m, 0]), float(places[m, 1])
        squares[:] = np.inf
        for n in range(len(points)):
            dx, dy = float(points[n, 0]) - x, float(points[n, 1]) - y
            square = dx * dx + dy * dy
            if square >= squares[count - 1] and n >= count:
                continue
            k = min(n, count - 1)
            while k > 0 and squares[k - 1] > square:
                squares[k], chosen[m, k] = squares[k - 1], chosen[m, k - 1]
                k -= 1
            squares[k], chosen[m, k] = square, n
    return chosen


def nearest_numpy(points: _Pixels, places: _Pixels, count: int) -> IntArray:
    """`nearest` in SciPy."""
    from scipy.spatial import cKDTree  # it takes a moment to import

    rows: IntArray = cKDTree(points).query(places, k=count)[1]
    return rows.reshape(len(places), count)


@compiled("f4[:, ::1](f4[:, ::1], f4[:, ::1], f4[:, ::1], i8)")
def median_motions(start: _Pixels, end: _Pixels, places: _Pixels, count: int) -> _Pixels:
    """The median motion of the points that are nearest to each place, of each coordinate by itself.

    Args:
        start: (N, 2) where points were, at least `count`.
        end: (N, 2) where they are.
        places: (M, 2) near which points were.
        count: how many of them count for each place, an odd number.

    Returns:
        (M, 2).
    """
    chosen, motions = nearest(start, places, count), np.empty((len(places), 2), np.float32)
    ascending = np.empty(count, np.float32)
    for m in range(len(places)):
        for axis in range(2):
            for k in range(count):
                n, place = chosen[m, k], k
                motion = end[n, axis] - start[n, axis]
                while place > 0 and ascending[place - 1] > motion:
                    ascending[place] = ascending[place - 1]
                    place -= 1
                ascending[place] = motion
            motions[m, axis] = ascending[count // 2]
    return motions


def median_motions_numpy(start: _Pixels, end: _Pixels, places: _Pixels, count: int) -> _Pixels:
    """`median_motions` in NumPy."""
    motions = (end - start)[nearest_numpy(start, places, count)]
    return np.asarray(np.median(motions, axis=1), np.float32)
