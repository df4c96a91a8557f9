# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Patches of an image as `align_patches` looks for them in others."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["fill_templates", "fill_templates_numpy"]

_PX, _ROW = 15, 16  # PATCH_PX and ROW_PX of `patch_alignment.py`: a kernel sees its own file only
_HALF, _COUNT = _PX // 2, _PX * _PX
_WARP_NOISE_GREY = 2.0
"""Standard deviation of noise of the image (grey levels) that weighs against a change of the warp
by a pixel at the edge of a patch: where a patch does not show its warp, that stays."""
_LEAST_DEVIATION = 1.0
"""A patch with less contrast (grey levels) is none."""
_LEAST_INFORMATION = 1e-9
"""Added to the sums of J Jᵀ, so that they have an inverse: where a patch has gradients along one
direction only, it is not moved along the other."""


@compiled()
def _invert(A: FloatArray, inverse: FloatArray) -> None:
    """The inverse of a symmetric positive definite matrix (6, 6), which is overwritten."""
    for i in range(6):
        for j in range(6):
            inverse[i, j] = 1.0 if i == j else 0.0
    for i in range(6):
        scale = 1.0 / A[i, i]
        for j in range(6):
            A[i, j] *= scale
            inverse[i, j] *= scale
        for k in range(6):
            if k != i:
                factor = A[k, i]
                for j in range(6):
                    A[k, j] -= factor * A[i, j]
                    inverse[k, j] -= factor * inverse[i, j]


@compiled(
    "b1[::1](u1[:, ::1], f4[:, ::1], i8[::1], f4[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1])",
)
def fill_templates(
    image: NDArray[np.uint8],
    pixels: NDArray[np.float32],
    slots: IntArray,
    templates: NDArray[np.float32],
    systems: FloatArray,
    warps: FloatArray,
) -> BoolArray:
    """Take the patches around pixels of an image; see `align_patches`.

    Args:
        image: (height, width) grey.
        pixels: (N, 2) the middles of the patches, 10 pixels or more from the edge.
        slots: (N,) which of the templates to fill, each once.
        templates: (T, 3, 240).
        systems: (T, 8, 6).
        warps: (T, 2, 2), those of the filled templates are made the identity.

    Returns:
        (N,) whether a patch has contrast; of others nothing is filled.
    """
    textured = np.zeros(len(pixels), np.bool_)
    grey, J = np.empty((_PX + 2, _PX + 2)), np.empty(6)
    H, means, correlations = np.empty((6, 6)), np.empty(6), np.empty(6)
    for i in range(len(pixels)):
        n, x, y = slots[i], float(pixels[i, 0]), float(pixels[i, 1])
        right, below = x % 1.0, y % 1.0
        first_u, first_v = int(x) - _HALF - 1, int(y) - _HALF - 1
        total = squares = 0.0
        for row in range(_PX + 2):
            for column in range(_PX + 2):
                u, v = first_u + column, first_v + row
                upper = (1.0 - right) * image[v, u] + right * image[v, u + 1]
                lower = (1.0 - right) * image[v + 1, u] + right * image[v + 1, u + 1]
                grey[row, column] = (1.0 - below) * upper + below * lower
        for row in range(1, _PX + 1):
            for column in range(1, _PX + 1):
                total += grey[row, column]
        mean = total / _COUNT
        for row in range(1, _PX + 1):
            for column in range(1, _PX + 1):
                squares += (grey[row, column] - mean) ** 2
        deviation = math.sqrt(squares / _COUNT)
        if deviation < _LEAST_DEVIATION:
            continue
        textured[i] = True
        H[:], means[:], correlations[:] = 0.0, 0.0, 0.0
        for row in range(_PX):
            down = (row - _HALF) / _HALF
            for column in range(_PX):
                k, across = row * _ROW + column, (column - _HALF) / _HALF
                T = (grey[row + 1, column + 1] - mean) / deviation
                dx = 0.5 * (grey[row + 1, column + 2] - grey[row + 1, column]) / deviation
                dy = 0.5 * (grey[row + 2, column + 1] - grey[row, column + 1]) / deviation
                templates[n, 0, k], templates[n, 1, k], templates[n, 2, k] = T, dx, dy
                J[0], J[1], J[2], J[3] = dx, dy, dx * across, dx * down
                J[4], J[5] = dy * across, dy * down
                for m in range(6):
                    means[m] += J[m]
                    correlations[m] += J[m] * T
                    for j in range(m + 1):
                        H[m, j] += J[m] * J[j]
        noise = _WARP_NOISE_GREY / deviation
        for m in range(6):
            means[m] /= _COUNT
            correlations[m] /= _COUNT
        for m in range(6):
            for j in range(m + 1):
                H[m, j] -= _COUNT * (means[m] * means[j] + correlations[m] * correlations[j])
                H[j, m] = H[m, j]
            H[m, m] += _LEAST_INFORMATION + (noise * noise * _COUNT if m > 1 else 0.0)
        _invert(H, systems[n])
        for m in range(6):
            systems[n, 6, m], systems[n, 7, m] = means[m], correlations[m]
        warps[n, 0, 0] = warps[n, 1, 1] = 1.0
        warps[n, 0, 1] = warps[n, 1, 0] = 0.0
    return textured


def fill_templates_numpy(
    image: NDArray[np.uint8],
    pixels: NDArray[np.float32],
    slots: IntArray,
    templates: NDArray[np.float32],
    systems: FloatArray,
    warps: FloatArray,
) -> BoolArray:
    """`fill_templates` in NumPy."""
    first = np.floor(pixels.astype(np.float64)).astype(np.int64) - _HALF - 1
    right, below = (pixels - np.floor(pixels)).astype(np.float64).T[:, :, None, None]
    side = np.arange(_PX + 3)
    rows, columns = first[:, 1, None] + side, first[:, 0, None] + side
    grey = image[rows[:, :, None], columns[:, None, :]].astype(np.float64)
    grey = (1.0 - right) * grey[:, :, :-1] + right * grey[:, :, 1:]
    grey = (1.0 - below) * grey[:, :-1] + below * grey[:, 1:]
    inner = grey[:, 1:-1, 1:-1]
    mean, deviation = inner.mean(axis=(1, 2)), inner.std(axis=(1, 2))
    textured: BoolArray = deviation >= _LEAST_DEVIATION
    down, across = np.meshgrid(*[np.arange(-_HALF, _HALF + 1) / _HALF] * 2, indexing="ij")
    for i in np.flatnonzero(textured):
        T = (inner[i] - mean[i]) / deviation[i]
        dx = 0.5 * (grey[i, 1:-1, 2:] - grey[i, 1:-1, :-2]) / deviation[i]
        dy = 0.5 * (grey[i, 2:, 1:-1] - grey[i, :-2, 1:-1]) / deviation[i]
        padded = np.pad(np.stack([T, dx, dy]), ((0, 0), (0, 0), (0, _ROW - _PX)))
        templates[slots[i]] = padded.reshape(3, -1)
        J = np.stack([dx, dy, dx * across, dx * down, dy * across, dy * down]).reshape(6, -1)
        means, correlations = J.mean(axis=1), J @ T.ravel() / _COUNT
        rest = J - means[:, None] - np.outer(correlations, T)
        held = (_WARP_NOISE_GREY / deviation[i]) ** 2 * _COUNT * np.array([0, 0, 1, 1, 1, 1])
        H = rest @ rest.T + np.diag(held + _LEAST_INFORMATION)
        systems[slots[i]] = [*np.linalg.inv(H), means, correlations]
        warps[slots[i]] = np.eye(2)
    return textured
