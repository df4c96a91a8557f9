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

__all__ = [
    "LARGEST_GRADIENT",
    "WINDOW_PX",
    "smallest_eigenvalues",
    "strongest_in_cells",
    "strongest_maxima",
]

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
LARGEST_GRADIENT = 4 * 255
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
def _gradients(above: _Image, here: _Image, below: _Image, dx: _Line, dy: _Line) -> None:
    """Sobel's derivatives of a row, without intermediate ones that would be read at once."""
    width = len(here)
    for u in range(width - 2):
        k, m, n = _at(u), _at(u + 1), _at(u + 2)
        a, b, c, d = np.int16(above[k]), np.int16(above[n]), np.int16(below[k]), np.int16(below[n])
        first = np.int16(np.int16(a + c) + np.int16(_TWO * np.int16(here[k])))
        last = np.int16(np.int16(b + d) + np.int16(_TWO * np.int16(here[n])))
        outer = np.int16(np.int16(c - a) + np.int16(d - b))
        inner = np.int16(np.int16(below[m]) - np.int16(above[m]))
        dx[m], dy[m] = np.int16(last - first), np.int16(outer + np.int16(_TWO * inner))
    for u in range(0, width, max(width - 1, 1)):  # at the ends both neighbours are the same
        other = min(1, width - 1) if u == 0 else u - 1
        dx[u], outer = 0, np.int16(below[other]) - np.int16(above[other])
        dy[u] = _TWO * (outer + np.int16(below[u]) - np.int16(above[u]))


# Sums over the columns of the window; few arrays in a loop, or it is not made of vectors


@compiled()
def _move_squares(old: _Line, new: _Line, sums: _Sums) -> None:
    """Take the squares of a row's gradients from sums, and add those of another: n² - o²."""
    for u in range(len(sums)):
        n, o = new[_at(u)], old[_at(u)]
        change = np.int32(np.int32(np.int16(n - o)) * np.int32(np.int16(n + o)))
        sums[_at(u)] = np.int32(sums[_at(u)] + change)


@compiled()
def _move_products(old_x: _Line, old_y: _Line, new_x: _Line, new_y: _Line, sums: _Sums) -> None:
    """The same with the products of both gradients."""
    for u in range(len(sums)):
        new = np.int32(np.int32(new_x[_at(u)]) * np.int32(new_y[_at(u)]))
        old = np.int32(np.int32(old_x[_at(u)]) * np.int32(old_y[_at(u)]))
        sums[_at(u)] = np.int32(sums[_at(u)] + np.int32(new - old))


@compiled()
def _reflect(xx: _Sums, xy: _Sums, yy: _Sums) -> None:
    """Continue a row of sums beyond its ends, where there is room for it."""
    width = len(xx) - 2 * _RADIUS
    for k in range(2 * _RADIUS):
        place = k - _RADIUS if k < _RADIUS else k - _RADIUS + width
        here, there = place + _RADIUS, _reflected(place, width) + _RADIUS
        xx[here], xy[here], yy[here] = xx[there], xy[there], yy[there]


@compiled()
def _eigenvalues(xx: _Sums, xy: _Sums, yy: _Sums, scale: np.float32, scores: _Row) -> None:
    """The smaller eigenvalues of a row, times `scale`, by sums over columns that are continued."""
    for u in range(len(scores)):
        sum_xx = sum_xy = sum_yy = np.int32(0)
        for k in range(WINDOW_PX):
            n = _at(u + k)
            sum_xx = np.int32(sum_xx + xx[n])
            sum_xy, sum_yy = np.int32(sum_xy + xy[n]), np.int32(sum_yy + yy[n])
        a, c = np.float32(sum_xx) * scale * _HALF, np.float32(sum_yy) * scale * _HALF
        b = np.float32(sum_xy) * scale
        scores[_at(u)] = (a + c) - np.sqrt((a - c) * (a - c) + b * b)


@compiled()
def _fill_scores(image: _Image, left: int, top: int, scores: _Scores) -> None:
    """The scores (height, width) of a part of an image, which is reflected at its edges."""
    height, width = scores.shape
    # one row more, which is zero
    dx, dy = np.zeros((height + 1, width), np.int16), np.zeros((height + 1, width), np.int16)
    right = left + width
    for v in range(height):
        above = image[top + _reflected(v - 1, height)][left:right]
        below = image[top + _reflected(v + 1, height)][left:right]
        _gradients(above, image[top + v][left:right], below, dx[v], dy[v])
    length = width + 2 * _RADIUS
    xx, xy, yy = np.zeros(length, np.int32), np.zeros(length, np.int32), np.zeros(length, np.int32)
    own_xx, own_xy = xx[_RADIUS : _RADIUS + width], xy[_RADIUS : _RADIUS + width]
    own_yy = yy[_RADIUS : _RADIUS + width]
    unit = 1.0 / (LARGEST_GRADIENT * WINDOW_PX)
    scale = np.float32(unit * unit)
    for row in range(-_RADIUS, height + _RADIUS):
        first = row - WINDOW_PX + 1  # of the window whose last one this is
        new = _reflected(row, height)
        old = height if first <= -_RADIUS else _reflected(first - 1, height)
        _move_squares(dx[old], dx[new], own_xx)
        _move_squares(dy[old], dy[new], own_yy)
        _move_products(dx[old], dy[old], dx[new], dy[new], own_xy)
        if first >= -_RADIUS:
            _reflect(xx, xy, yy)
            _eigenvalues(xx, xy, yy, scale, scores[first + _RADIUS])


