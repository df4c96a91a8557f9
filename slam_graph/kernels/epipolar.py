# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The epipolar constraint of matches: distances from it, its moments, and depths."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "constraint_moments",
    "constraint_moments_numpy",
    "ray_depths",
    "ray_depths_numpy",
    "sampson_distances",
    "sampson_distances_numpy",
]

_TINY = 1e-12
"""Keeps divisions finite."""

_PARALLEL = 1e-12
"""Smallest determinant of two rays that meet."""


@compiled("f8[::1](f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def sampson_distances(F: FloatArray, m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """Sampson's distances (N,) of matches from m_bᵀ F m_a = 0, on the plane z = 1.

    Args:
        F: (3, 3).
        m_a: (N, 2) normalised points of one image.
        m_b: (N, 2) the same points in the other one.
    """
    distances = np.empty(len(m_a))
    for n in range(len(m_a)):
        x, y, u, v = m_a[n, 0], m_a[n, 1], m_b[n, 0], m_b[n, 1]
        line_u = x * F[0, 0] + y * F[0, 1] + F[0, 2]
        line_v = x * F[1, 0] + y * F[1, 1] + F[1, 2]
        line_x = u * F[0, 0] + v * F[1, 0] + F[2, 0]
        line_y = u * F[0, 1] + v * F[1, 1] + F[2, 1]
        residual = u * line_u + v * line_v + (x * F[2, 0] + y * F[2, 1] + F[2, 2])
        gradient = math.sqrt(line_x * line_x + line_y * line_y + line_u * line_u + line_v * line_v)
        distances[n] = abs(residual) / max(gradient, _TINY)
    return distances


def sampson_distances_numpy(F: FloatArray, m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """`sampson_distances` in NumPy."""
    a = np.column_stack([m_a, np.ones(len(m_a))])
    b = np.column_stack([m_b, np.ones(len(m_b))])
    line_b, line_a = a @ F.T, b @ F
    residual = np.abs(np.sum(b * line_b, axis=1))
    gradient = np.sqrt(np.sum(line_a[:, :2] ** 2, axis=1) + np.sum(line_b[:, :2] ** 2, axis=1))
    distance: FloatArray = residual / np.maximum(gradient, _TINY)
    return distance


@compiled("f8[:, ::1](f8[:, ::1], f8[:, ::1])")
def constraint_moments(m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """AᵀA (9, 9) of the rows of m_bᵀ F m_a = 0 that multiply the elements of F.

    Args:
        m_a: (N, 2) normalised points of one image.
        m_b: (N, 2) the same points in the other one.
    """
    moments = np.zeros((9, 9))
    row = np.empty(9)
    for n in range(len(m_a)):
        x, y, u, v = m_a[n, 0], m_a[n, 1], m_b[n, 0], m_b[n, 1]
        row[0], row[1], row[2] = u * x, u * y, u
        row[3], row[4], row[5] = v * x, v * y, v
        row[6], row[7], row[8] = x, y, 1.0
        for i in range(9):
            for j in range(9):
                moments[i, j] += row[i] * row[j]
    return moments


def constraint_moments_numpy(m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """`constraint_moments` in NumPy."""
    a = np.column_stack([m_a, np.ones(len(m_a))])
    b = np.column_stack([m_b, np.ones(len(m_b))])
    rows = (b[:, :, None] * a[:, None, :]).reshape(-1, 9)
    moments: FloatArray = rows.T @ rows
    return moments


@compiled("f8[:, ::1](f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1])")
def ray_depths(R: FloatArray, t: FloatArray, m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """Depths (N, 2) in a and in b of the closest points of two rays: z_a R a + t = z_b b.

    Args:
        R: (3, 3) b_R_a.
        t: (3,) of a in b, in metres.
        m_a: (N, 2) normalised points of one image.
        m_b: (N, 2) the same points in the other one.

    Returns:
        Metres; infinite where rays are parallel, negative where they meet behind a camera.
    """
    depths = np.empty((len(m_a), 2))
    for n in range(len(m_a)):
        aa = bb = ab = at = bt = 0.0
        for i in range(3):
            a = m_a[n, 0] * R[i, 0] + m_a[n, 1] * R[i, 1] + R[i, 2]
            b = m_b[n, i] if i < 2 else 1.0
            aa += a * a
            bb += b * b
            ab += a * b
            at += a * t[i]
            bt += b * t[i]
        determinant = aa * bb - ab * ab
        parallel = determinant < _PARALLEL
        depths[n, 0] = np.inf if parallel else (ab * bt - bb * at) / determinant
        depths[n, 1] = np.inf if parallel else (aa * bt - ab * at) / determinant
    return depths


def ray_depths_numpy(R: FloatArray, t: FloatArray, m_a: FloatArray, m_b: FloatArray) -> FloatArray:
    """`ray_depths` in NumPy."""
    a = np.column_stack([m_a, np.ones(len(m_a))]) @ R.T
    b = np.column_stack([m_b, np.ones(len(m_b))])
    # z_a a + t = z_b b in the least squares sense
    aa, bb, ab = np.sum(a * a, 1), np.sum(b * b, 1), np.sum(a * b, 1)
    at, bt = a @ t, b @ t
    determinant = aa * bb - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = np.column_stack([ab * bt - bb * at, aa * bt - ab * at]) / determinant[:, None]
    result: FloatArray = np.where(determinant[:, None] < _PARALLEL, np.inf, depths)
    return result
