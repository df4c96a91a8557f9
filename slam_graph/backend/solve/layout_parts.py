# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The variables of a layout by their kinds: features, which are in arrays, and all others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

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

    def stacked(self, tangents: dict[int, FloatArray]) -> FloatArray:
        """The tangents (k,) of all variables but features, by their keys, in one vector."""
        parts = [tangents[key] for key in self.keys]
        return np.concatenate(parts) if parts else np.zeros(0)


def told_apart(keys: Iterable[int]) -> tuple[list[int], IntArray]:
    """Keys of all variables but features, and ids (J,) of the features."""
    chosen = np.array(keys if isinstance(keys, list) else list(keys), np.int64)
    points = chosen >> LETTER_SHIFT == _POINT_CODE
    return chosen[~points].tolist(), chosen[points] - FIRST_POINT
