# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pyramidal Lucas-Kanade with a forward-backward check (Bouguet 2000, Kalal et al. 2010).

OpenCV's `calcOpticalFlowPyrLK` builds the pyramids and derivatives of both images in every call.
Here pyramids are given, and derivatives are taken where they are needed. Positions, weights of 14
bits and windows of whole numbers are those of OpenCV; the sums over a window are exact, while
OpenCV's are rounded in an order that depends on the machine.

A window is a flat array, in rows of `_STRIDE` numbers, the last three not used: a loop over all of
it is made of vectors, if the compiler knows the _STRIDE. `np.int32(…)` around a product keeps Numba
from 64 bits; vectors of 16 bits take half the instructions of those of 32. A weight of 14 bits is
64 h + l, and four of them sum up to 2^14, so the sum of their products with grey values v is S = 64
H + L, where H = Σ h v and L = Σ l v are below 2^16. For derivatives, which have five bits more, S
is 2048 A + B with 0 ≤ B < 2048: Scharr's sums of A and of B each fit into 16 bits with their sign.
Grey values count from the middle of their range, so that more products can be added in 32 bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray
from slam_graph.kernels.compilation import compiled

__all__ = ["WINDOW_PX", "track_windows"]

WINDOW_PX = 17
"""Side of the window."""

_STRIDE = WINDOW_PX + 3
_WEIGHT_BITS, _IMAGE_BITS = 14, 14 - 5
"""Bits of weights, and those rounded off: grey values in a window keep five after the point."""
_LOW_BITS, _HALF_BITS = 6, 11
"""Bits of the lower part of a weight, and of that of a sum of products."""

_ONE, _WHOLE = np.float32(1.0), np.float32(1 << _WEIGHT_BITS)
_WITHOUT_FRACTION = np.float32(1 << 23)
"""Added and taken away again it rounds as `rint`, without the cost of a call."""
_SCALE = np.float32(1.0 / (1 << 20))
"""Of sums of products, so that the smallest eigenvalue is in OpenCV's unit."""
_SINGULAR = np.float32(np.finfo(np.float32).eps)
_OSCILLATION_PX = 0.01
"""Two steps that cancel to within this end the iteration, half way between their ends."""
_MIDDLE = 255 << 4
"""Grey value, with five bits after the point, from which those of windows count."""
_BLOCK, _LENGTH, _AROUND = 88, 4 * 88, 384
"""So many products are added in 32 bits (88 * 4081 * 4081, of derivatives, is below 2^31). Length
of a window, made up to whole blocks, and with the pixels around it: whole vectors of 16 numbers."""

_VECTOR = 24
"""Pixels that are copied at once. The next row overwrites those that are too many."""

_i16, _u16 = np.int16, np.uint16
_at = np.uintp
"""An index without a sign. Numba would test others for negative ones, and not use vectors."""

_Image = NDArray[np.uint8]
_Halvings = NDArray[np.uint8]
_Window = NDArray[np.int16]
_Pixels = NDArray[np.float32]
_Weights = tuple[np.int32, np.int32, np.int32, np.int32]
_Parts = tuple[np.uint16, np.uint16, np.uint16, np.uint16]


@compiled()
def _rounded(weight: np.float32) -> np.int32:
    """The whole number nearest to a weight, which is not negative."""
    return np.int32(weight + _WITHOUT_FRACTION - _WITHOUT_FRACTION)


@compiled()
def _cell(x: np.float32, y: np.float32) -> tuple[int, int, _Weights]:
    """The pixel (u, v) at the upper left of a place, and the weights of the four around it."""
    u, v = int(x), int(y)
    u -= int(np.float32(u) > x)  # negative ones were rounded up
    v -= int(np.float32(v) > y)
    a, b = x - np.float32(u), y - np.float32(v)
    ul, ur = _rounded((_ONE - a) * (_ONE - b) * _WHOLE), _rounded(a * (_ONE - b) * _WHOLE)
    ll = _rounded((_ONE - a) * b * _WHOLE)
    return u, v, (ul, ur, ll, np.int32(_WHOLE - ul - ur - ll))


