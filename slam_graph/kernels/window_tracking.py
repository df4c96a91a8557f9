# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Lucas-Kanade on one level of a pyramid, to the bit as OpenCV does it.

OpenCV's `calcOpticalFlowPyrLK` builds the pyramids and derivatives of both images in every call,
which takes longer than the tracking of a few points. Here pyramids are given, and derivatives are
taken where they are needed. The method is that of Bouguet, "Pyramidal Implementation of the Lucas
Kanade Feature Tracker" (2000). OpenCV's function is the specification: weights of 14 bits, windows
of whole numbers, and sums in single precision in the order of OpenCV's code for vectors of 128
bits. So a point moves by the same bits, and stops after the same number of steps.

Windows lie in flat arrays, in rows of `_STRIDE` pixels of which the last three are not used: a
loop over all of a window is made of vectors, loops over its rows would be too short for that.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray
from slam_graph.kernels.compilation import compiled

__all__ = ["BORDER_PX", "WINDOW_PX", "track_level"]

WINDOW_PX = 17
"""Side of the window, which the compiler must know to make good use of it."""

BORDER_PX = WINDOW_PX + 3
"""Border that images must have."""

_STRIDE = WINDOW_PX + 3
_LENGTH = WINDOW_PX * _STRIDE
_EIGHTS = WINDOW_PX // 8 * 8

_WEIGHT_BITS = 14
_IMAGE_BITS = _WEIGHT_BITS - 5
"""Bits that are rounded off: grey values in a window keep five after the point."""

_HALF, _ONE, _FOUR = np.float32(0.5), np.float32(1.0), np.float32(4.0)
_WHOLE = np.float32(1 << _WEIGHT_BITS)
_SCALE = np.float32(1.0 / (1 << 20))
_SINGULAR = np.float32(np.finfo(np.float32).eps)
_OSCILLATION_PX = 0.01
"""Two steps that cancel to within this end the iteration, half way between their ends."""

_at = np.uintp
"""An index without a sign. Numba would test others for negative ones, and not use vectors."""

_Image = NDArray[np.uint8]
_Window = NDArray[np.int32]
_Floats = NDArray[np.float32]
_Weights = tuple[int, int, int, int]


@compiled()
def _cell(x: float, y: float) -> tuple[int, int, _Weights]:
    """The pixel (u, v) at the upper left of a place, and the weights of the four around it."""
    u, v = math.floor(x), math.floor(y)
    a, b = x - np.float32(u), y - np.float32(v)
    upper_left = int(np.rint((_ONE - a) * (_ONE - b) * _WHOLE))
    upper_right = int(np.rint(a * (_ONE - b) * _WHOLE))
    lower_left = int(np.rint((_ONE - a) * b * _WHOLE))
    lower_right = (1 << _WEIGHT_BITS) - upper_left - upper_right - lower_left
    return u, v, (upper_left, upper_right, lower_left, lower_right)


@compiled()
def _blend_image(image: _Image, left: int, top: int, weights: _Weights, out: _Window) -> None:
    """A window of an image, by rows: bilinear interpolation between four pixels, rounded."""
    a, b = np.int32(weights[0]), np.int32(weights[1])
    c, d = np.int32(weights[2]), np.int32(weights[3])
    half = np.int32(1 << (_IMAGE_BITS - 1))
    for i in range(WINDOW_PX):
        for j in range(_STRIDE):
            v, u = top + i, left + j
            upper = a * image[_at(v), _at(u)] + b * image[_at(v), _at(u + 1)]
            lower = c * image[_at(v + 1), _at(u)] + d * image[_at(v + 1), _at(u + 1)]
            out[i, j] = np.int32(upper + lower + half) >> _IMAGE_BITS


@compiled()
def _differentiate(image: _Image, left: int, top: int, dx: _Window, dy: _Window) -> None:
    """Scharr's derivatives from a pixel on, by rows: one row more than a window has."""
    for i in range(WINDOW_PX + 1):
        for j in range(_STRIDE):
            v, u = top + i, left + j
            nw, ne = (
                np.int32(image[_at(v - 1), _at(u - 1)]),
                np.int32(image[_at(v - 1), _at(u + 1)]),
            )
            sw, se = (
                np.int32(image[_at(v + 1), _at(u - 1)]),
                np.int32(image[_at(v + 1), _at(u + 1)]),
            )
            east = np.int32(image[_at(v), _at(u + 1)]) - np.int32(image[_at(v), _at(u - 1)])
            south = np.int32(image[_at(v + 1), _at(u)]) - np.int32(image[_at(v - 1), _at(u)])
            dx[i, j] = 3 * (ne + se - nw - sw) + 10 * east
            dy[i, j] = 3 * (sw + se - nw - ne) + 10 * south


