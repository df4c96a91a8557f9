# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Labels of the masks that the tracks of a frame are in."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.sensors import FeatureFrame


class TrackLabels:
    """Labels of the tracks of one frame, in the first camera.

    Args:
        frame: its features.

    Attributes:
        given: whether the frame has masks.
    """

    def __init__(self, frame: FeatureFrame) -> None:
        seen = frame.cameras[0]
        self.given = seen.labels is not None
        self._ids, self._labels = np.zeros((2, 0), np.int64)
        if seen.labels is not None:
            order = np.argsort(seen.ids)
            self._ids, self._labels = seen.ids[order], seen.labels[order]

    def of(self, ids: IntArray) -> IntArray:
        """Labels (N,) of tracks (N,); 0 for those in no mask, and for all without masks."""
        if len(self._ids) == 0:
            return np.zeros(len(ids), np.int64)
        place = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
        return np.where(self._ids[place] == ids, self._labels[place], 0)

    def allowed(self, ids: IntArray, label: int) -> IntArray:
        """The tracks that may be of an object: of its label, or all where there are no masks."""
        return ids[self.of(ids) == label] if self.given else ids

    def contradicted(self, ids: IntArray, label: int) -> IntArray:
        """The tracks of an object that are in the mask of another one."""
        found = self.of(ids)
        return ids[(found > 0) & (found != label)] if self.given else ids[:0]

    def present(self, ids: IntArray) -> list[int]:
        """The labels of some tracks, ascending, without 0."""
        return [label for label in np.unique(self.of(ids)).tolist() if label > 0]