@compiled()
def _outside(u: int, v: int, image: _Image) -> bool:
    """Whether a window whose upper left pixel is (u, v) lies outside of an image."""
    return u < -WINDOW_PX or v < -WINDOW_PX or u >= image.shape[1] or v >= image.shape[0]


@compiled()
def _reflected(place: int, length: int) -> int:
    """Where a line is continued beyond its ends, as by OpenCV's BORDER_REFLECT_101."""
    while length > 1 and not 0 <= place < length:
        place = -place if place < 0 else 2 * length - 2 - place
    return place if length > 1 else 0


@compiled()
def _copy(image: _Image, u: int, v: int, rows: int, out: _Window) -> None:
    """Rows of pixels from (u, v) on, reflected at the edges of the image."""
    height, width = image.shape
    if u >= 0 and v >= 0 and u + _STRIDE <= width and v + rows <= height:
        columns = min(width - u, _VECTOR)
        for i in range(rows):
            for j in range(columns):
                out[_at(i * _STRIDE + j)] = image[_at(v + i), _at(u + j)]
    else:
        for i in range(rows):
            y = _reflected(v + i, height)
            for j in range(_STRIDE):
                out[_at(i * _STRIDE + j)] = image[_at(y), _at(_reflected(u + j, width))]


@compiled()
def _split(weights: _Weights) -> tuple[_Parts, _Parts]:
    """The upper and the lower parts of weights. Of -1, which rounding gives, they are -1 and 63."""
    a, b, c, d = weights
    low = (1 << _LOW_BITS) - 1
    upper = _u16(a >> _LOW_BITS), _u16(b >> _LOW_BITS), _u16(c >> _LOW_BITS), _u16(d >> _LOW_BITS)
    return upper, (_u16(a & low), _u16(b & low), _u16(c & low), _u16(d & low))


@compiled()
def _weighted(values: _Window, k: int, parts: _Parts) -> np.uint16:
    """The sum of four values, times parts of their weights."""
    (a, b, c, d), m, n = parts, _at(k), _at(k + _STRIDE)
    upper = _u16(_u16(a * values[m]) + _u16(b * values[m + _at(1)]))
    return _u16(upper + _u16(_u16(c * values[n]) + _u16(d * values[n + _at(1)])))


@compiled()
def _blend(values: _Window, weights: _Weights, out: _Window) -> None:
    """Bilinear interpolation between four grey values each, of which five bits are kept."""
    above, below = _split(weights)
    bits = _IMAGE_BITS - _LOW_BITS
    half = _u16((1 << (bits - 1)) - (_MIDDLE << bits))
    for k in range(_LENGTH):
        upper, lower = _weighted(values, k, above), _weighted(values, k, below)
        total = _i16(_u16(upper + half) + _u16(lower >> _LOW_BITS))
        out[_at(k)] = _i16(total >> bits)


@compiled()
def _blend_in_halves(values: _Window, weights: _Weights, high: _Window, low: _Window) -> None:
    """The same with all bits, of the window and the pixels around it: 2048 (high - 1) + low."""
    above, below = _split(weights)
    bits = _HALF_BITS - _LOW_BITS
    one = _u16(1 << bits)  # added, so that no sum is negative where a weight is
    rest, lowest = _u16((1 << bits) - 1), _u16((1 << _LOW_BITS) - 1)
    for k in range(_AROUND):
        upper, lower = _weighted(values, k, above), _weighted(values, k, below)
        total = _u16(_u16(upper + one) + _u16(lower >> _LOW_BITS))
        high[_at(k)] = _u16(total >> bits)
        low[_at(k)] = _u16(_u16(_u16(total & rest) << _LOW_BITS) | _u16(lower & lowest))


