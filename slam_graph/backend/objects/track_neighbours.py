# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which tracks are neighbours in the image: an object is seen as one region.

Two tracks are neighbours if an edge of the Delaunay triangulation of all tracks joins them. Tracks
of what lies between two objects keep these apart.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.sensors import FeatureObservations

_LEAST = 5
"""Tracks from which on there is a triangulation to speak of; fewer are all neighbours."""


class TrackNeighbours:
    """Neighbours among the tracks of one frame.

    Args:
        seen: features of the first camera.
        ids: of the tracks that count; between others nothing is kept apart.
    """

    def __init__(self, seen: FeatureObservations, ids: IntArray) -> None:
        rows = np.flatnonzero(np.isin(seen.ids, ids))
        rows = rows[np.argsort(seen.ids[rows])]
        self._ids = seen.ids[rows]
        self._edges = _edges(seen.pixels[rows])

    def connected(self, ids: IntArray, start: IntArray) -> BoolArray:
        """Which tracks (N,) are connected with some others by tracks of both sets only.

        Args:
            ids: of the tracks.
            start: ids of the others; those that are among `ids` are connected with themselves.
        """
        chosen = np.isin(self._ids, np.union1d(ids, start))
        edges = self._edges[:, chosen[self._edges].all(axis=0)]
        count = len(self._ids)
        graph = coo_array((np.ones(edges.shape[1]), edges), (count, count))
        part = connected_components(graph, directed=False)[1]
        reached = np.isin(part, part[chosen & np.isin(self._ids, start)]) & chosen
        return np.isin(ids, self._ids[reached])


def _edges(pixels: np.ndarray) -> IntArray:
    """Edges (2, E) of the Delaunay triangulation of points (N, 2); all pairs if there is none."""
    count = len(pixels)
    if count >= _LEAST:
        try:
            corners = Delaunay(pixels).simplices.T
        except QhullError:  # all points on a line
            pass
        else:
            return np.hstack([corners[[0, 1]], corners[[1, 2]], corners[[2, 0]]]).astype(np.int64)
    return np.array(np.triu_indices(count, 1), np.int64)
