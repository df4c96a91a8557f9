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


@compiled()
def _fill_normals(
    one: FloatArray,
    two: FloatArray,
    by_one: FloatArray,
    by_two: FloatArray,
    R: FloatArray,
    normals: FloatArray,
) -> None:
    """Fill n and its four derivatives, (5, 3), of a feature."""
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        turned_a = R[a, 0] * two[0] + R[a, 1] * two[1] + R[a, 2] * two[2]
        turned_b = R[b, 0] * two[0] + R[b, 1] * two[1] + R[b, 2] * two[2]
        normals[0, c] = one[a] * turned_b - one[b] * turned_a
        for k in range(2):
            normals[1 + k, c] = by_one[k, a] * turned_b - by_one[k, b] * turned_a
            by_a = R[a, 0] * by_two[k, 0] + R[a, 1] * by_two[k, 1] + R[a, 2] * by_two[k, 2]
            by_b = R[b, 0] * by_two[k, 0] + R[b, 1] * by_two[k, 1] + R[b, 2] * by_two[k, 2]
            normals[3 + k, c] = one[a] * by_b - one[b] * by_a


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
    normals, along = np.empty((5, 3)), np.empty(5)
    for p in range(len(t)):
        x, y, z = t[p, 0], t[p, 1], t[p, 2]
        for n in range(one.shape[1]):
            _fill_normals(one[p, n], two[p, n], by_one[p, n], by_two[p, n], R[p], normals)
            variance = 0.0
            for k in range(5):
                along[k] = x * normals[k, 0] + y * normals[k, 1] + z * normals[k, 2]
            for k in range(1, 5):
                variance += along[k] * along[k]
            variance = max(variance, least[p, n])
            sigma = math.sqrt(variance)
            distance = along[0] / sigma
            distances[p, n], sigmas[p, n] = distance, sigma
            if len(slopes) == 0:
                continue
            for c in range(3):
                half = 0.0  # of the derivative of the variance
                for k in range(1, 5):
                    half += along[k] * normals[k, c]
                slopes[p, n, c] = normals[0, c] / sigma - half * distance / variance


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
    normals = np.empty((5, 3))
    for p in range(len(R)):
        for a in range(3):
            for b in range(3):
                moments[p, a, b] = 0.0
        for n in range(one.shape[1]):
            weight, noise = weights[p, n], by_noise[p, n]
            if weight == 0.0 and noise == 0.0:
                continue
            _fill_normals(one[p, n], two[p, n], by_one[p, n], by_two[p, n], R[p], normals)
            if normalize:
                square = normals[0, 0] * normals[0, 0] + normals[0, 1] * normals[0, 1]
                weight /= max(square + normals[0, 2] * normals[0, 2], _LEAST_SQUARE)
            for a in range(3):
                for b in range(a, 3):
                    spread = 0.0
                    for k in range(1, 5):
                        spread += normals[k, a] * normals[k, b]
                    moments[p, a, b] += weight * normals[0, a] * normals[0, b] - noise * spread
        for a in range(3):
            for b in range(a):
                moments[p, a, b] = moments[p, b, a]


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
