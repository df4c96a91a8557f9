# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Corners by the score of Shi and Tomasi: the strongest maxima of it that keep their distance.

The score is that of `cv2.cornerMinEigenVal`. Gradients and their sums are whole numbers here, so
the sums are exact; OpenCV's are rounded. The maxima are those of `cv2.goodFeaturesToTrack`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["WINDOW_PX", "smallest_eigenvalues", "strongest_in_cells", "strongest_maxima"]

WINDOW_PX = 7
"""Side of the window over which the products of gradients are summed. As a constant the sums are
made of vectors."""

_RADIUS = WINDOW_PX // 2

_at = np.uintp
"""An index without a sign. Numba would test others for negative ones, and not use vectors."""

_Image = NDArray[np.uint8]
_Scores = NDArray[np.float32]
_Line = NDArray[np.int16]
_Sums = NDArray[np.int32]
_Row = NDArray[np.float32]
_Mask = NDArray[np.uint8]
_Flags = NDArray[np.uint8]
_Pixels = NDArray[np.float32]

_NO, _YES = np.uint8(0), np.uint8(1)
_HALF, _TWO = np.float32(0.5), np.int16(2)
_LARGEST = 4 * 255
"""Of a gradient by Sobel's filter of 3 x 3 pixels."""


@compiled()
def _reflected(place: int, length: int) -> int:
    """Where a line is continued beyond its ends, as by OpenCV's BORDER_REFLECT_101."""
    if length == 1:
        return 0
    while not 0 <= place < length:
        place = -place if place < 0 else 2 * length - 2 - place
    return place


@compiled()
def _gradients(
    above: _Image, here: _Image, below: _Image, smooth: _Line, rising: _Line, dx: _Line, dy: _Line
) -> None:
    """Sobel's derivatives of a row; `smooth` and `rising` are room for it and two more."""
    width = len(here)
    for u in range(width):
        a, b, c = np.int16(above[_at(u)]), np.int16(here[_at(u)]), np.int16(below[_at(u)])
        smooth[_at(u + 1)] = np.int16(np.int16(a + c) + np.int16(_TWO * b))
        rising[_at(u + 1)] = np.int16(c - a)
    smooth[0], rising[0] = smooth[2], rising[2]
    smooth[width + 1], rising[width + 1] = smooth[width - 1], rising[width - 1]
    for u in range(width):
        m, n = _at(u + 1), _at(u + 2)
        dx[_at(u)] = np.int16(smooth[n] - smooth[_at(u)])
        outer = np.int16(rising[_at(u)] + rising[n])
        dy[_at(u)] = np.int16(outer + np.int16(_TWO * rising[m]))


@compiled()
def _add(dx: _Line, dy: _Line, sign: np.int32, xx: _Sums, xy: _Sums, yy: _Sums) -> None:
    """Add the products of a row's gradients to the sums over the columns, or take them away."""
    for u in range(len(dx)):
        x, y = np.int32(dx[_at(u)]), np.int32(dy[_at(u)])
        signed_x, signed_y = np.int32(sign * x), np.int32(sign * y)
        xx[_at(u)] = np.int32(xx[_at(u)] + np.int32(signed_x * x))
        xy[_at(u)] = np.int32(xy[_at(u)] + np.int32(signed_x * y))
        yy[_at(u)] = np.int32(yy[_at(u)] + np.int32(signed_y * y))


@compiled()
def _widen(columns: _Sums, padded: _Sums, sums: _Sums) -> None:
    """Sums over the window's width along a row, which is reflected at its ends."""
    width = len(columns)
    for u in range(width):
        padded[_at(u + _RADIUS)] = columns[_at(u)]
    for k in range(_RADIUS):
        padded[k] = columns[_reflected(k - _RADIUS, width)]
        padded[width + _RADIUS + k] = columns[_reflected(width + k, width)]
    for u in range(width):
        total = np.int32(0)
        for k in range(WINDOW_PX):
            total = np.int32(total + padded[_at(u + k)])
        sums[_at(u)] = total


@compiled()
def _eigenvalues(xx: _Sums, xy: _Sums, yy: _Sums, scale: np.float32, scores: _Scores) -> None:
    """The smaller eigenvalue of each matrix ((xx, xy), (xy, yy)), times `scale`."""
    for u in range(len(scores)):
        a, c = np.float32(xx[_at(u)]) * scale * _HALF, np.float32(yy[_at(u)]) * scale * _HALF
        b = np.float32(xy[_at(u)]) * scale
        scores[_at(u)] = (a + c) - np.sqrt((a - c) * (a - c) + b * b)


@compiled()
def _scores(
    image: _Image, first_row: int, first_column: int, height: int, width: int, margin: int
) -> _Scores:
    """The scores (height, width) of a part of an image, without those of rows in the margin."""
    dx, dy = np.empty((height, width), np.int16), np.empty((height, width), np.int16)
    smooth, rising = np.empty(width + 2, np.int16), np.empty(width + 2, np.int16)
    first, last = first_column, first_column + width
    for v in range(height):
        above = image[first_row + _reflected(v - 1, height)][first:last]
        below = image[first_row + _reflected(v + 1, height)][first:last]
        here = image[first_row + v][first:last]
        _gradients(above, here, below, smooth, rising, dx[v], dy[v])
    xx, xy, yy = np.zeros(width, np.int32), np.zeros(width, np.int32), np.zeros(width, np.int32)
    sum_xx, sum_xy = np.empty(width, np.int32), np.empty(width, np.int32)
    sum_yy, padded = np.empty(width, np.int32), np.empty(width + 2 * _RADIUS, np.int32)
    unit = 1.0 / (_LARGEST * WINDOW_PX)
    scale = np.float32(unit * unit)
    scores = np.empty((height, width), np.float32)
    one, less = np.int32(1), np.int32(-1)
    for k in range(-_RADIUS, _RADIUS + 1):
        row = _reflected(k, height)
        _add(dx[row], dy[row], one, xx, xy, yy)
    for v in range(height):
        if margin <= v < height - margin:
            _widen(xx, padded, sum_xx)
            _widen(xy, padded, sum_xy)
            _widen(yy, padded, sum_yy)
            _eigenvalues(sum_xx, sum_xy, sum_yy, scale, scores[v])
        old, new = _reflected(v - _RADIUS, height), _reflected(v + _RADIUS + 1, height)
        _add(dx[old], dy[old], less, xx, xy, yy)
        _add(dx[new], dy[new], one, xx, xy, yy)
    return scores


