# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Patches that are found in another image under an affine warp, by inverse compositional steps.

A template T(x) around a corner is looked for in an image I as T(x) = I(A x + p), whatever the
brightness and contrast: both are compared with zero mean and unit deviation. As the template and
not the image is differentiated, all steps have the same matrix (Baker & Matthews 2004,
"Lucas-Kanade 20 years on"; the affine warp: Shi & Tomasi 1994, "Good features to track").
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "PATCH_PX",
    "ROW_PX",
    "align_patches",
    "align_patches_numpy",
    "judge_patches",
    "judge_patches_numpy",
]

PATCH_PX, ROW_PX = 15, 16
"""Side of a patch, and the length of its rows in memory: with one zero at the end it is a multiple
of the vectors of the processor."""

_Image = NDArray[np.uint8]
_Templates = NDArray[np.float32]
_Result = tuple[BoolArray, FloatArray]
_Cells = tuple[NDArray[np.int32], ...]
_Values = tuple[FloatArray, FloatArray, FloatArray]
_Sums = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
_at = np.uintp
"""Indices that are not negative, which need no test whether they count from the end."""

_HALF, _COUNT = PATCH_PX // 2, PATCH_PX * PATCH_PX
_LEAST_DEVIATION = 1.0
"""A window with less contrast (grey levels) has nothing to align."""
_FARTHEST_PX = 1.5
"""A window that leaves its first place by more is another one."""
_LEAST_AREA = 0.3
"""A step that makes the area of the window more than 1 / 0.3 times as large leads nowhere."""


@compiled()
def _sum_window(
    image: _Image,
    place: tuple[float, float],
    warp: tuple[float, float, float, float],
    template: _Templates,
    cells: _Cells,
    values: _Values,
    sums: _Sums,
) -> None:
    """Sums over the rows of a window of an image, for each of its columns.

    Args:
        image: (height, width) grey.
        place: of the middle of the window, along columns and rows, in pixels of the image.
        warp: image_A_template, by rows. The window is inside the image.
        template: (3, 240), see `align_patches`.
        cells: room, six arrays (ROW_PX,).
        values: room, three arrays (ROW_PX,).
        sums: seven arrays (ROW_PX,), which are overwritten. With the grey values W of the window,
            the template T and its derivatives T_x and T_y along columns and rows, and the row r
            of the patch, from -1 to 1, they are the sums of W, W², W T, W T_x, W T_y, W T_x r and
            W T_y r.
    """
    (u, v, g00, g01, g10, g11), (grey, right, below) = cells, values
    (x, y), (a, b, c, d) = place, warp
    T, dx, dy = template[0], template[1], template[2]
    total, squares, by_template, along_x, along_y, row_x, row_y = sums
    for k in range(ROW_PX):
        total[k] = squares[k] = by_template[k] = 0.0
        along_x[k] = along_y[k] = row_x[k] = row_y[k] = 0.0
    for row in range(PATCH_PX):
        begin_x, begin_y = x - a * _HALF + b * (row - _HALF), y - c * _HALF + d * (row - _HALF)
        for k in range(ROW_PX):
            px, py = begin_x + k * a, begin_y + k * c
            u[k], v[k] = np.int32(px), np.int32(py)
            right[k], below[k] = px - u[k], py - v[k]
        for k in range(PATCH_PX):
            m, n = _at(v[k]), _at(u[k])
            g00[k], g01[k] = image[m, n], image[m, n + _at(1)]
            m += _at(1)
            g10[k], g11[k] = image[m, n], image[m, n + _at(1)]
        for k in range(ROW_PX):
            # without np.int32 the differences have 64 bits, which have no vectors of conversions
            upper = g00[k] + right[k] * np.int32(g01[k] - g00[k])
            lower = g10[k] + right[k] * np.int32(g11[k] - g10[k])
            grey[k] = upper + below[k] * (lower - upper)
        grey[PATCH_PX] = 0.0
        begin, down = _at(row * ROW_PX), (row - _HALF) / _HALF
        for k in range(ROW_PX):
            m, value = begin + _at(k), grey[k]
            by_x, by_y = value * dx[m], value * dy[m]
            total[k] += value
            squares[k] += value * value
            by_template[k] += value * T[m]
            along_x[k] += by_x
            along_y[k] += by_y
            row_x[k] += down * by_x
            row_y[k] += down * by_y


