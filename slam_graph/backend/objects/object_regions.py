# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Regions of the image in which more features are wanted: around objects, and where one may be."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors import FeatureObservations

NEIGHBOURS_PX = 80.0
"""Moving features that are nearer than this may be of one object."""
_LEAST = 3
"""Moving features that make a region."""
_GROWN_PX = 15.0
"""Regions reach so far beyond the features: an object is larger than the hull of its features. What
is found beside it is static, and given back."""


def region(seen: FeatureObservations, ids: IntArray) -> FloatArray:
    """(N, 2) polygon around some features, pixels; of fewer than three features these."""
    pixels = seen.pixels[np.isin(seen.ids, ids)]
    if len(pixels) < _LEAST:
        return pixels
    outer = pixels.mean(axis=0)
    away = pixels - outer
    length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    grown = outer + away * (1.0 + _GROWN_PX / length)
    hull = cv2.convexHull(grown.astype(np.float32))
    return np.asarray(hull[:, 0], np.float64)


def regions_of_motion(seen: FeatureObservations, ids: IntArray) -> list[FloatArray]:
    """Polygons around moving features that are near one another and of no object yet."""
    rows = np.flatnonzero(np.isin(seen.ids, ids))
    if len(rows) < _LEAST:
        return []
    near = cdist(seen.pixels[rows], seen.pixels[rows]) < NEIGHBOURS_PX
    _, cluster = connected_components(near, directed=False)
    groups = (seen.ids[rows[cluster == k]] for k in range(cluster.max() + 1))
    return [region(seen, group) for group in groups if len(group) >= _LEAST]
