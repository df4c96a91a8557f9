# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton steps for the position and the velocity of many tracks, each with poses as given.

Beside the noise of single observations a track has three slow errors, which last over its frames: a
constant offset of its matches in the other cameras (pixels), and the rates at which its patch
slides off its point in the first camera and in the others (pixels/s). Each has two pixel
coordinates with a Gaussian prior, and is estimated with the point. The shares of an observation
say by how much it changes with each of the three.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["motion_steps", "motion_steps_numpy"]

_SIZE = 12
"""Unknowns of a track: position, velocity, and two pixel coordinates of three slow errors."""
_ENTRIES = 9
"""Of them in a row: it has one coordinate of the slow errors only."""
_LOST = 1e-12
"""Used as pivot where rounding gives zero: beside 1e20 the prior's share is lost."""
_STILL = 1e-9
"""Steps that are no larger, m, are not held back."""


@compiled()
def _solve(A: FloatArray) -> None:
    """Solve H X = B in the place of B, for A = [H B] (m, m + k).

    With pivots: where a point is all but in a camera, rounding makes H indefinite.
    """
    m, n = A.shape
    for c in range(m):
        pivot = c
        for i in range(c + 1, m):
            if abs(A[i, c]) > abs(A[pivot, c]):
                pivot = i
        for k in range(c, n):
            A[c, k], A[pivot, k] = A[pivot, k], A[c, k]
        if A[c, c] == 0.0:
            A[c, c] = _LOST
        for i in range(c + 1, m):
            part = A[i, c] / A[c, c]
            for k in range(c, n):
                A[i, k] -= part * A[c, k]
    for c in range(m - 1, -1, -1):
        for k in range(m, n):
            A[c, k] /= A[c, c]
            for i in range(c):
                A[i, k] -= A[i, c] * A[c, k]


@compiled()
def _step(
    A: FloatArray, x: FloatArray, depth: float, reach: float, largest: float, column: int
) -> None:
    """Move a track x (12,) by a column of A; by less where that leads through a camera."""
    moved = math.sqrt(A[0, column] ** 2 + A[1, column] ** 2 + A[2, column] ** 2)
    moved += math.sqrt(A[3, column] ** 2 + A[4, column] ** 2 + A[5, column] ** 2) * reach
    part = min(1.0, largest * depth / max(moved, _STILL))
    for a in range(_SIZE):
        x[a] += A[a, column] * part