@compiled()
def _middle(high: _Window, low: _Window, out: _Window) -> None:
    """The grey values of a window, with five bits after the point, by those of two halves."""
    bits = _HALF_BITS - _IMAGE_BITS
    least, half = _i16(1 + (_MIDDLE >> bits)), _i16(1 << (_IMAGE_BITS - 1))
    for k in range(_LENGTH):
        m = _at(k + _STRIDE + 1)
        upper = _i16(_i16(high[m] - least) << bits)
        out[_at(k)] = _i16(upper + _i16(_i16(low[m] + half) >> _IMAGE_BITS))


@compiled()
def _scharr(values: _Window, k: int) -> tuple[np.int16, np.int16]:
    """Scharr's derivatives at the second value of the row behind that of `k`."""
    three, ten = _i16(3), _i16(10)
    o, m, n = _at(k), _at(k + _STRIDE), _at(k + 2 * _STRIDE)
    falling, rising = _i16(values[n + _at(2)] - values[o]), _i16(values[o + _at(2)] - values[n])
    right = _i16(values[m + _at(2)] - values[m])
    down = _i16(values[n + _at(1)] - values[o + _at(1)])
    x = _i16(_i16(three * _i16(falling + rising)) + _i16(ten * right))
    return x, _i16(_i16(three * _i16(falling - rising)) + _i16(ten * down))


@compiled()
def _slopes(high: _Window, low: _Window, used: _Window, gx: _Window, gy: _Window) -> None:
    """Derivatives of grey values in two halves, rounded; zero where `used` is."""
    bits, half = _WEIGHT_BITS - _HALF_BITS, _i16(1 << (_WEIGHT_BITS - _HALF_BITS - 1))
    for k in range(_LENGTH):
        (x, y), (low_x, low_y) = _scharr(high, k), _scharr(low, k)
        x = _i16(_i16(x + half) + _i16(low_x >> _HALF_BITS))
        y = _i16(_i16(y + half) + _i16(low_y >> _HALF_BITS))
        gx[_at(k)] = _i16(x >> bits) & used[_at(k)]
        gy[_at(k)] = _i16(y >> bits) & used[_at(k)]


@compiled()
def _differentiate(pixels: _Window, dx: _Window, dy: _Window) -> None:
    """Derivatives from the second pixel of the second row on."""
    for k in range(_LENGTH + _STRIDE + 1):
        dx[_at(k)], dy[_at(k)] = _scharr(pixels, k)


@compiled()
def _blend_slopes(values: _Window, weights: _Weights, used: _Window, out: _Window) -> None:
    """Bilinear interpolation between four derivatives each; zero where `used` is."""
    a, b, c, d = weights
    half = np.int32(1 << (_WEIGHT_BITS - 1))
    for k in range(_LENGTH):
        m, n = _at(k), _at(k + _STRIDE)
        upper = np.int32(a * values[m]) + np.int32(b * values[m + _at(1)])
        lower = np.int32(c * values[n]) + np.int32(d * values[n + _at(1)])
        out[m] = _i16(np.int32(upper + lower + half) >> _WEIGHT_BITS) & used[m]


@compiled()
def _clear_outside(values: _Window, u: int, v: int, image: _Image) -> None:
    """No derivatives beyond the edges of an image."""
    for k in range(len(values)):
        x, y = u + k % _STRIDE, v + k // _STRIDE
        if x < 0 or x >= image.shape[1] or y < 0 or y >= image.shape[0]:
            values[k] = 0


@compiled()
def _sum(values: _Window, others: _Window) -> np.int64:
    """The sum of products; one for each call, as the compiler then has an instruction for it."""
    total = np.int64(0)
    for start in range(0, _LENGTH, _BLOCK):
        part = np.int32(0)
        for k in range(_BLOCK):
            m = _at(start + k)
            part = np.int32(part + np.int32(np.int32(values[m]) * np.int32(others[m])))
        total += part
    return total


