# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features as variables, in arrays: all of them are read and moved at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """The positions of J features in the world, in rows of ascending ids.

    Arrays are replaced and never changed, so that copies can share them.

    Attributes:
        ids: (J,).
        first: (J, 3) linearisation points.
        offsets: (J, 3) of the estimates from these.
        frozen: (J,) whether the linearisation point no longer moves.
    """

    ids: IntArray
    first: FloatArray
    offsets: FloatArray
    frozen: BoolArray

    @staticmethod
    def empty() -> PointTable:
        """No features."""
        none = np.zeros((0, 3))
        return PointTable(np.zeros(0, np.int64), none, none, np.zeros(0, np.bool_))

    @property
    def estimate(self) -> FloatArray:
        """(J, 3) current positions."""
        return self.first + self.offsets

    def rows(self, ids: IntArray) -> IntArray:
        """The rows (N,) of some features.

        Raises:
            KeyError: if one is not among the features.
        """
        if len(ids) == 0:
            return np.zeros(0, np.intp)
        rows = self.ids.searchsorted(ids)
        known = len(self.ids) > 0 and self.ids.take(rows, mode="clip") == ids
        if np.count_nonzero(known) < len(ids):
            raise KeyError(f"not all of the features {ids.tolist()} are variables")
        return rows

    def with_points(self, ids: IntArray, points: FloatArray) -> PointTable:
        """With more features, at positions (N, 3).

        Raises:
            KeyError: if one of them is a variable already.
        """
        if len(ids) == 0:
            return self
        all_ids = np.concatenate([self.ids, ids])
        order = np.argsort(all_ids)
        ascending = all_ids[order]
        if (ascending[1:] == ascending[:-1]).any():
            raise KeyError(f"some of the features {ids.tolist()} are variables already")
        none = np.zeros((len(ids), 3))
        return PointTable(
            ascending,
            np.concatenate([self.first, points])[order],
            np.concatenate([self.offsets, none])[order],
            np.concatenate([self.frozen, np.zeros(len(ids), np.bool_)])[order],
        )

    def without(self, ids: IntArray) -> PointTable:
        """Without some features."""
        if len(ids) == 0:
            return self
        stays = np.ones(len(self.ids), np.bool_)
        stays[self.rows(ids)] = False
        return PointTable(
            self.ids[stays], self.first[stays], self.offsets[stays], self.frozen[stays]
        )

    def moved(self, ids: IntArray, increments: FloatArray) -> PointTable:
        """With the estimates of some features moved by (N, 3); each is named once."""
        if len(ids) == 0:
            return self
        changed = self.offsets.copy()
        changed[self.rows(ids)] += increments
        return PointTable(self.ids, self.first, changed, self.frozen)

    def with_frozen(self, ids: IntArray) -> PointTable:
        """With the linearisation points of some features held where they are."""
        if len(ids) == 0:
            return self
        frozen = self.frozen.copy()
        frozen[self.rows(ids)] = True
        return PointTable(self.ids, self.first, self.offsets, frozen)

    def relinearized(self, frozen: BoolArray) -> PointTable:
        """With all linearisation points at the estimates, but those that are `frozen` (J,)."""
        if (frozen | ~self.offsets.any(axis=1)).all():
            return self if frozen is self.frozen else replace(self, frozen=frozen)
        held = frozen[:, None]
        first = np.where(held, self.first, self.estimate)
        return PointTable(self.ids, first, np.where(held, self.offsets, 0.0), frozen)

    def transformed(self, turn: FloatArray, move: FloatArray) -> PointTable:
        """The same features in a world that is turned (3, 3) and moved (3,)."""
        return replace(self, first=self.first @ turn.T + move, offsets=self.offsets @ turn.T)
