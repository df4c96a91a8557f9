# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Points that keep their distance from one another and from those of a mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "apart",
    "apart_numpy",
    "claim",
    "claim_numpy",
    "clear_disks",
    "clear_disks_numpy",
    "in_mask",
    "in_mask_numpy",
]

_Mask = NDArray[np.uint8]
_Pixels = NDArray[np.float32]


@compiled("void(u1[:, ::1], f4[:, ::1], i8[::1])")
def clear_disks(mask: _Mask, points: _Pixels, half_widths: IntArray) -> None:
    """Set a disk around each point of a mask to zero.

    Args:
        mask: (height, width).
        points: (N, 2) pixels (u, v).
        half_widths: (2 r + 1,) pixels on either side of the centre, in each row of a disk.
    """
    height, width = mask.shape
    radius = len(half_widths) // 2
    for n in range(len(points)):
        u, v = int(np.rint(points[n, 0])), int(np.rint(points[n, 1]))
        for row in range(max(0, v - radius), min(height, v + radius + 1)):
            half = half_widths[row - v + radius]
            mask[row, max(0, u - half) : max(0, min(width, u + half + 1))] = 0


def clear_disks_numpy(mask: _Mask, points: _Pixels, half_widths: IntArray) -> None:
    """`clear_disks` in NumPy."""
    radius = len(half_widths) // 2
    for u, v in np.rint(points).astype(int).tolist():
        for row, half in enumerate(half_widths.tolist(), v - radius):
            if 0 <= row < len(mask):
                mask[row, max(0, u - half) : max(0, u + half + 1)] = 0


@compiled("b1[::1](u1[:, ::1], f4[:, ::1])")
def in_mask(mask: _Mask, points: _Pixels) -> BoolArray:
    """Which points (N, 2) lie where a mask is not zero; none outside of it."""
    height, width = mask.shape
    inside = np.empty(len(points), np.bool_)
    for n in range(len(points)):
        u, v = int(np.rint(points[n, 0])), int(np.rint(points[n, 1]))
        inside[n] = 0 <= u < width and 0 <= v < height and mask[v, u] != 0
    return inside


def in_mask_numpy(mask: _Mask, points: _Pixels) -> BoolArray:
    """`in_mask` in NumPy."""
    u, v = np.rint(points).astype(int).T
    height, width = mask.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    inside[inside] = mask[v[inside], u[inside]] != 0
    return np.asarray(inside)


@compiled("i8[::1](u1[:, ::1], f4[:, ::1], i8, f8, i8[::1])")
def claim(
    free: _Mask, pixels: _Pixels, count: int, distance_px: float, half_widths: IntArray
) -> IntArray:
    """The first points that lie in a mask and keep their distance, whose disks are then cleared.

    Args:
        free: (height, width) mask; zero where no point may be.
        pixels: (N, 2), best first.
        count: most that are wanted.
        distance_px: smallest distance between two of them.
        half_widths: of the disks, as in `clear_disks`.

    Returns:
        (M,) indices, ascending.
    """
    height, width = free.shape
    limit = np.float32(distance_px * distance_px)
    chosen = np.empty(len(pixels), np.int64)
    found = 0
    for n in range(len(pixels)):
        if found >= count:
            break
        u = min(max(int(np.rint(pixels[n, 0])), 0), width - 1)
        v = min(max(int(np.rint(pixels[n, 1])), 0), height - 1)
        if free[v, u] == 0:
            continue
        alone = True
        for k in range(found):
            du = pixels[n, 0] - pixels[chosen[k], 0]
            dv = pixels[n, 1] - pixels[chosen[k], 1]
            alone &= du * du + dv * dv >= limit
        if alone:
            chosen[found] = n
            found += 1
    clear_disks(free, pixels[chosen[:found]], half_widths)
    return chosen[:found]


def claim_numpy(
    free: _Mask, pixels: _Pixels, count: int, distance_px: float, half_widths: IntArray
) -> IntArray:
    """`claim` in NumPy."""
    u, v = np.rint(pixels).astype(int).T
    height, width = free.shape
    left = np.flatnonzero(free[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)])
    chosen: list[int] = []
    while len(left) and len(chosen) < count:
        chosen.append(int(left[0]))
        squares = np.sum((pixels[left] - pixels[left[0]]) ** 2, axis=1)
        left = left[1:][squares[1:] >= distance_px**2]
    clear_disks_numpy(free, pixels[chosen], half_widths)
    return np.array(chosen, np.int64)


@compiled("b1[::1](f4[:, ::1], f8)")
def apart(pixels: _Pixels, distance_px: float) -> BoolArray:
    """Which points (N, 2) are not within a distance of an earlier one, (N,)."""
    limit = np.float32(distance_px * distance_px)
    alone = np.ones(len(pixels), np.bool_)
    for n in range(len(pixels)):
        for k in range(n):
            du, dv = pixels[n, 0] - pixels[k, 0], pixels[n, 1] - pixels[k, 1]
            alone[n] &= du * du + dv * dv >= limit
    return alone


def apart_numpy(pixels: _Pixels, distance_px: float) -> BoolArray:
    """`apart` in NumPy."""
    u, v = pixels.T
    close = (u[:, None] - u) ** 2 + (v[:, None] - v) ** 2 < distance_px**2
    result: BoolArray = ~np.any(np.tril(close, -1), axis=1)
    return result