@compiled()
def _blend(values: _Window, weights: _Weights, out: _Window) -> None:
    """A window of derivatives: bilinear interpolation between four of them, rounded."""
    a, b = np.int32(weights[0]), np.int32(weights[1])
    c, d = np.int32(weights[2]), np.int32(weights[3])
    half = np.int32(1 << (_WEIGHT_BITS - 1))
    for k in range(_LENGTH):
        upper = a * values[k] + b * values[_at(k + 1)]
        lower = c * values[_at(k + _STRIDE)] + d * values[_at(k + _STRIDE + 1)]
        out[k] = np.int32(upper + lower + half) >> _WEIGHT_BITS


@compiled()
def _clear_outside(values: _Window, left: int, top: int, width: int, height: int) -> None:
    """No derivatives beyond the edges of the image, whose size is given."""
    for k in range(len(values)):
        u, v = left + k % _STRIDE, top + k // _STRIDE
        if u < 0 or u >= width or v < 0 or v >= height:
            values[k] = 0


@compiled()
def _products(gx: _Window, gy: _Window, xx: _Floats, xy: _Floats, yy: _Floats) -> None:
    """Products of derivatives, which are exact."""
    for k in range(_LENGTH):
        x, y = np.float32(gx[k]), np.float32(gy[k])
        xx[k], xy[k], yy[k] = x * x, x * y, y * y


@compiled()
def _sum(values: _Floats) -> np.float32:
    """The sum over a window, by rows: every fourth column in a lane, then those left over."""
    s0 = s1 = s2 = s3 = rest = np.float32(0.0)
    for i in range(WINDOW_PX):
        for k in range(0, _EIGHTS, 4):
            s0 += values[i, k]
            s1 += values[i, k + 1]
            s2 += values[i, k + 2]
            s3 += values[i, k + 3]
        for k in range(_EIGHTS, WINDOW_PX):
            rest += values[i, k]
    return (rest + ((s0 + s2) + (s1 + s3))) * _SCALE


@compiled()
def _pairs(a: _Window, b: _Window, out: _Floats) -> None:
    """Products of a column and of the fourth after it, added up as whole numbers."""
    for k in range(_LENGTH - 4):
        out[k] = np.float32(np.int32(a[k] * b[k] + a[_at(k + 4)] * b[_at(k + 4)]))


@compiled()
def _sum_pairs(
    px: _Floats, py: _Floats, moved: _Window, gx: _Window, gy: _Window
) -> tuple[np.float32, np.float32]:
    """Sums of the products of a window with two others, by rows: pairs in lanes, then the rest."""
    x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = rest_x = rest_y = np.float32(0.0)
    for i in range(WINDOW_PX):
        for k in range(0, _EIGHTS, 8):
            x0 += px[i, k]
            x1 += px[i, k + 1]
            x2 += px[i, k + 2]
            x3 += px[i, k + 3]
            y0 += py[i, k]
            y1 += py[i, k + 1]
            y2 += py[i, k + 2]
            y3 += py[i, k + 3]
        for k in range(_EIGHTS, WINDOW_PX):
            rest_x += np.float32(np.int32(moved[i, k] * gx[i, k]))
            rest_y += np.float32(np.int32(moved[i, k] * gy[i, k]))
    x, y = (x0 + x2) + (x1 + x3), (y0 + y2) + (y1 + y3)
    return (rest_x + x) * _SCALE, (rest_y + y) * _SCALE