@compiled()
def _track_level(
    source: _Image,
    target: _Image,
    points: _Pixels,
    guess: _Pixels,
    good: BoolArray,
    level: int,
    iterations: int,
    step_px: float,
    least_eigenvalue: float,
) -> None:
    """Find points of one image in another, on one level of their pyramids.

    Args:
        source: a level of the one image.
        target: the same level of the other.
        points: (N, 2) pixels of level 0 in `source`.
        guess: (N, 2) where to start, in pixels of this level of `target`; then what was found.
        good: (N,) which to find; on level 0 made false where one is outside or has no gradient.
        level: of the pyramid; 0 is the image itself.
        iterations: most steps.
        step_px: a step that is not longer than this is the last one.
        least_eigenvalue: smallest eigenvalue of the moments of the gradient, per pixel.
    """
    half, scale = np.float32((WINDOW_PX - 1) * 0.5), np.float32(1.0 / (1 << level))
    # One by one: Numba does not see that the rows of a larger array are contiguous
    size = _LENGTH + 4 * _STRIDE + _VECTOR
    pixels, dx, dy = np.zeros(size, _i16), np.zeros(size, _i16), np.zeros(size, _i16)
    grey, moved, used = np.zeros(_LENGTH, _i16), np.zeros(_LENGTH, _i16), np.zeros(_LENGTH, _i16)
    gx, gy = np.zeros(_LENGTH, _i16), np.zeros(_LENGTH, _i16)
    for k in range(WINDOW_PX * _STRIDE):
        used[k] = -1 if k % _STRIDE < WINDOW_PX else 0  # all bits
    for i in range(len(points)):
        if not good[i]:
            continue
        x, y = points[i, 0] * scale - half, points[i, 1] * scale - half
        u, v, weights = _cell(x, y)
        if _outside(u, v, source):
            good[i] = level > 0
            continue
        _copy(source, u - 1, v - 1, WINDOW_PX + 3, pixels)
        _blend_in_halves(pixels, weights, dx, dy)
        _middle(dx, dy, grey)
        if u < 0 or v < 0 or u + WINDOW_PX >= source.shape[1] or v + WINDOW_PX >= source.shape[0]:
            _differentiate(pixels, dx, dy)
            _clear_outside(dx, u, v, source)
            _clear_outside(dy, u, v, source)
            _blend_slopes(dx, weights, used, gx)
            _blend_slopes(dy, weights, used, gy)
        else:
            _slopes(dx, dy, used, gx, gy)
        own_x, own_y = _sum(grey, gx), _sum(grey, gy)
        xx, xy = np.float32(_sum(gx, gx)) * _SCALE, np.float32(_sum(gx, gy)) * _SCALE
        yy = np.float32(_sum(gy, gy)) * _SCALE
        determinant = xx * yy - xy * xy
        root = np.sqrt((xx - yy) * (xx - yy) + np.float32(4.0) * xy * xy)
        eigenvalue = (yy + xx - root) / np.float32(2 * WINDOW_PX * WINDOW_PX)
        if eigenvalue < least_eigenvalue or determinant < _SINGULAR:
            good[i] = level > 0
            continue
        inverse = _ONE / determinant
        x, y = guess[i, 0] - half, guess[i, 1] - half
        last_x = last_y = np.float32(0.0)
        copied = -2 * WINDOW_PX, 0  # no window begins there
        for k in range(iterations):
            u, v, weights = _cell(x, y)
            if _outside(u, v, target):
                break
            if (u, v) != copied:
                _copy(target, u, v, WINDOW_PX + 1, pixels)
                copied = u, v
            _blend(pixels, weights, moved)
            bx = np.float32(_sum(moved, gx) - own_x) * _SCALE
            by = np.float32(_sum(moved, gy) - own_y) * _SCALE
            step_x, step_y = (xy * by - yy * bx) * inverse, (xy * bx - xx * by) * inverse
            x += step_x
            y += step_y
            guess[i, 0], guess[i, 1] = x + half, y + half
            if float(step_x) * float(step_x) + float(step_y) * float(step_y) <= step_px * step_px:
                break
            if k > 0 and abs(step_x + last_x) < _OSCILLATION_PX > abs(step_y + last_y):
                guess[i, 0] -= step_x * np.float32(0.5)
                guess[i, 1] -= step_y * np.float32(0.5)
                break
            last_x, last_y = step_x, step_y
        u, v, weights = _cell(guess[i, 0] - half, guess[i, 1] - half)
        if _outside(u, v, target):
            good[i] = level > 0


