# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The score of Shi and Tomasi for all pixels of a part of an image, as `cv2.cornerMinEigenVal`.

Gradients and their sums are whole numbers, so the sums are exact; OpenCV's are rounded.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.kernels.compilation import compiled

__all__ = ["WINDOW_PX", "smallest_eigenvalues", "smallest_eigenvalues_numpy"]

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


@compiled("f4[:, ::1](u1[:, ::1])")
def smallest_eigenvalues(image: _Image) -> _Scores:
    """The smaller eigenvalue of the covariance of the gradient in a window around each pixel.

    Args:
        image: (height, width), reflected at its edges.

    Returns:
        (height, width), in the unit of `cv2.cornerMinEigenVal`.
    """
    height, width = image.shape
    dx, dy = np.empty((height, width), np.int16), np.empty((height, width), np.int16)
    smooth, rising = np.empty(width + 2, np.int16), np.empty(width + 2, np.int16)
    for v in range(height):
        above, below = image[_reflected(v - 1, height)], image[_reflected(v + 1, height)]
        _gradients(above, image[v], below, smooth, rising, dx[v], dy[v])
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
        _widen(xx, padded, sum_xx)
        _widen(xy, padded, sum_xy)
        _widen(yy, padded, sum_yy)
        _eigenvalues(sum_xx, sum_xy, sum_yy, scale, scores[v])
        old, new = _reflected(v - _RADIUS, height), _reflected(v + _RADIUS + 1, height)
        _add(dx[old], dy[old], less, xx, xy, yy)
        _add(dx[new], dy[new], one, xx, xy, yy)
    return scores


def smallest_eigenvalues_numpy(image: _Image) -> _Scores:
    """`smallest_eigenvalues` in OpenCV and NumPy."""
    side = (WINDOW_PX, WINDOW_PX)
    x, y = (cv2.Sobel(image, cv2.CV_64F, *order).astype(np.float64) for order in ((1, 0), (0, 1)))
    # whole numbers below 2^53, so that these sums are exact too
    xx, xy, yy = (
        cv2.boxFilter(product, cv2.CV_64F, side, normalize=False).astype(np.float32)
        for product in (x * x, x * y, y * y)
    )
    scale = np.float32((1.0 / (_LARGEST * WINDOW_PX)) ** 2)
    a, b, c = xx * scale * _HALF, xy * scale, yy * scale * _HALF
    return np.asarray((a + c) - np.sqrt((a - c) * (a - c) + b * b), np.float32)
