# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Corners in OpenCV and NumPy: the specification of `corners`."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.corners import LARGEST_GRADIENT, WINDOW_PX
from slam_graph.kernels.spacing import clear_disks_numpy

__all__ = ["smallest_eigenvalues_numpy", "strongest_in_cells_numpy", "strongest_maxima_numpy"]

_Image = NDArray[np.uint8]
_Mask = NDArray[np.uint8]
_Scores = NDArray[np.float32]
_Pixels = NDArray[np.float32]


def smallest_eigenvalues_numpy(image: _Image) -> _Scores:
    """`smallest_eigenvalues` in OpenCV and NumPy."""
    side = (WINDOW_PX, WINDOW_PX)
    x, y = (cv2.Sobel(image, cv2.CV_64F, *order).astype(np.float64) for order in ((1, 0), (0, 1)))
    # whole numbers below 2^53, so that these sums are exact too
    xx, xy, yy = (
        cv2.boxFilter(product, cv2.CV_64F, side, normalize=False).astype(np.float32)
        for product in (x * x, x * y, y * y)
    )
    scale, half = np.float32((1.0 / (LARGEST_GRADIENT * WINDOW_PX)) ** 2), np.float32(0.5)
    a, b, c = xx * scale * half, xy * scale, yy * scale * half
    return np.asarray((a + c) - np.sqrt((a - c) * (a - c) + b * b), np.float32)


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


def strongest_in_cells_numpy(
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
    room: _Scores,
    points: _Pixels,
    counts: IntArray,
    quotas: IntArray,
) -> int:
    """`strongest_in_cells` in NumPy."""
    n = 0
    for seen, (left, top, right, bottom) in enumerate(cells.tolist()):
        if missing <= 0:
            return seen
        u, v = max(0, left - margin), max(0, top - margin)
        part = image[v : bottom + margin, u : right + margin]
        allowed = np.zeros_like(part)
        own = slice(top - v, bottom - v), slice(left - u, right - u)
        allowed[own] = free[top:bottom, left:right]
        quotas[seen] = min(missing, wanted[seen])
        limits = surplus * quotas[seen], share, smallest, distance_px
        scores = smallest_eigenvalues_numpy(part)
        if allowed.any():
            room[: scores.size] = scores.ravel()
        best = strongest_maxima_numpy(scores, allowed, *limits)
        counts[seen] = len(best)
        points[n : n + len(best)] = best[:, :2] + (u, v)
        clear_disks_numpy(free, points[n : n + len(best)], half_widths)
        missing -= min(quotas[seen], len(best))
        n += len(best)
    return len(cells)