@compiled()
def _step(system: FloatArray, sums: _Sums, products: FloatArray, step: FloatArray) -> float:
    """The Gauss-Newton step of place and warp, and the correlation of window and template.

    Args:
        system: (8, 6), see `align_patches`.
        sums: of the window, see `_sum_window`.
        products: (6,) room.
        step: (6,) which is overwritten: of the place in pixels of the template, and of the four
            entries of the warp times half a patch. It moves the template and not the window.

    Returns:
        The correlation; -1 where the window has no contrast.
    """
    totals, squares, by_template, along_x, along_y, row_x, row_y = sums
    for m in range(6):
        products[m] = 0.0
    total = square = template_sum = 0.0
    for k in range(PATCH_PX):
        across = (k - _HALF) / _HALF
        total += totals[k]
        square += squares[k]
        template_sum += by_template[k]
        products[0] += along_x[k]
        products[1] += along_y[k]
        products[2] += across * along_x[k]
        products[3] += row_x[k]
        products[4] += across * along_y[k]
        products[5] += row_y[k]
    variance = (square - total * total / _COUNT) / _COUNT
    if variance < _LEAST_DEVIATION * _LEAST_DEVIATION:
        return -1.0
    gain = 1.0 / math.sqrt(variance)
    for m in range(6):
        products[m] -= system[6, m] * total + system[7, m] * template_sum
    for m in range(6):
        step[m] = 0.0
        for k in range(6):
            step[m] += gain * system[m, k] * products[k]
    return gain * template_sum / _COUNT


