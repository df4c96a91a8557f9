# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Array types of all modules, tables that grow, sets of ids, cross products, and medians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

__all__ = [
    "BoolArray",
    "FloatArray",
    "GrowingTable",
    "IntArray",
    "ascending_union",
    "median",
    "skew",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_ROWS_PER_BLOCK = 1024


class GrowingTable:
    """Rows of the same width, which are added one by one, in blocks that never move.

    One array that grows moves to a larger place again and again. Between what else is allocated
    meanwhile it leaves holes of its size, which stay in the memory of the process.

    Args:
        width: numbers in a row.
        dtype: their type.
    """

    def __init__(self, width: int, dtype: DTypeLike = np.float64) -> None:
        self._width, self._dtype = width, np.dtype(dtype)
        self._blocks: list[NDArray[Any]] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, row: ArrayLike) -> None:
        """Add a row (width,)."""
        place = self._count % _ROWS_PER_BLOCK
        if place == 0:
            self._blocks.append(np.zeros((_ROWS_PER_BLOCK, self._width), self._dtype))
        self._blocks[-1][place] = row
        self._count += 1

    def extend(self, rows: NDArray[Any]) -> None:
        """Add rows (N, width)."""
        for row in rows:
            self.append(row)

    def cut(self, count: int) -> None:
        """Keep the first `count` rows."""
        self._count = min(count, self._count)
        del self._blocks[-(-self._count // _ROWS_PER_BLOCK) :]

    def fill(self, first: int, columns: Sequence[int], value: float) -> None:
        """Put a value into some columns, from a row on."""
        for number, block in enumerate(self._blocks):
            block[max(first - number * _ROWS_PER_BLOCK, 0) :, columns] = value

    def rows(self) -> NDArray[Any]:
        """(N, width) all rows, in an array of their own."""
        if not self._blocks:
            return np.empty((0, self._width), self._dtype)
        return np.concatenate(self._blocks)[: self._count]


def ascending_union(*parts: IntArray) -> IntArray:
    """The distinct values of some arrays, ascending; NumPy's functions take twice as long."""
    some = [part for part in parts if len(part)]
    if not some:
        return np.zeros(0, np.int64)
    values = np.concatenate(some)
    values.sort()
    first = np.empty(len(values), np.bool_)
    first[0] = True
    np.not_equal(values[1:], values[:-1], out=first[1:])
    return values[first]


def skew(v: FloatArray) -> FloatArray:
    """[v]ₓ (..., 3, 3) of vectors v (..., 3), so that [v]ₓ u = v × u."""
    matrix = np.zeros((*v.shape, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = x, y, z
    matrix[..., 1, 2], matrix[..., 2, 0], matrix[..., 0, 1] = -x, -y, -z
    return matrix


def median(values: NDArray[Any]) -> FloatArray:
    """The median along the first axis of an array; NumPy's takes many times as long."""
    ascending, count = values.copy(), len(values)
    ascending.sort(axis=0)
    return np.asarray(0.5 * (ascending[(count - 1) // 2] + ascending[count // 2]))