@compiled(
    "void(f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], i8[::1], f8[:, ::1],"
    " f8[::1], f8, f8, f8, f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1])"
)
def motion_steps(
    by_point: FloatArray,
    residuals: FloatArray,
    in_camera: FloatArray,
    shares: FloatArray,
    since: FloatArray,
    starts: IntArray,
    before: FloatArray,
    information: FloatArray,
    sigma: float,
    reach: float,
    largest: float,
    x: FloatArray,
    seen: FloatArray,
    squares: FloatArray,
    covariances: FloatArray,
) -> None:
    """One step of J tracks with N observations, those of one track after the other.

    Args:
        by_point: (N, 2, 3) derivatives of pixels by the point.
        residuals: (N, 2) in pixels, without the slow errors.
        in_camera: (N, 3) the points in the frames of the cameras, m.
        shares: (N, 3) derivatives of each pixel coordinate by its three slow errors, over σ.
        since: (N,) times t, s: the point of an observation is p + t u.
        starts: (J + 1,) first observation of each track, and N; strictly ascending, as each track
            has at least one observation.
        before: (J, 12) mean of the prior.
        information: (12,) of the prior, on its diagonal.
        sigma: σ, the standard deviation of the observations, pixels.
        reach: largest |t|, s.
        largest: part of its least depth by which a step may move a point at most; with 0 tracks
            stay where they are.
        x: (J, 12) p, u, and the slow errors (two coordinates of each); moved.
        seen: (N, 3), filled: the points of the observations after the step.
        squares: (J,), filled: squared errors of the observations before it, over σ².
        covariances: (J, 3, 3), filled: of the velocities; (0, 3, 3) where they are not wanted.
    """
    velocities = 3 if len(covariances) else 0
    H, h = np.empty((_SIZE, _SIZE + 1 + velocities)), np.empty(_ENTRIES)
    sums, pulls = np.empty((2, _ENTRIES, _ENTRIES)), np.empty((2, _ENTRIES))
    for j in range(len(x)):
        sums[:] = 0.0
        pulls[:] = 0.0
        squares[j] = 0.0
        depth = np.inf
        for n in range(starts[j], starts[j + 1]):
            depth = min(depth, abs(in_camera[n, 2]))
            for i in range(2):
                r = residuals[n, i] / sigma
                for k in range(3):
                    slope = by_point[n, i, k] / sigma
                    h[k], h[3 + k], h[6 + k] = slope, slope * since[n], shares[n, k]
                    r -= shares[n, k] * x[j, 6 + 2 * k + i]
                squares[j] += r * r
                for a in range(_ENTRIES):
                    pulls[i, a] += h[a] * r
                    for b in range(a + 1):
                        sums[i, a, b] += h[a] * h[b]
        H[:] = 0.0
        for a in range(_SIZE):
            H[a, a] = information[a]
            H[a, _SIZE] = information[a] * (before[j, a] - x[j, a])
        for i in range(2):
            for a in range(_ENTRIES):
                row = a if a < 6 else 2 * a - 6 + i
                H[row, _SIZE] += pulls[i, a]
                for b in range(a + 1):
                    H[row, b if b < 6 else 2 * b - 6 + i] += sums[i, a, b]
        for a in range(_SIZE):
            for b in range(a):
                H[b, a] = H[a, b]
        for k in range(velocities):
            H[3 + k, _SIZE + 1 + k] = 1.0
        _solve(H)
        for k in range(velocities):
            for m in range(3):
                covariances[j, m, k] = H[3 + m, _SIZE + 1 + k]
        if largest > 0.0:
            _step(H, x[j], depth, reach, largest, _SIZE)
        for n in range(starts[j], starts[j + 1]):
            for k in range(3):
                seen[n, k] = x[j, k] + since[n] * x[j, 3 + k]


def motion_steps_numpy(
    by_point: FloatArray,
    residuals: FloatArray,
    in_camera: FloatArray,
    shares: FloatArray,
    since: FloatArray,
    starts: IntArray,
    before: FloatArray,
    information: FloatArray,
    sigma: float,
    reach: float,
    largest: float,
    x: FloatArray,
    seen: FloatArray,
    squares: FloatArray,
    covariances: FloatArray,
) -> None:
    """`motion_steps` in NumPy."""
    feature = np.repeat(np.arange(len(x)), np.diff(starts))
    slides = np.einsum("nk,ia->nika", shares, np.eye(2)).reshape(len(by_point), 2, 6)
    G = by_point / sigma
    A = np.concatenate([G, G * since[:, None, None], slides], axis=2)
    r = residuals / sigma - np.einsum("nij,nj->ni", slides, x[feature, 6:])
    squares[:] = np.add.reduceat(np.sum(r**2, axis=1), starts[:-1])
    lhs = np.add.reduceat(A.transpose(0, 2, 1) @ A, starts[:-1]) + np.diag(information)
    rhs = np.add.reduceat(np.einsum("nij,ni->nj", A, r), starts[:-1]) - information * (x - before)
    covariances[:] = np.linalg.inv(lhs)[: len(covariances), 3:6, 3:6]
    if largest > 0.0:
        shifts = np.linalg.solve(lhs, rhs[:, :, None])[:, :, 0]
        depths = np.minimum.reduceat(np.abs(in_camera[:, 2]), starts[:-1])
        moved = np.linalg.norm(shifts[:, :3], axis=1)
        moved += np.linalg.norm(shifts[:, 3:6], axis=1) * reach
        x += shifts * np.minimum(1.0, largest * depths / np.maximum(moved, _STILL))[:, None]
    seen[:] = x[feature, :3] + since[:, None] * x[feature, 3:6]