@compiled(
    "Tuple((b1[::1], f8[::1]))(u1[:, ::1], f4[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], i8[::1], "
    "f8[:, ::1], i8, f8)"
)
def align_patches(
    image: _Image,
    templates: _Templates,
    systems: FloatArray,
    warps: FloatArray,
    rows: IntArray,
    points: FloatArray,
    iterations: int,
    step_px: float,
) -> _Result:
    """Find templates in an image, from where they are believed to be.

    The derivatives J (6) are those by the place of the patch along columns and rows, and by the
    four entries of the warp, times half the patch.

    Args:
        image: (height, width) grey.
        templates: (T, 3, 240) rows of 15 x 15 patches with zero mean and unit deviation, and their
            derivatives along columns and rows; each row ends with a zero.
        systems: (T, 8, 6) inverse of the sums of J Jᵀ, then the means of J and of J times the
            template, which brightness and contrast explain.
        warps: (T, 2, 2) image_A_template; changed for those that are found.
        rows: (N,) which of the templates are looked for, each once.
        points: (N, 2) where the middles of these are, in pixels; moved for those that are found.
        iterations: most steps.
        step_px: a step of the place that is not longer than this is the last one, in pixels of
            the template (a step in the image is the warp times it).

    Returns:
        found: (N,) whether before each step the window was in the image, had contrast, and had a
            positive correlation with the template, and whether no step took it further than 1.5
            pixels of the image from its first place. The window after the last step is not looked
            at: it may reach out of the image, and its correlation is not known.
        correlations: (N,) of template and window before the last step; -1 without contrast, 0 if
            the first window reaches out of the image.
    """
    height, width = image.shape
    found, correlations = np.empty(len(points), np.bool_), np.empty(len(points))
    # one by one, so that the compiler sees that none overlaps another
    u, v = np.empty(ROW_PX, np.int32), np.empty(ROW_PX, np.int32)
    g00, g01 = np.empty(ROW_PX, np.int32), np.empty(ROW_PX, np.int32)
    g10, g11 = np.empty(ROW_PX, np.int32), np.empty(ROW_PX, np.int32)
    for k in range(ROW_PX):  # the last one of a row is not filled
        g00[k] = g01[k] = g10[k] = g11[k] = 0
    grey, right, below = np.empty(ROW_PX), np.empty(ROW_PX), np.empty(ROW_PX)
    s0, s1, s2, s3 = np.empty(ROW_PX), np.empty(ROW_PX), np.empty(ROW_PX), np.empty(ROW_PX)
    s4, s5, s6 = np.empty(ROW_PX), np.empty(ROW_PX), np.empty(ROW_PX)
    cells, values = (u, v, g00, g01, g10, g11), (grey, right, below)
    sums = s0, s1, s2, s3, s4, s5, s6
    products, step = np.empty(6), np.empty(6)
    for i in range(len(points)):
        n, x, y = rows[i], points[i, 0], points[i, 1]
        a, b, c, d = warps[n, 0, 0], warps[n, 0, 1], warps[n, 1, 0], warps[n, 1, 1]
        found[i], correlations[i], inside = False, 0.0, True
        for _ in range(iterations):
            reach_x, reach_y = _HALF * (abs(a) + abs(b)), _HALF * (abs(c) + abs(d))
            inside = x >= reach_x and y >= reach_y
            inside = inside and x + reach_x < width - 1 and y + reach_y < height - 1
            if not inside:
                break
            _sum_window(image, (x, y), (a, b, c, d), templates[n], cells, values, sums)
            correlations[i] = _step(systems[n], sums, products, step)
            inside = correlations[i] > 0.0
            if not inside:
                break
            # the inverse of the step: B⁻¹, and -B⁻¹ t
            b00, b01 = 1.0 + step[2] / _HALF, step[3] / _HALF
            b10, b11 = step[4] / _HALF, 1.0 + step[5] / _HALF
            area = b00 * b11 - b01 * b10
            inside = area > _LEAST_AREA
            if not inside:
                break
            back_x = (b01 * step[1] - b11 * step[0]) / area
            back_y = (b10 * step[0] - b00 * step[1]) / area
            x, y = x + a * back_x + b * back_y, y + c * back_x + d * back_y
            a, b = (a * b11 - b * b10) / area, (b * b00 - a * b01) / area
            c, d = (c * b11 - d * b10) / area, (d * b00 - c * b01) / area
            away_x, away_y = x - points[i, 0], y - points[i, 1]
            inside = away_x * away_x + away_y * away_y < _FARTHEST_PX * _FARTHEST_PX
            if not inside or back_x * back_x + back_y * back_y <= step_px * step_px:
                break
        if inside:
            found[i] = True
            points[i, 0], points[i, 1] = x, y
            warps[n, 0, 0], warps[n, 0, 1], warps[n, 1, 0], warps[n, 1, 1] = a, b, c, d
    return found, correlations


def align_patches_numpy(
    image: _Image,
    templates: _Templates,
    systems: FloatArray,
    warps: FloatArray,
    rows: IntArray,
    points: FloatArray,
    iterations: int,
    step_px: float,
) -> _Result:
    """`align_patches` in NumPy."""
    found, correlations = np.zeros(len(points), np.bool_), np.zeros(len(points))
    side = np.arange(-_HALF, _HALF + 1)
    offsets = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    across, down = offsets.T / _HALF
    last, grey = np.array(image.shape[::-1]) - 1, image.astype(np.float64)
    for i, n in enumerate(rows):
        shape = 3, PATCH_PX, ROW_PX
        T, dx, dy = templates[n].reshape(shape)[:, :, :PATCH_PX].reshape(3, -1).astype(np.float64)
        J = np.stack([dx, dy, dx * across, dx * down, dy * across, dy * down])
        place, warp = points[i].copy(), warps[n].copy()
        for step_number in range(iterations):
            reach = _HALF * np.abs(warp).sum(axis=1)
            if np.any(place < reach) or np.any(place + reach >= last):
                break
            at = place + offsets @ warp.T
            u, v = at.astype(np.int64).T
            right, below = (at - np.floor(at)).T
            upper = (1.0 - right) * grey[v, u] + right * grey[v, u + 1]
            lower = (1.0 - right) * grey[v + 1, u] + right * grey[v + 1, u + 1]
            window = (1.0 - below) * upper + below * lower
            correlations[i] = -1.0
            if np.std(window) < _LEAST_DEVIATION:
                break
            gain = 1.0 / np.std(window)
            correlations[i] = gain * np.mean(window * T)
            if correlations[i] <= 0.0:
                break
            products = J @ window - systems[n, 6] * window.sum() - systems[n, 7] * (window @ T)
            step = gain * systems[n, :6] @ products
            change = np.eye(2) + step[2:].reshape(2, 2) / _HALF
            if np.linalg.det(change) <= _LEAST_AREA:
                break
            back = -np.linalg.solve(change, step[:2])
            place, warp = place + warp @ back, warp @ np.linalg.inv(change)
            if np.sum((place - points[i]) ** 2) >= _FARTHEST_PX**2:
                break
            if back @ back <= step_px**2 or step_number == iterations - 1:
                found[i] = True
                points[i], warps[n] = place, warp
                break
    return found, correlations


