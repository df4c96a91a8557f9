# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pyramidal Lucas-Kanade in NumPy: the specification of `window_tracking`."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.kernels.halvings import halved
from slam_graph.kernels.window_tracking import (
    _IMAGE_BITS,
    _ONE,
    _OSCILLATION_PX,
    _SCALE,
    _SINGULAR,
    _WEIGHT_BITS,
    _WHOLE,
    WINDOW_PX,
)

__all__ = ["track_windows_numpy"]

_Image = NDArray[np.uint8]
_Halvings = NDArray[np.uint8]
_Pixels = NDArray[np.float32]
_Errors = NDArray[np.float32]


def track_windows_numpy(
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
) -> tuple[_Pixels, BoolArray, _Errors]:
    """`track_windows` in NumPy."""
    moved, found = start / np.float32(1 << levels), np.ones(len(points), np.bool_)
    limits = iterations, step_px, least_eigenvalue
    for level in range(levels, -1, -1):
        one, other = halved(source, source_halvings, level), halved(target, target_halvings, level)
        _track_level_numpy(one, other, points, moved, found, level, *limits)
        moved = moved * np.float32(2.0 if level > 0 else 1.0)
    last = np.array(target.shape[::-1]) - 1 - border_px
    found &= np.all((moved >= border_px) & (moved <= last), axis=1)
    rows = np.flatnonzero(found)
    back, returned = points[rows], np.ones(len(rows), np.bool_)
    _track_level_numpy(target, source, moved[rows], back, returned, 0, *limits)
    found[rows] = returned
    error_px = np.full(len(points), np.inf, np.float32)
    error_px[rows[returned]] = np.linalg.norm(back - points[rows], axis=1)[returned]
    return moved, found, error_px


def _track_level_numpy(
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
    """`_track_level` in NumPy."""
    half, scale = np.float32((WINDOW_PX - 1) * 0.5), np.float32(1.0 / (1 << level))
    reach, size = WINDOW_PX + 1, np.array(source.shape[::-1])
    grey, others = (
        np.pad(image.astype(np.int64), reach, mode="reflect") for image in (source, target)
    )
    derivatives = [
        np.pad(cv2.Scharr(source, cv2.CV_16S, *order).astype(np.int64), reach)
        for order in ((1, 0), (0, 1))
    ]

    def window(image: IntArray, place: _Pixels, bits: int) -> IntArray | None:
        corner = np.floor(place)
        if np.any(corner < -WINDOW_PX) or np.any(corner >= size):
            return None
        (a, b), (u, v) = place - corner, corner.astype(int) + reach
        weights = [(_ONE - a) * (_ONE - b), a * (_ONE - b), (_ONE - a) * b]
        w = [int(np.rint(weight * _WHOLE)) for weight in weights]
        rows = image[v : v + WINDOW_PX + 1, u : u + WINDOW_PX + 1]
        upper = w[0] * rows[:-1, :-1] + w[1] * rows[:-1, 1:]
        lower = w[2] * rows[1:, :-1] + ((1 << _WEIGHT_BITS) - sum(w)) * rows[1:, 1:]
        return (upper + lower + (1 << (bits - 1))) >> bits

    def total(a: IntArray, b: IntArray) -> np.float32:
        return np.float32(np.sum(a * b)) * _SCALE

    def found(start: _Pixels, place: _Pixels) -> bool:
        patch = window(grey, start, _IMAGE_BITS)
        gx, gy = (window(image, start, _WEIGHT_BITS) for image in derivatives)
        if patch is None or gx is None or gy is None:
            return False
        xx, xy, yy = total(gx, gx), total(gx, gy), total(gy, gy)
        determinant = xx * yy - xy * xy
        root = np.sqrt((xx - yy) * (xx - yy) + np.float32(4.0) * xy * xy)
        eigenvalue = (yy + xx - root) / np.float32(2 * WINDOW_PX * WINDOW_PX)
        if eigenvalue < least_eigenvalue or determinant < _SINGULAR:
            return False
        last, x = np.zeros(2, np.float32), place - half
        for k in range(iterations):
            moved = window(others, x, _IMAGE_BITS)
            if moved is None:
                return False
            bx, by = total(moved - patch, gx), total(moved - patch, gy)
            step = np.array([xy * by - yy * bx, xy * bx - xx * by]) * (_ONE / determinant)
            x = x + step
            place[:] = x + half
            if np.sum(step.astype(np.float64) ** 2) <= step_px * step_px:
                break
            if k > 0 and np.all(np.abs(step + last) < _OSCILLATION_PX):
                place -= step * np.float32(0.5)
                break
            last = step
        return window(others, place - half, _IMAGE_BITS) is not None

    for i, point in enumerate(points):
        good[i] &= found(point * scale - half, guess[i]) or level > 0
