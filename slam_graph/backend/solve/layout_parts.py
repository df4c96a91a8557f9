# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The variables of a layout by their kinds: features, which are in arrays, and all others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice

import numpy as np
from gtsam.symbol_shorthand import L

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.solve.square_root import Layout

LETTER_SHIFT = 56  # GTSAM's symbols: the letter is in the highest of eight bytes
FIRST_POINT = L(0)
_POINT_CODE = ord("l")
_POINT_COLUMNS = np.arange(3)


@dataclass(frozen=True, slots=True, eq=False)
class LayoutParts:
    """A layout, with the features apart.

    Attributes:
        keys: of all variables but features, K of them.
        slices: of each of these in a vector of them alone.
        of_others: (k,) columns of these.
        features: ids (J,) of the features.
        of_points: (J, 3) columns of these.
    """

    keys: list[int]
    slices: list[slice]
    of_others: IntArray
    features: IntArray
    of_points: IntArray

    @staticmethod
    @lru_cache(maxsize=8)
    def of(layout: Layout) -> LayoutParts:
        """The parts of a layout: one is asked for several times in a step."""
        if layout.begin is not None:
            return LayoutParts.of(layout.begin)._extended(layout)
        keys = np.fromiter(layout.dims, np.int64, len(layout.dims))
        dims = np.fromiter(layout.dims.values(), np.int64, len(keys))
        points = keys >> LETTER_SHIFT == _POINT_CODE
        rest = ~points
        columns = (dims.cumsum() - dims)[points][:, None] + _POINT_COLUMNS
        ends = dims[rest].cumsum().tolist()
        slices = list(map(slice, [0, *ends[:-1]], ends))
        of_others = rest.repeat(dims).nonzero()[0]
        return LayoutParts(
            keys[rest].tolist(), slices, of_others, keys[points] - FIRST_POINT, columns
        )

    def _extended(self, layout: Layout) -> LayoutParts:
        """The parts of a layout that begins with the one of these and has a few variables more."""
        keys, slices = self.keys.copy(), self.slices.copy()
        of_others: list[int] = []
        features, starts = [], []
        begin, end = len(self.of_others) + self.of_points.size, len(self.of_others)
        for key, dim in islice(layout.dims.items(), len(keys) + len(self.features), None):
            if key >> LETTER_SHIFT == _POINT_CODE:
                features.append(key)
                starts.append(begin)
            else:
                keys.append(key)
                slices.append(slice(end, end := end + dim))
                of_others += range(begin, begin + dim)
            begin += dim
        ids, points = self.features, self.of_points
        if features:
            ids = np.concatenate([ids, np.array(features, np.int64) - FIRST_POINT])
            points = np.concatenate([points, np.array(starts)[:, None] + _POINT_COLUMNS])
        columns = np.concatenate([self.of_others, np.array(of_others, np.int64)])
        return LayoutParts(keys, slices, columns, ids, points)

    def stacked(self, tangents: dict[int, FloatArray]) -> FloatArray:
        """The tangents (k,) of all variables but features, by their keys, in one vector."""
        parts = [tangents[key] for key in self.keys]
        return np.concatenate(parts) if parts else np.zeros(0)


def told_apart(keys: Iterable[int]) -> tuple[list[int], IntArray]:
    """Keys of all variables but features, and ids (J,) of the features."""
    chosen = np.array(keys if isinstance(keys, list) else list(keys), np.int64)
    points = chosen >> LETTER_SHIFT == _POINT_CODE
    return chosen[~points].tolist(), chosen[points] - FIRST_POINT
