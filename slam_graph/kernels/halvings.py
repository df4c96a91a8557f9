# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Smaller images: halvings one behind another, as kernels take the levels of a pyramid.

They are made to the bit as OpenCV makes them, in half the time. Two pixels beside each other are
read as one number of 16 bits, of which the lower half is the first one: so those in even columns
and those in odd ones are taken apart without moving them, and the loops are made of vectors.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slam_graph.kernels.compilation import compiled

__all__ = ["halve", "halve_numpy", "halved", "halvings_room", "quarter", "quarter_numpy"]

_Image = NDArray[np.uint8]
_Pairs = NDArray[np.uint16]

_u8, _u16 = np.uint8, np.uint16
_at = np.uintp
"""An index without a sign. Numba would test others for negative ones, and not use vectors."""
_FIRST = np.uint16(255)
"""Bits of the first pixel of a pair."""


@lru_cache
def halvings_room(shape: tuple[int, ...], levels: int) -> int:
    """Bytes of so many halvings of an image of a shape (height, width)."""
    return sum(-(-shape[0] >> level) * -(-shape[1] >> level) for level in range(1, levels + 1))


def halved(image: _Image, halvings: _Image, level: int) -> _Image:
    """A level of a pyramid, as a view: the image itself, or one of its halvings.

    Args:
        image: (height, width).
        halvings: one behind another.
        level: 0 is the image.
    """
    if level == 0:
        return image
    begin, end = halvings_room(image.shape, level - 1), halvings_room(image.shape, level)
    return halvings[begin:end].reshape(-(-image.shape[0] >> level), -(-image.shape[1] >> level))


@compiled()
def _reflected(place: int, length: int) -> int:
    """Where a line is continued beyond its ends, as by OpenCV's BORDER_REFLECT_101."""
    while length > 1 and not 0 <= place < length:
        place = -place if place < 0 else 2 * length - 2 - place
    return place if length > 1 else 0


@compiled()
def _weighted(outer: np.uint16, near: np.uint16, middle: np.uint16) -> np.uint16:
    """The sum of five values with the weights 1, 4, 6, 4 and 1."""
    return _u16(_u16(outer + _u16(near << 2)) + _u16(_u16(middle << 2) + _u16(middle << 1)))


@compiled()
def _smooth_columns(
    a: _Pairs, b: _Pairs, c: _Pairs, d: _Pairs, e: _Pairs, even: _Pairs, odd: _Pairs
) -> None:
    """Weighted sums over five rows, for even and for odd columns."""
    for k in range(len(even)):
        m = _at(k)
        p, q, r, s, t = a[m], b[m], c[m], d[m], e[m]
        outer, near = _u16((p & _FIRST) + (t & _FIRST)), _u16((q & _FIRST) + (s & _FIRST))
        even[m] = _weighted(outer, near, r & _FIRST)
        outer, near = _u16((p >> 8) + (t >> 8)), _u16((q >> 8) + (s >> 8))
        odd[m] = _weighted(outer, near, r >> 8)


@compiled()
def _smooth_row(
    left: _Pairs, middle: _Pairs, right: _Pairs, before: _Pairs, after: _Pairs, out: _Image
) -> None:
    """Weighted sums over five columns, of which `before` and `after` are odd ones, rounded."""
    for k in range(len(out)):
        m = _at(k)
        total = _weighted(_u16(left[m] + right[m]), _u16(before[m] + after[m]), middle[m])
        out[m] = _u8(_u16(total + _u16(128)) >> 8)


@compiled("void(u1[:, ::1], u1[:, ::1])")
def halve(image: _Image, out: _Image) -> None:
    """An image smoothed by the weights 1, 4, 6, 4, 1, of which every second pixel is kept.

    Args:
        image: (height, width), of an even width; reflected at its edges.
        out: filled, ((height + 1) // 2, width // 2).
    """
    height, width = image.shape[0], image.shape[1] // 2
    pairs = image.reshape(-1).view(np.uint16).reshape((height, width))
    even, odd = np.zeros(width + 2, np.uint16), np.zeros(width + 1, np.uint16)
    for v in range(len(out)):
        first, second = _reflected(2 * v - 2, height), _reflected(2 * v - 1, height)
        fourth, last = _reflected(2 * v + 1, height), _reflected(2 * v + 2, height)
        rows = pairs[first], pairs[second], pairs[2 * v], pairs[fourth], pairs[last]
        _smooth_columns(*rows, even[1 : width + 1], odd[1:])
        even[0], odd[0], even[width + 1] = even[min(2, width)], odd[1], even[width]
        columns = even[:width], even[1 : width + 1], even[2:], odd[:width], odd[1:]
        _smooth_row(*columns, out[v])


def halve_numpy(image: _Image, out: _Image) -> None:
    """`halve` in NumPy, for any width; `cv2.pyrDown` does the same."""
    weights = np.array([1, 4, 6, 4, 1])
    padded = np.pad(image.astype(np.int64), 2, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))[::2, ::2]
    out[:] = (np.einsum("vuij,i,j->vu", windows, weights, weights) + 128) >> 8


@compiled()
def _means(above: _Pairs, below: _Pairs, out: _Image) -> None:
    """Rounded means of 2 x 2 pixels in two rows."""
    for k in range(len(out)):
        m = _at(k)
        p, q = above[m], below[m]
        first, second = _u16((p & _FIRST) + (p >> 8)), _u16((q & _FIRST) + (q >> 8))
        out[m] = _u8(_u16(_u16(first + second) + _u16(2)) >> 2)


@compiled("void(u1[:, ::1], u1[:, ::1])")
def quarter(image: _Image, out: _Image) -> None:
    """Rounded means of 2 x 2 pixels, and of 2 x 2 of these.

    Args:
        image: (height, width), both multiples of 4.
        out: filled, (height // 4, width // 4).
    """
    width = image.shape[1]
    pairs = image.reshape(-1).view(np.uint16).reshape((len(image), width // 2))
    above, below = np.zeros(width // 2, np.uint8), np.zeros(width // 2, np.uint8)
    for v in range(len(out)):
        _means(pairs[4 * v], pairs[4 * v + 1], above)
        _means(pairs[4 * v + 2], pairs[4 * v + 3], below)
        _means(above.view(np.uint16), below.view(np.uint16), out[v])


def quarter_numpy(image: _Image, out: _Image) -> None:
    """`quarter` in NumPy; `cv2.resize` by areas does the same if it is called twice."""
    for _ in range(2):
        height, width = image.shape
        blocks = image.reshape(height // 2, 2, width // 2, 2).astype(np.int64)
        image = ((blocks.sum(axis=(1, 3)) + 2) >> 2).astype(np.uint8)
    out[:] = image
