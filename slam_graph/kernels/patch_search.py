# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The candidate whose patch is most similar to that of a point in another image.

Candidates lie along the ray of a point; where the other camera sees them is a kernel, too.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["along_rays", "along_rays_numpy", "most_similar", "most_similar_numpy"]

_Image = NDArray[np.uint8]
_Patch = NDArray[np.int16]

_at = np.uintp
"""An index without a sign. Numba would test others for negative ones, and not use vectors."""


@compiled("f8[:, ::1](f8[:, ::1], f8[:, ::1], f8)")
def along_rays(rays: FloatArray, shifts: FloatArray, nearest: float) -> FloatArray:
    """Where a camera sees points along the rays of another one, on the plane z = 1.

    There are many points, and NumPy would go through all of them eight times.

    Args:
        rays: (N, 3) of the other camera, turned into the frame of this one.
        shifts: (C, 3) the way to the other camera, divided by each distance along the rays.
        nearest: points nearer than this, in units of that distance, are seen as if so near.

    Returns:
        (N C, 2) normalised points, those of a ray one behind the other.
    """
    count = len(shifts)
    seen = np.empty((len(rays) * count, 2))
    for n in range(len(rays)):
        for c in range(count):
            depth = max(rays[n, 2] + shifts[c, 2], nearest)
            seen[n * count + c, 0] = (rays[n, 0] + shifts[c, 0]) / depth
            seen[n * count + c, 1] = (rays[n, 1] + shifts[c, 1]) / depth
    return seen


def along_rays_numpy(rays: FloatArray, shifts: FloatArray, nearest: float) -> FloatArray:
    """`along_rays` in NumPy."""
    points = (rays[:, None] + shifts).reshape(-1, 3)
    seen: FloatArray = points[:, :2] / np.maximum(points[:, 2:], nearest)
    return seen


@compiled()
def _centre(place: float, scale: int, length: int, radius: int) -> int:
    """The reduced pixel at a place, so far from the edge that a patch fits in."""
    # Pixel centres are at integers, so a reduced pixel u covers 4u - 1.5 … 4u + 1.5 of the full
    nearest = np.rint((place + 0.5) / scale - 0.5)
    return int(min(max(nearest, float(radius)), float(length - 1 - radius)))


@compiled()
def _copy(image: _Image, u: int, v: int, radius: int, out: _Patch) -> None:
    """The patch around a pixel (u, v)."""
    side = 2 * radius + 1
    for i in range(side):
        for j in range(side):
            out[_at(i * side + j)] = image[_at(v - radius + i), _at(u - radius + j)]


@compiled()
def _correlation(patch: _Patch, other: _Patch, sum_r: np.int64, sum_rr: np.int64) -> float:
    """Normalised cross-correlation of patches, the sums of the first one and its squares given."""
    o_sum = o_squares = products = np.int32(0)
    count = len(patch)
    for k in range(count):
        o = np.int32(other[_at(k)])
        o_sum = np.int32(o_sum + o)
        o_squares = np.int32(o_squares + np.int32(o * o))
        products = np.int32(products + np.int32(o * np.int32(patch[_at(k)])))
    sum_o, sum_oo, sum_ro = np.int64(o_sum), np.int64(o_squares), np.int64(products)
    variances = (count * sum_rr - sum_r * sum_r) * (count * sum_oo - sum_o * sum_o)
    if variances == 0:
        return 0.0
    return float(count * sum_ro - sum_r * sum_o) / math.sqrt(float(variances))


@compiled("i8[::1](u1[:, ::1], u1[:, ::1], f8[:, ::1], f8[:, :, ::1], i8, i8, f8[::1])")
def most_similar(
    reference: _Image,
    other: _Image,
    points: FloatArray,
    candidates: FloatArray,
    scale: int,
    radius: int,
    scores: FloatArray,
) -> IntArray:
    """The best candidate of each point, the first one among equals.

    Args:
        reference: image of the points, reduced.
        other: image of the candidates, likewise.
        points: (N, 2) pixels of full size.
        candidates: (N, C, 2) pixels of full size; those outside of the image score -1.
        scale: how many times as large full size is.
        radius: patches have (2 radius + 1)² pixels, moved inwards at the edge.
        scores: (N,) is filled with the normalised cross-correlations of the best.

    Returns:
        (N,) their indices.
    """
    (height, width), (reference_height, reference_width) = other.shape, reference.shape
    best = np.empty(len(points), np.int64)
    pixels = (2 * radius + 1) ** 2
    patch, candidate = np.empty(pixels, np.int16), np.empty(pixels, np.int16)
    for n in range(len(points)):
        u = _centre(points[n, 0], scale, reference_width, radius)
        v = _centre(points[n, 1], scale, reference_height, radius)
        _copy(reference, u, v, radius, patch)
        sum_r, sum_rr = np.int64(0), np.int64(0)
        for k in range(len(patch)):
            r = np.int64(patch[k])
            sum_r += r
            sum_rr += r * r
        scores[n], best[n], score = -1.0, 0, -1.0
        last_a, last_b = -1, -1
        for c in range(candidates.shape[1]):
            x, y = candidates[n, c]
            if not (0.0 <= x <= scale * width and 0.0 <= y <= scale * height):
                continue
            a, b = _centre(x, scale, width, radius), _centre(y, scale, height, radius)
            if a != last_a or b != last_b:
                _copy(other, a, b, radius, candidate)
                score = _correlation(patch, candidate, sum_r, sum_rr)
                last_a, last_b = a, b
            if score > scores[n]:
                scores[n], best[n] = score, c
    return best


def most_similar_numpy(
    reference: _Image,
    other: _Image,
    points: FloatArray,
    candidates: FloatArray,
    scale: int,
    radius: int,
    scores: FloatArray,
) -> IntArray:
    """`most_similar` in NumPy."""
    count = candidates.shape[1]
    patches = _patches(reference, points, scale, radius)
    others = _patches(other, candidates.reshape(-1, 2), scale, radius)
    similar = np.einsum("np,ncp->nc", patches, others.reshape(len(points), count, -1))
    height, width = other.shape
    size = np.array([scale * width, scale * height])
    similar[~np.all((candidates >= 0) & (candidates <= size), axis=2)] = -1.0
    # Equal patches must not be told apart by a rounding
    best: IntArray = np.argmax(np.round(similar, 12), axis=1)
    scores[:] = similar[np.arange(len(points)), best]
    return best


def _patches(image: _Image, pixels: FloatArray, scale: int, radius: int) -> FloatArray:
    """Patches (N, P) around full-size pixels (N, 2), of zero mean and unit norm."""
    height, width = image.shape
    centres = np.rint((pixels + 0.5) / scale - 0.5)
    u, v = np.clip(centres, radius, np.array([width, height]) - 1 - radius).astype(np.int64).T
    steps = np.arange(-radius, radius + 1)
    offsets = (steps[:, None] * width + steps).ravel()
    patches = image.ravel()[(v * width + u)[:, None] + offsets].astype(np.float64)
    patches -= patches.mean(axis=1, keepdims=True)
    norm = np.sqrt(np.einsum("ij,ij->i", patches, patches))
    result: FloatArray = patches / np.maximum(norm, 1e-6)[:, None]
    return result
