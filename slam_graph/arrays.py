# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Array types of all modules, tables that grow, sets of ids, cross products, and medians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from zlib import compress, decompress

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
_FASTEST = 1
"""Level of compression."""


class GrowingTable:
    """Rows of the same width, which are added one by one, in blocks that never move.

    One array that grows moves to a larger place again and again. Between what else is allocated
    meanwhile it leaves holes of its size, which stay in the memory of the process. All blocks but
    the last are compressed, column by column: times and counts to 10 % of their size and less,
    measurements, whose last digits are noise, to 80 %.

    Args:
        width: numbers in a row.
        dtype: their type.
    """

    def __init__(self, width: int, dtype: DTypeLike = np.float64) -> None:
        self._last = np.zeros((_ROWS_PER_BLOCK, width), dtype)
        self._full: list[bytes] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, row: ArrayLike) -> None:
        """Add a row (width,)."""
        self._last[self._begin_block()] = row
        self._count += 1

    def extend(self, rows: NDArray[Any]) -> None:
        """Add rows (N, width)."""
        begin = 0
        while begin < len(rows):
            place = self._begin_block()
            part = rows[begin : begin + _ROWS_PER_BLOCK - place]
            self._last[place : place + len(part)] = part
            self._count += len(part)
            begin += len(part)

    def cut(self, count: int) -> None:
        """Keep the first `count` rows."""
        self._count = min(count, self._count)
        full = max(self._count - 1, 0) // _ROWS_PER_BLOCK
        if full < len(self._full):
            self._last = self._unpacked(self._full[full])
            del self._full[full:]

    def fill(self, first: int, columns: Sequence[int], value: float) -> None:
        """Put a value into some columns, from a row on."""
        for number in range(first // _ROWS_PER_BLOCK, len(self._full)):
            block = self._unpacked(self._full[number])
            block[max(first - number * _ROWS_PER_BLOCK, 0) :, columns] = value
            self._full[number] = _packed(block)
        self._last[max(first - len(self._full) * _ROWS_PER_BLOCK, 0) :, columns] = value

    def rows(self) -> NDArray[Any]:
        """(N, width) all rows, in an array of their own."""
        rows = np.empty((self._count, self._last.shape[1]), self._last.dtype)
        begin = 0
        for packed in self._full:
            rows[begin : begin + _ROWS_PER_BLOCK] = self._unpacked(packed)
            begin += _ROWS_PER_BLOCK
        rows[begin:] = self._last[: self._count - begin]
        return rows

    def _begin_block(self) -> int:
        """Where the next row goes in the last block; where that is full, it begins anew."""
        if self._count // _ROWS_PER_BLOCK > len(self._full):
            self._full.append(_packed(self._last))
        return self._count % _ROWS_PER_BLOCK

    def _unpacked(self, packed: bytes) -> NDArray[Any]:
        """A block (n, width) that was compressed."""
        dtype, width = self._last.dtype, self._last.shape[1]
        planes = np.frombuffer(decompress(packed), np.uint8)
        planes = planes.reshape(width, dtype.itemsize, _ROWS_PER_BLOCK)
        columns = np.ascontiguousarray(planes.transpose(0, 2, 1)).view(dtype)[:, :, 0]
        return np.array(columns.T, order="C")


def _packed(block: NDArray[Any]) -> bytes:
    """A block (n, width), compressed: of each column all first bytes, then all second ones."""
    rows, width = block.shape
    columns = np.ascontiguousarray(block.T).view(np.uint8)
    planes = columns.reshape(width, rows, block.dtype.itemsize).transpose(0, 2, 1)
    return compress(planes.tobytes(), _FASTEST)


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