@compiled()
def _level(image: _Image, halvings: _Halvings, level: int) -> _Image:
    """As `halvings.halved`, which is not in this file: the image itself or a halving."""
    if level == 0:
        return image
    height, width, begin = (image.shape[0] + 1) // 2, (image.shape[1] + 1) // 2, 0
    for _ in range(level - 1):
        begin += height * width
        height, width = (height + 1) // 2, (width + 1) // 2
    return halvings[begin : begin + height * width].reshape((height, width))


@compiled(
    "Tuple((f4[:, ::1], b1[::1], f4[::1]))(u1[:, ::1], u1[::1], u1[:, ::1], u1[::1], f4[:, ::1], "
    "f4[:, ::1], i8, i8, i8, f8, f4)"
)
def track_windows(
    source: _Image,
    source_halvings: _Halvings,
    target: _Image,
    target_halvings: _Halvings,
    points: _Pixels,
    start: _Pixels,
    levels: int,
    border_px: int,
    iterations: int,
    step_px: float,
    least_eigenvalue: float,
) -> tuple[_Pixels, BoolArray, NDArray[np.float32]]:
    """Find points of one image in another, and those that were found in the first one again.

    The way back begins where it should end, so it needs no pyramid: what it tests is whether the
    window that was found is, seen from the other side, the window that was looked for.

    Args:
        source: (height, width) the one image.
        source_halvings: its halvings one behind another, at least `levels` of them.
        target: the other image, of any size.
        target_halvings: those of the other image.
        points: (N, 2) pixels in `source`.
        start: (N, 2) where to begin in `target`.
        levels: of the pyramid that are used beside the image itself.
        border_px: what lies nearer to the edge of `target` is not found.
        iterations: most steps on a level.
        step_px: a step that is not longer than this is the last one on its level.
        least_eigenvalue: smallest eigenvalue of the moments of the gradient, per pixel.

    Returns:
        points: (N, 2) pixels in `target`.
        found: (N,) whether they were tracked, forward and backward.
        error_px: (N,) forward-backward error; infinite where a point was not found.
    """
    n, scale = len(points), np.float32(1.0) / np.float32(1 << levels)
    moved, found = np.empty((n, 2), np.float32), np.empty(n, np.bool_)
    back, error_px = np.empty((n, 2), np.float32), np.empty(n, np.float32)
    for i in range(n):
        moved[i, 0], moved[i, 1] = start[i, 0] * scale, start[i, 1] * scale
        found[i], error_px[i] = True, np.inf
    for level in range(levels, -1, -1):
        one, other = _level(source, source_halvings, level), _level(target, target_halvings, level)
        _track_level(one, other, points, moved, found, level, iterations, step_px, least_eigenvalue)
        for i in range(n if level > 0 else 0):
            moved[i, 0], moved[i, 1] = np.float32(2.0) * moved[i, 0], np.float32(2.0) * moved[i, 1]
    height, width = target.shape
    for i in range(n):
        u, v = moved[i, 0], moved[i, 1]
        found[i] &= u >= border_px and u <= width - 1 - border_px
        found[i] &= v >= border_px and v <= height - 1 - border_px
        back[i, 0], back[i, 1] = points[i, 0], points[i, 1]
    # The level is 0 by now; for a literal 0 all would be compiled once more
    _track_level(target, source, moved, back, found, level, iterations, step_px, least_eigenvalue)
    for i in range(n):
        if found[i]:
            du, dv = back[i, 0] - points[i, 0], back[i, 1] - points[i, 1]
            error_px[i] = np.sqrt(du * du + dv * dv)
    return moved, found, error_px