@compiled("f4[:, ::1](u1[:, ::1])")
def smallest_eigenvalues(image: _Image) -> _Scores:
    """The smaller eigenvalue of the covariance of the gradient in a window around each pixel.

    Args:
        image: (height, width), reflected at its edges.

    Returns:
        (height, width), in the unit of `cv2.cornerMinEigenVal`.
    """
    height, width = image.shape
    return _scores(image, 0, 0, height, width, 0)


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
    highest, is_maximum = np.zeros(width, np.float32), np.zeros(-(-width // 8) * 8, np.uint8)
    eights = is_maximum.view(np.uint64)
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
        for k in range(len(eights)):
            if eights[k] == 0:
                continue
            for u in range(8 * k, 8 * k + 8):
                if is_maximum[u] != _NO:
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


@compiled()
def _clear_disks(mask: _Mask, points: _Pixels, half_widths: IntArray) -> None:
    """As `spacing.clear_disks`, which is not in this file, around whole pixels."""
    height, width = mask.shape
    radius = len(half_widths) // 2
    for n in range(len(points)):
        u, v = int(points[n, 0]), int(points[n, 1])
        for row in range(max(0, v - radius), min(height, v + radius + 1)):
            half = half_widths[row - v + radius]
            mask[row][max(0, u - half) : min(width, u + half + 1)] = _NO


@compiled()
def _in_cell(
    image: _Image,
    free: _Mask,
    cell: IntArray,
    margin: int,
    count: int,
    share: float,
    smallest: float,
    distance_px: float,
) -> _Pixels:
    """The strongest corners (N, 2) of one cell, as `strongest_in_cells` finds them."""
    left, top, right, bottom = cell[0], cell[1], cell[2], cell[3]
    first_u, first_v = max(0, left - margin), max(0, top - margin)
    width = min(image.shape[1], right + margin) - first_u
    height = min(image.shape[0], bottom + margin) - first_v
    allowed, some = np.zeros((height, width), np.uint8), _NO
    for v in range(top, bottom):
        row, own = allowed[v - first_v], free[v]
        for u in range(left, right):
            row[_at(u - first_u)] = own[_at(u)]
            some |= own[_at(u)]
    if some == _NO:
        return np.empty((0, 2), np.float32)
    scores = _scores(image, first_v, first_u, height, width, 0)
    found = strongest_maxima(scores, allowed, count, share, smallest, distance_px)
    points = np.empty((len(found), 2), np.float32)
    for n in range(len(found)):
        points[n, 0], points[n, 1] = found[n, 0] + first_u, found[n, 1] + first_v
    return points


@compiled(
    "Tuple((f4[:, ::1], i8[::1], i8[::1]))(u1[:, ::1], u1[:, ::1], i8[:, ::1], i8, i8[::1], i8, "
    "i8, f8, f8, f8, i8[::1])"
)
def strongest_in_cells(
    image: _Image,
    free: _Mask,
    cells: IntArray,
    margin: int,
    wanted: IntArray,
    missing: int,
    surplus: int,
    share: float,
    smallest: float,
    distance_px: float,
    half_widths: IntArray,
) -> tuple[_Pixels, IntArray, IntArray]:
    """Corners in cells of an image, one cell after the other, until there are enough.

    Args:
        image: (height, width).
        free: of the same size, zero where no point may be; disks around those found are cleared.
        cells: (C, 4) first column, first row, and the column and row behind the last ones.
        margin: pixels around a cell that its scores see.
        wanted: (C,) most points that count for each cell, at least one.
        missing: how many points are wanted in all.
        surplus: so many times as many are found, where there are.
        share: of the largest score of a cell; weaker ones are no corners.
        smallest: score of a corner.
        distance_px: smallest distance between two corners of a cell.
        half_widths: of the disks, as in `spacing.clear_disks`.

    Returns:
        points: (N, 2) pixels, cell by cell, the best of a cell first.
        counts: (V,) how many there are in each of the first V cells, beyond which all were found.
        quotas: (V,) how many of them were wanted.
    """
    points = np.empty((surplus * wanted.sum(), 2), np.float32)
    counts, quotas = np.empty(len(cells), np.int64), np.empty(len(cells), np.int64)
    n = seen = 0
    while seen < len(cells) and missing > 0:
        quota = min(missing, wanted[seen])
        limits = surplus * quota, share, smallest, distance_px
        found = _in_cell(image, free, cells[seen], margin, *limits)
        _clear_disks(free, found, half_widths)
        points[n : n + len(found)] = found
        counts[seen], quotas[seen] = len(found), quota
        missing -= min(quota, len(found))
        n += len(found)
        seen += 1
    return points[:n].copy(), counts[:seen].copy(), quotas[:seen].copy()