@compiled(
    "b1[::1](b1[::1], f8[::1], i8[::1], f8[:, :, ::1], f8[:, :, ::1], i8[::1], f8, f8, f8, f8, i8)"
)
def judge_patches(
    found: BoolArray,
    correlations: FloatArray,
    rows: IntArray,
    former: FloatArray,
    warps: FloatArray,
    refusals: IntArray,
    least_correlation: float,
    smallest: float,
    largest: float,
    most_stretched: float,
    most_refusals: int,
) -> BoolArray:
    """Which templates to give up, after they were looked for by `align_patches`.

    Args:
        found: (N,) from there; made false where template and image differ, or the view has changed.
        correlations: (N,) from there.
        rows: (N,) which of the templates these are.
        former: (N, 2, 2) their warps before.
        warps: (T, 2, 2) the warps now; the former ones again where template and image differ.
        refusals: (T,) in how many images in a row each was not found; renewed.
        least_correlation: with less, template and image differ.
        smallest: change of the area below which the view has changed too much.
        largest: the same above which it has.
        most_stretched: and the ratio of the singular values of the warp above which it has.
        most_refusals: a template that was not found so often is given up.

    Returns:
        (N,) whether the view has changed too much, or a template was not found too often.
    """
    given_up = np.empty(len(rows), np.bool_)
    for i in range(len(rows)):
        n = rows[i]
        found[i] &= correlations[i] > least_correlation
        if not found[i]:  # one by one: an assignment of all takes six seconds to compile
            warps[n, 0, 0], warps[n, 0, 1] = former[i, 0, 0], former[i, 0, 1]
            warps[n, 1, 0], warps[n, 1, 1] = former[i, 1, 0], former[i, 1, 1]
        a, b, c, d = warps[n, 0, 0], warps[n, 0, 1], warps[n, 1, 0], warps[n, 1, 1]
        area = a * d - b * c  # the product of the singular values, of whose squares this is the sum
        squares = a * a + b * b + c * c + d * d
        changed = area < smallest or area > largest
        changed = changed or squares > (most_stretched + 1.0 / most_stretched) * area
        found[i] &= not changed
        refusals[n] = 0 if found[i] else refusals[n] + 1
        given_up[i] = changed or refusals[n] >= most_refusals
    return given_up


def judge_patches_numpy(
    found: BoolArray,
    correlations: FloatArray,
    rows: IntArray,
    former: FloatArray,
    warps: FloatArray,
    refusals: IntArray,
    least_correlation: float,
    smallest: float,
    largest: float,
    most_stretched: float,
    most_refusals: int,
) -> BoolArray:
    """`judge_patches` in NumPy."""
    found &= correlations > least_correlation
    warps[rows[~found]] = former[~found]
    areas = np.linalg.det(warps[rows])
    stretches = np.linalg.svd(warps[rows], compute_uv=False)
    changed = (areas < smallest) | (areas > largest)
    changed |= stretches[:, 0] > most_stretched * stretches[:, 1]
    found &= ~changed
    refusals[rows] = np.where(found, 0, refusals[rows] + 1)
    return np.asarray(changed | (refusals[rows] >= most_refusals))
