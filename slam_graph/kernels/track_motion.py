# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton steps for the position and the velocity of many tracks, each with poses as given.

Beside the noise of single observations a track has three slow errors, which last over its frames: a
constant offset of its matches in the other cameras (pixels), and the rates at which its patch
slides off its point in the first camera and in the others (pixels/s). Each has two pixel
coordinates with a Gaussian prior, and is estimated with the point. The shares of an observation
say by how much it changes with each of the three. Those of one pixel coordinate do not depend on
those of the other, and are eliminated before position and velocity are solved for.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["motion_steps", "motion_steps_numpy"]

_LOST = 1e-12
"""Used as pivot where rounding gives zero: beside 1e20 the prior's share is lost."""
_STILL = 1e-9
"""Steps that are no larger, m, are not held back."""


@compiled()
def _solve(A: FloatArray, m: int) -> None:
    """Solve H X = B in the place of B, for A = [H B] (m, m + k).

    With pivots: where a point is all but in a camera, rounding makes H indefinite.
    """
    n = A.shape[1]
    for c in range(m):
        pivot = c
        for i in range(c + 1, m):
            if abs(A[i, c]) > abs(A[pivot, c]):
                pivot = i
        if pivot != c:
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
def _sum_up(
    j: int,
    by_point: FloatArray,
    residuals: FloatArray,
    in_camera: FloatArray,
    shares: FloatArray,
    since: FloatArray,
    starts: IntArray,
    sigma: float,
    x: FloatArray,
    H: FloatArray,
    F: FloatArray,
) -> tuple[float, float]:
    """Sum up the observations of track j; the other arguments are those of `motion_steps`.

    Filled are H (6, 7 + k), the equations of position and velocity with their right-hand side in
    column 6, and F (2, 3, 10), those of the slow errors in each pixel coordinate: their own three
    columns, six of position and velocity, and the right-hand side. The result is the sum of the
    squared errors over σ², and the least depth, m.
    """
    H[:] = 0.0
    F[:] = 0.0
    square, depth, scale = 0.0, np.inf, 1.0 / sigma
    for n in range(starts[j], starts[j + 1]):
        depth, t = min(depth, abs(in_camera[n, 2])), since[n]
        for i in range(2):
            r = residuals[n, i] * scale
            for k in range(3):
                r -= shares[n, k] * x[j, 6 + 2 * k + i]
            square += r * r
            for a in range(3):
                slope = by_point[n, i, a] * scale
                H[a, 6] += slope * r
                H[3 + a, 6] += slope * t * r
                for b in range(a + 1):
                    product = slope * by_point[n, i, b] * scale
                    H[a, b] += product
                    H[3 + a, b] += product * t
                    H[3 + a, 3 + b] += product * t * t
            for k in range(3):
                share = shares[n, k]
                if share == 0.0:  # most are
                    continue
                F[i, k, 9] += share * r
                for a in range(3):
                    product = share * by_point[n, i, a] * scale
                    F[i, k, 3 + a] += product
                    F[i, k, 6 + a] += product * t
                    F[i, k, a] += share * shares[n, a]
    for a in range(3):
        for b in range(a):
            H[3 + b, a] = H[3 + a, b]
    for a in range(6):
        for b in range(a):
            H[b, a] = H[a, b]
    return square, depth


@compiled()
def _eliminate(F: FloatArray, H: FloatArray) -> None:
    """Take slow errors out of the equations H (6, 7) of a track.

    Args:
        F: (3, 10) [N C b] of slow errors; N⁻¹ [C b] is left in its last columns.
        H: (6, 7 + k) [H b], less Cᵀ N⁻¹ [C b] afterwards.
    """
    C = F[:, 3:9].copy()
    _solve(F, 3)
    for a in range(6):
        for k in range(3):
            for b in range(7):
                H[a, b] -= C[k, a] * F[k, 3 + b]


@compiled()
def _step(
    H: FloatArray, F: FloatArray, x: FloatArray, depth: float, reach: float, largest: float
) -> None:
    """Move a track x (12,) by the solution; by less where that leads through a camera.

    Args:
        H: (6, 7 + k) solved, that of position and velocity in column 6.
        F: (2, 3, 10) as `_eliminate` leaves them.
        x: moved.
        depth: the least one, m.
        reach: largest time, s.
        largest: part of the depth.
    """
    moved = math.sqrt(H[0, 6] ** 2 + H[1, 6] ** 2 + H[2, 6] ** 2)
    moved += math.sqrt(H[3, 6] ** 2 + H[4, 6] ** 2 + H[5, 6] ** 2) * reach
    part = min(1.0, largest * depth / max(moved, _STILL))
    for a in range(6):
        x[a] += H[a, 6] * part
    for i in range(2):
        for k in range(3):
            error = F[i, k, 9]
            for a in range(6):
                error -= F[i, k, 3 + a] * H[a, 6]
            x[6 + 2 * k + i] += error * part


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
    H, F = np.empty((6, 7 + velocities)), np.empty((2, 3, 10))
    for j in range(len(x)):
        squares[j], depth = _sum_up(
            j, by_point, residuals, in_camera, shares, since, starts, sigma, x, H, F
        )
        for i in range(2):
            for k in range(3):
                row = 6 + 2 * k + i
                F[i, k, k] += information[row]
                F[i, k, 9] += information[row] * (before[j, row] - x[j, row])
        for a in range(6):
            H[a, a] += information[a]
            H[a, 6] += information[a] * (before[j, a] - x[j, a])
        for i in range(2):
            _eliminate(F[i], H)
        for a in range(6):
            for k in range(velocities):
                H[a, 7 + k] = 1.0 if a == 3 + k else 0.0
        _solve(H, 6)
        for k in range(velocities):
            for m in range(3):
                covariances[j, m, k] = H[3 + m, 7 + k]
        if largest > 0.0:
            _step(H, F, x[j], depth, reach, largest)
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