def smallest_eigenvalues(image: _Image) -> _Scores:
    """The smaller eigenvalue of the covariance of the gradient in a window around each pixel.

    Args:
        image: (height, width), reflected at its edges.

    Returns:
        (height, width), in the unit of `cv2.cornerMinEigenVal`.
    """
    height, width = image.shape
    scores, nothing = np.empty(height * width, np.float32), np.zeros((0, 2), np.float32)
    cell, one = np.array([[0, 0, width, height]], np.int64), np.ones(1, np.int64)
    # no corners are asked for; a kernel of its own would be all the same code, compiled twice
    places = image, np.ones_like(image), cell, 0, one, 1, 0
    limits = 0.0, 0.0, 0.0, np.zeros(1, np.int64)
    strongest_in_cells(*places, *limits, scores, nothing, one.copy(), one.copy())
    return scores.reshape(height, width)


# Rows, in loops without branches, which are made of vectors


@compiled()
def _largest_allowed(scores: NDArray[np.int32], allowed: _Flags) -> np.int32:
    """The largest number that is allowed, at least 0."""
    largest = np.int32(0)
    for u in range(len(scores)):
        s = scores[_at(u)] if allowed[_at(u)] != _NO else np.int32(0)
        largest = s if s > largest else largest
    return largest


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
    highest, is_maximum = np.zeros(width, np.float32), np.zeros(width, np.uint8)
    # Numbers above 0 are in the order of their bits, of which the largest is found by vectors
    bits, largest = scores.view(np.int32), np.zeros(1, np.int32)
    for v in range(height):
        largest[0] = max(largest[0], _largest_allowed(bits[v], allowed[v]))
    limit = np.float32(float(largest.view(np.float32)[0]) * share)
    found = np.empty((height * width, 3), np.float32)
    n = 0
    for v in range(1, height - 1):
        _column_maxima(scores[v - 1], scores[v], scores[v + 1], highest)
        _row_maxima(scores[v], highest, allowed[v], limit, is_maximum)
        for u in range(1, width - 1):
            if is_maximum[u] != _NO:
                found[n, 0], found[n, 1], found[n, 2] = u, v, scores[v, u]
                n += 1
    chosen, taken = np.empty((count, 3), np.float32), 0
    near = np.float32(min(distance_px * distance_px, 1e12))
    while taken < count:
        best, most = -1, np.float32(0.0)
        for k in range(n):
            if found[k, 2] > 0.0 and found[k, 2] >= most:
                best, most = k, found[k, 2]
        if best < 0 or float(most) < smallest:
            break
        column, row = found[best, 0], found[best, 1]
        chosen[taken, 0], chosen[taken, 1], chosen[taken, 2] = column, row, most
        found[best, 2] = 0.0
        taken += 1
        for k in range(n):  # those too near to it are no more
            x, y = found[k, 0] - column, found[k, 1] - row
            if x * x + y * y < near:
                found[k, 2] = 0.0
    return chosen[:taken]


@compiled()
def _clear_disk(mask: _Mask, u: int, v: int, half_widths: IntArray) -> None:
    """As `spacing.clear_disks`, which is not in this file, around one pixel."""
    height, width = mask.shape
    radius = len(half_widths) // 2
    for row in range(max(0, v - radius), min(height, v + radius + 1)):
        half = half_widths[row - v + radius]
        for column in range(max(0, u - half), min(width, u + half + 1)):
            mask[row, column] = _NO


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
    room: _Row,
    points: _Pixels,
    begin: int,
) -> int:
    """Write the strongest corners of one cell to rows of `points`, and say how many there are."""
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
        return 0
    scores = room[: height * width].reshape((height, width))
    _fill_scores(image, first_u, first_v, scores)
    found = strongest_maxima(scores, allowed, count, share, smallest, distance_px)
    for k in range(len(found)):
        points[begin + k, 0], points[begin + k, 1] = found[k, 0] + first_u, found[k, 1] + first_v
    return len(found)


@compiled(
    "i8(u1[:, ::1], u1[:, ::1], i8[:, ::1], i8, i8[::1], i8, i8, f8, f8, f8, i8[::1], "
    "f4[::1], f4[:, ::1], i8[::1], i8[::1])"
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
    room: _Row,
    points: _Pixels,
    counts: IntArray,
    quotas: IntArray,
) -> int:
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
        room: as large as the largest cell and its margin; filled with scores by rows.
        points: filled with pixels, cell by cell, the best of a cell first; `surplus` times as many
            as are wanted fit in.
        counts: (C,) filled with how many there are in each cell.
        quotas: (C,) filled with how many were wanted of it.

    Returns:
        In how many cells they were looked for.
    """
    n = seen = 0
    while seen < len(cells) and missing > 0:
        quota = min(missing, wanted[seen])
        limits = surplus * quota, share, smallest, distance_px
        count = _in_cell(image, free, cells[seen], margin, *limits, room, points, n)
        for k in range(n, n + count):
            _clear_disk(free, int(points[k, 0]), int(points[k, 1]), half_widths)
        counts[seen], quotas[seen] = count, quota
        missing -= min(quota, count)
        n += count
        seen += 1
    return seen
