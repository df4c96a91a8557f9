# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Epipolar distances of P pairs of frames with N features each, and moments of their normals.

A feature has the bearings f₁ and f₂ in the cameras of a pair, and R turns the second camera into
the first. With the direction t of the translation, t · n vanishes for n = f₁ × R f₂. What n changes
by with the four coordinates of both pixels says how uncertain it is:

    ∂n/∂u₁ = ∂f₁/∂u₁ × R f₂,   ∂n/∂u₂ = f₁ × R ∂f₂/∂u₂.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "epipolar_distances",
    "epipolar_distances_numpy",
    "epipolar_moments",
    "epipolar_moments_numpy",
]

_LEAST_SQUARE = 1e-6
"""Least squared length of a normal that weights are divided by."""


_Vector = tuple[float, float, float]
_Normals = tuple[_Vector, _Vector, _Vector, _Vector, _Vector]
"""n and its derivatives by the four coordinates: tuples stay in registers, arrays do not."""


@compiled()
def _cross(a: _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled()
def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def _normals_of(
    one: FloatArray,
    two: FloatArray,
    by_one: FloatArray,
    by_two: FloatArray,
    R: FloatArray,
    p: int,
    n: int,
) -> _Normals:
    """The normal of feature n in pair p, and its derivatives by the pixels."""
    x, y, z = (
        (R[p, 0, 0], R[p, 0, 1], R[p, 0, 2]),
        (R[p, 1, 0], R[p, 1, 1], R[p, 1, 2]),
        (R[p, 2, 0], R[p, 2, 1], R[p, 2, 2]),
    )
    f = one[p, n, 0], one[p, n, 1], one[p, n, 2]
    of_u = by_one[p, n, 0, 0], by_one[p, n, 0, 1], by_one[p, n, 0, 2]
    of_v = by_one[p, n, 1, 0], by_one[p, n, 1, 1], by_one[p, n, 1, 2]
    g = two[p, n, 0], two[p, n, 1], two[p, n, 2]
    turned = _dot(x, g), _dot(y, g), _dot(z, g)
    g = by_two[p, n, 0, 0], by_two[p, n, 0, 1], by_two[p, n, 0, 2]
    by_u = _dot(x, g), _dot(y, g), _dot(z, g)
    g = by_two[p, n, 1, 0], by_two[p, n, 1, 1], by_two[p, n, 1, 2]
    by_v = _dot(x, g), _dot(y, g), _dot(z, g)
    return (
        _cross(f, turned),
        _cross(of_u, turned),
        _cross(of_v, turned),
        _cross(f, by_u),
        _cross(f, by_v),
    )


@compiled(
    "void(f8[:, :, ::1], f8[:, :, ::1], f8[:, :, :, ::1], f8[:, :, :, ::1], f8[:, :, ::1],"
    " f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1])"
)
def epipolar_distances(
    one: FloatArray,
    two: FloatArray,
    by_one: FloatArray,
    by_two: FloatArray,
    R: FloatArray,
    t: FloatArray,
    least: FloatArray,
    distances: FloatArray,
    sigmas: FloatArray,
    slopes: FloatArray,
) -> None:
    """Fill the epipolar distances in pixels, t · n over its deviation for pixels with unit noise.

    Args:
        one: (P, N, 3) bearings f₁ in the first camera.
        two: (P, N, 3) bearings f₂ in the second one.
        by_one: (P, N, 2, 3) derivatives of f₁ by the pixels.
        by_two: (P, N, 2, 3) those of f₂.
        R: (P, 3, 3) first_R_second of the camera.
        t: (P, 3) directions of the translations in the first camera.
        least: (P, N) smallest variance of t · n for pixels with unit noise.
        distances: (P, N), filled.
        sigmas: (P, N), filled: the deviations of t · n.
        slopes: (P, N, 3), filled: derivatives of the distances by t, for a variance that depends on
            t also where it is `least`; (0, 0, 0) to leave them out.
    """
    for p in range(len(t)):
        direction = t[p, 0], t[p, 1], t[p, 2]
        for n in range(one.shape[1]):
            normal, a, b, c, d = _normals_of(one, two, by_one, by_two, R, p, n)
            by_a, by_b = _dot(direction, a), _dot(direction, b)
            by_c, by_d = _dot(direction, c), _dot(direction, d)
            variance = by_a * by_a + by_b * by_b + by_c * by_c + by_d * by_d
            variance = max(variance, least[p, n])
            sigma = math.sqrt(variance)
            distance = _dot(direction, normal) / sigma
            distances[p, n], sigmas[p, n] = distance, sigma
            if len(slopes) == 0:
                continue
            for k in range(3):
                # half of the derivative of the variance
                half = by_a * a[k] + by_b * b[k] + by_c * c[k] + by_d * d[k]
                slopes[p, n, k] = normal[k] / sigma - half * distance / variance


@compiled(
    "void(f8[:, :, ::1], f8[:, :, ::1], f8[:, :, :, ::1], f8[:, :, :, ::1], f8[:, :, ::1],"
    " f8[:, ::1], f8[:, ::1], b1, f8[:, :, ::1])"
)
def epipolar_moments(
    one: FloatArray,
    two: FloatArray,
    by_one: FloatArray,
    by_two: FloatArray,
    R: FloatArray,
    weights: FloatArray,
    by_noise: FloatArray,
    normalize: bool,
    moments: FloatArray,
) -> None:
    """Fill second moments of the normals, less what the noise of the pixels adds to them.

    Args:
        one: (P, N, 3) bearings f₁ in the first camera.
        two: (P, N, 3) bearings f₂ in the second one.
        by_one: (P, N, 2, 3) derivatives of f₁ by the pixels.
        by_two: (P, N, 2, 3) those of f₂.
        R: (P, 3, 3) first_R_second of the camera.
        weights: (P, N) of the normals.
        by_noise: (P, N) squared noise of the pixels times weights.
        normalize: whether weights are divided by |n|²; `by_noise` is not.
        moments: (P, 3, 3), filled: sums of w n nᵀ less those of `by_noise` cov(n), for pixels with
            unit noise.
    """
    for p in range(len(R)):
        xx = xy = xz = yy = yz = zz = 0.0
        for n in range(one.shape[1]):
            weight, noise = weights[p, n], by_noise[p, n]
            if weight == 0.0 and noise == 0.0:
                continue
            (x, y, z), a, b, c, d = _normals_of(one, two, by_one, by_two, R, p, n)
            if normalize:
                weight /= max(x * x + y * y + z * z, _LEAST_SQUARE)
            spread = a[0] * a[0] + b[0] * b[0] + c[0] * c[0] + d[0] * d[0]
            xx += weight * x * x - noise * spread
            spread = a[0] * a[1] + b[0] * b[1] + c[0] * c[1] + d[0] * d[1]
            xy += weight * x * y - noise * spread
            spread = a[0] * a[2] + b[0] * b[2] + c[0] * c[2] + d[0] * d[2]
            xz += weight * x * z - noise * spread
            spread = a[1] * a[1] + b[1] * b[1] + c[1] * c[1] + d[1] * d[1]
            yy += weight * y * y - noise * spread
            spread = a[1] * a[2] + b[1] * b[2] + c[1] * c[2] + d[1] * d[2]
            yz += weight * y * z - noise * spread
            spread = a[2] * a[2] + b[2] * b[2] + c[2] * c[2] + d[2] * d[2]
            zz += weight * z * z - noise * spread
        moments[p, 0, 0], moments[p, 0, 1], moments[p, 0, 2] = xx, xy, xz
        moments[p, 1, 0], moments[p, 1, 1], moments[p, 1, 2] = xy, yy, yz
        moments[p, 2, 0], moments[p, 2, 1], moments[p, 2, 2] = xz, yz, zz


def epipolar_distances_numpy(
    one: FloatArray,
    two: FloatArray,
    by_one: FloatArray,
    by_two: FloatArray,
    R: FloatArray,
    t: FloatArray,
    least: FloatArray,
    distances: FloatArray,
    sigmas: FloatArray,
    slopes: FloatArray,
) -> None:
    """`epipolar_distances` in NumPy."""
    normals, spread = _normals(one, two, by_one, by_two, R)
    along = (spread @ t[:, None, :, None])[..., 0]
    variances = np.maximum(np.sum(along**2, axis=2), least)
    sigmas[:] = np.sqrt(variances)
    distances[:] = (normals @ t[..., None])[..., 0] / sigmas
    if len(slopes) > 0:
        half = np.sum(along[..., None] * spread, axis=2)
        slopes[:] = normals / sigmas[..., None] - half * (distances / variances)[..., None]


def epipolar_moments_numpy(
    one: FloatArray,
    two: FloatArray,
    by_one: FloatArray,
    by_two: FloatArray,
    R: FloatArray,
    weights: FloatArray,
    by_noise: FloatArray,
    normalize: bool,
    moments: FloatArray,
) -> None:
    """`epipolar_moments` in NumPy."""
    normals, spread = _normals(one, two, by_one, by_two, R)
    if normalize:
        weights = weights / np.maximum(np.sum(normals**2, axis=2), _LEAST_SQUARE)
    moments[:] = np.einsum("pn,pna,pnb->pab", weights, normals, normals)
    moments -= np.einsum("pn,pnka,pnkb->pab", by_noise, spread, spread)


def _normals(
    one: FloatArray, two: FloatArray, by_one: FloatArray, by_two: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normals (P, N, 3) and their derivatives (P, N, 4, 3) by the coordinates of both pixels."""
    turned = two @ R.transpose(0, 2, 1)
    by_turned = by_two @ R.transpose(0, 2, 1)[:, None]
    by_first = np.cross(by_one, turned[:, :, None])
    spread = np.concatenate([by_first, np.cross(one[:, :, None], by_turned)], axis=2)
    return np.cross(one, turned), spread