@compiled("void(u1[:, ::1], u1[:, ::1], f4[:, ::1], f4[:, ::1], b1[::1], i8, i8, f8, f4)")
def track_level(
    source: _Image,
    target: _Image,
    points: _Floats,
    guess: _Floats,
    good: BoolArray,
    level: int,
    iterations: int,
    step_px: float,
    least_eigenvalue: float,
) -> None:
    """Find points of one image in another, on one level of their pyramids.

    Args:
        source: the level with a border of BORDER_PX pixels on all sides, reflected as by
            OpenCV's BORDER_REFLECT_101.
        target: the same level of the other image, likewise.
        points: (N, 2) pixels of level 0 in `source`.
        guess: (N, 2) where to start, in pixels of this level of `target`; then what was found.
        good: (N,) made false, on level 0, where a window has too little gradient or is outside.
        level: of the pyramid; 0 is the image itself.
        iterations: most steps.
        step_px: a step that is not longer than this is the last one.
        least_eigenvalue: smallest eigenvalue of the moments of the gradient, per pixel.
    """
    height, width = source.shape[0] - 2 * BORDER_PX, source.shape[1] - 2 * BORDER_PX
    half, scale = np.float32((WINDOW_PX - 1) * 0.5), np.float32(1.0 / (1 << level))
    shape = (WINDOW_PX, _STRIDE)
    # Windows by rows, and the same memory as one row
    dx_rows, dy_rows = (
        np.zeros((WINDOW_PX + 2, _STRIDE), np.int32),
        np.zeros((WINDOW_PX + 2, _STRIDE), np.int32),
    )
    gx_rows, gy_rows = np.empty(shape, np.int32), np.empty(shape, np.int32)
    window_rows, moved_rows = np.empty(shape, np.int32), np.empty(shape, np.int32)
    fx_rows, fm_rows, fy_rows = (
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
    )
    dx, dy, gx, gy = dx_rows.ravel(), dy_rows.ravel(), gx_rows.ravel(), gy_rows.ravel()
    window, moved = window_rows.ravel(), moved_rows.ravel()
    fx, fm, fy = fx_rows.ravel(), fm_rows.ravel(), fy_rows.ravel()
    for i in range(len(points)):
        u, v, weights = _cell(points[i, 0] * scale - half, points[i, 1] * scale - half)
        if u < -WINDOW_PX or u >= width or v < -WINDOW_PX or v >= height:
            good[i] &= level > 0
            continue
        _blend_image(source, u + BORDER_PX, v + BORDER_PX, weights, window_rows)
        _differentiate(source, u + BORDER_PX, v + BORDER_PX, dx_rows, dy_rows)
        if u < 0 or v < 0 or u + WINDOW_PX >= width or v + WINDOW_PX >= height:
            _clear_outside(dx, u, v, width, height)
            _clear_outside(dy, u, v, width, height)
        _blend(dx, weights, gx)
        _blend(dy, weights, gy)
        _products(gx, gy, fx, fm, fy)
        xx, xy, yy = _sum(fx_rows), _sum(fm_rows), _sum(fy_rows)
        determinant = xx * yy - xy * xy
        root = np.sqrt((xx - yy) * (xx - yy) + _FOUR * xy * xy)
        eigenvalue = (yy + xx - root) / np.float32(2 * WINDOW_PX * WINDOW_PX)
        if eigenvalue < least_eigenvalue or determinant < _SINGULAR:
            good[i] &= level > 0
            continue
        inverse = _ONE / determinant
        x, y = guess[i, 0] - half, guess[i, 1] - half
        last_x = last_y = np.float32(0.0)
        for k in range(iterations):
            u, v, weights = _cell(x, y)
            if u < -WINDOW_PX or u >= width or v < -WINDOW_PX or v >= height:
                good[i] &= level > 0
                break
            _blend_image(target, u + BORDER_PX, v + BORDER_PX, weights, moved_rows)
            for m in range(_LENGTH):
                moved[m] -= window[m]
            _pairs(moved, gx, fx)
            _pairs(moved, gy, fy)
            bx, by = _sum_pairs(fx_rows, fy_rows, moved_rows, gx_rows, gy_rows)
            step_x, step_y = (xy * by - yy * bx) * inverse, (xy * bx - xx * by) * inverse
            x += step_x
            y += step_y
            guess[i, 0], guess[i, 1] = x + half, y + half
            if float(step_x) * float(step_x) + float(step_y) * float(step_y) <= step_px * step_px:
                break
            if k > 0 and abs(step_x + last_x) < _OSCILLATION_PX > abs(step_y + last_y):
                guess[i, 0] -= step_x * _HALF
                guess[i, 1] -= step_y * _HALF
                break
            last_x, last_y = step_x, step_y
        u, v, _ = _cell(guess[i, 0] - half, guess[i, 1] - half)
        if u < -WINDOW_PX or u >= width or v < -WINDOW_PX or v >= height:
            good[i] &= level > 0
