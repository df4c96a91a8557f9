# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bearings of points with their derivatives, and the vectors across directions."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray


def rays_of(points: FloatArray, by_points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit bearings (M, 3) of normalised points (M, 2), and their derivatives (M, 2, 3) by pixels.

    Args:
        points: the points.
        by_points: (M, 2, 2) derivatives of the pixels by them.
    """
    rays = np.column_stack([points, np.ones(len(points))])
    lengths = np.linalg.norm(rays, axis=1)
    rays /= lengths[:, None]
    (a, b), (c, d) = by_points.transpose(1, 2, 0)
    scale = 1.0 / ((a * d - b * c) * lengths)  # times the adjugate: an inverse
    slopes = np.zeros((len(points), 2, 3))
    slopes[:, 0, 0], slopes[:, 0, 1] = d * scale, -c * scale
    slopes[:, 1, 0], slopes[:, 1, 1] = -b * scale, a * scale
    slopes -= (slopes @ rays[:, :, None]) * rays[:, None]
    return rays, slopes


def tangents(t: FloatArray) -> FloatArray:
    """Two unit vectors (P, 3, 2) orthogonal to each direction (P, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(t), axis=1)]
    u = np.cross(t, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(t, u)], axis=-1)
