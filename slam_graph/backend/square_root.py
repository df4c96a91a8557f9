# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Gaussians in square-root information form, updated and reduced by QR.

A Gaussian over a stacked vector δ is kept as the upper triangular R and the vector d of the
least-squares cost ‖R δ - d‖². New measurement rows ‖A δ - b‖² are folded in by a triangular QR,
and variables are marginalised out by a QR whose columns begin with them: the rows that no longer
touch them are the marginal over the others (Kaess et al. 2008; Dellaert & Kaess 2017, ch. 3).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

FloatArray = NDArray[np.float64]

BLOCK_SIZE = 32
"""Width of the blocks of LAPACK's triangular-pentagonal QR."""
ROWS_AT_ONCE = 48
"""Height of the blocks from which variables are eliminated that stand behind them."""


class Layout:
    """Where each variable stands in a stacked tangent vector.

    Attributes:
        dims: dimension of each key, in the order of the columns.
        columns: the slice of each key.
        size: length of the stacked vector.
    """

    def __init__(self, dims: Mapping[int, int]) -> None:
        self.dims = dict(dims)
        self.columns: dict[int, slice] = {}
        self.size = 0
        for key, dim in self.dims.items():
            self.columns[key] = slice(self.size, self.size + dim)
            self.size += dim

    def __contains__(self, key: int) -> bool:
        return key in self.dims

    def extended(self, dims: Mapping[int, int]) -> Layout:
        """The layout with further keys appended."""
        return Layout({**self.dims, **dims})

    def indices(self, keys: Iterable[int]) -> NDArray[np.intp]:
        """Column numbers of the keys, in the order given."""
        parts = [np.arange(self.columns[k].start, self.columns[k].stop) for k in keys]
        return np.concatenate(parts) if parts else np.zeros(0, np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class SquareRootInformation:
    """The Gaussian ‖R δ - d‖² over the variables of a layout.

    Attributes:
        layout: columns of the variables, `n` in all.
        Rd: (n + 1, n + 1) upper triangular: R with d as its last column; the corner is the root of
            the part of the cost that no δ can remove.
    """

    layout: Layout
    Rd: FloatArray

    @staticmethod
    def empty() -> SquareRootInformation:
        """A Gaussian over nothing."""
        return SquareRootInformation(Layout({}), np.zeros((1, 1), order="F"))

    @property
    def R(self) -> FloatArray:
        """(n, n) upper triangular root of the information."""
        return self.Rd[:-1, :-1]

    @property
    def d(self) -> FloatArray:
        """(n,) right-hand side."""
        return self.Rd[:-1, -1]

    @property
    def residual(self) -> float:
        """The part of the cost that no δ can remove."""
        return float(self.Rd[-1, -1] ** 2)

    def extended(self, dims: Mapping[int, int]) -> SquareRootInformation:
        """The same Gaussian with further variables of which nothing is known."""
        if not dims:
            return self
        layout = self.layout.extended(dims)
        n, m = self.layout.size, layout.size
        Rd = np.zeros((m + 1, m + 1), order="F")
        Rd[:n, :n] = self.R
        Rd[:n, m] = self.d
        Rd[m, m] = self.Rd[n, n]
        return SquareRootInformation(layout, Rd)

    def shifted(self, delta: FloatArray) -> SquareRootInformation:
        """The same cost as a function of δ - delta: ‖R (δ + delta) - d‖²."""
        Rd = self.Rd.copy(order="F")
        Rd[:-1, -1] -= self.R @ delta
        return SquareRootInformation(self.layout, Rd)

    def updated(self, Ab: FloatArray) -> SquareRootInformation:
        """Fold in measurement rows.

        Args:
            Ab: (m, n + 1) rows [A b] of the cost ‖A δ - b‖².
        """
        if len(Ab) == 0:
            return self
        first = int(np.argmax(Ab.any(axis=0)))  # columns to the left are not touched
        Ab = Ab[:, first:]
        if len(Ab) > 2 * Ab.shape[1]:
            Ab = triangularize(Ab)
        triangle = np.asfortranarray(self.Rd[first:, first:])
        block = min(BLOCK_SIZE, len(triangle))
        triangle, _, _, info = lapack.dtpqrt(0, block, triangle, np.asfortranarray(Ab))
        if info != 0:
            raise ValueError(f"LAPACK's tpqrt rejected argument {-info}")
        Rd = self.Rd.copy(order="F")
        Rd[first:, first:] = triangle
        return SquareRootInformation(self.layout, Rd)

    def solution(self) -> FloatArray:
        """The δ (n,) of least cost.

        Raises:
            numpy.linalg.LinAlgError: if some direction is not determined.
        """
        x, info = lapack.dtrtrs(self.R, self.d)
        if info != 0 or not np.all(np.isfinite(x)):
            raise np.linalg.LinAlgError("the cost does not determine all of its variables")
        return np.asarray(x, dtype=np.float64)

    def covariance(self) -> FloatArray:
        """The (n, n) covariance R⁻¹ R⁻ᵀ."""
        inverse = self.root_covariance()
        return np.asarray(inverse @ inverse.T, dtype=np.float64)

    def covariance_of(self, keys: Sequence[int]) -> FloatArray:
        """The covariance of some variables only, in the order given."""
        columns = self.layout.indices(keys)
        first = int(columns.min(initial=self.layout.size))
        right = np.zeros((self.layout.size - first, len(columns)), order="F")
        right[columns - first, np.arange(len(columns))] = 1.0
        root, info = lapack.dtrtrs(self.R[first:, first:], right, trans=1)
        if info != 0:
            raise np.linalg.LinAlgError("the information is singular")
        return np.asarray(root.T @ root, dtype=np.float64)

    def root_covariance(self) -> FloatArray:
        """The (n, n) upper triangular R⁻¹, a root of the covariance."""
        inverse, info = lapack.dtrtri(self.R)
        if info != 0:
            raise np.linalg.LinAlgError("the information is singular")
        return np.asarray(np.triu(inverse), dtype=np.float64)

    def marginal(self, keep: Sequence[int]) -> SquareRootInformation:
        """The Gaussian over the variables `keep`, in that order, with all others eliminated."""
        staying = set(keep)
        gone = [k for k in self.layout.dims if k not in staying]
        layout = Layout({k: self.layout.dims[k] for k in keep})
        width = self.layout.size - layout.size
        first = self._unmoved(keep)
        order = self.layout.indices([*gone, *keep])
        order = np.append(np.concatenate([order[:width], order[width + first :]]), -1)
        tail = triangularize(self.Rd[first:, order])
        Rd = np.zeros((layout.size + 1, layout.size + 1), order="F")
        Rd[first:, first:] = tail[width:, width:]
        _eliminate_behind(Rd, self.Rd[:first], order[:width], order[width:], tail[:width])
        return SquareRootInformation(layout, Rd)

    def _unmoved(self, keep: Sequence[int]) -> int:
        """How many leading columns stay where they are."""
        columns = 0
        for mine, kept in zip(self.layout.dims, keep, strict=False):
            if mine != kept:
                break
            columns += self.layout.dims[mine]
        return columns


def _eliminate_behind(
    Rd: FloatArray,
    rows: FloatArray,
    gone: NDArray[np.intp],
    others: NDArray[np.intp],
    conditional: FloatArray,
) -> None:
    """Eliminate variables from the rows of others that stand before them.

    The rows that determine the eliminated variables are carried upwards, block by block: a rotation
    with each block takes the eliminated columns out of it, another restores its triangle. That
    costs O(n²) in the number n of rows, where a QR of all of them would cost O(n³).

    Args:
        Rd: gets the result in its first rows.
        rows: (n, …) the rows [R d] of the variables that stand before.
        gone: columns of the eliminated variables in `rows`.
        others: columns behind that stay, the right-hand side included.
        conditional: (w, w + …) triangular rows over the eliminated columns and the others.
    """
    n, w = len(rows), len(gone)
    if n == 0:
        return
    carried = np.hstack([conditional[:, :w], np.zeros((w, n)), conditional[:, w:]])
    for start in range((n - 1) // ROWS_AT_ONCE * ROWS_AT_ONCE, -1, -ROWS_AT_ONCE):
        stop = min(start + ROWS_AT_ONCE, n)
        block = rows[start:stop]
        stacked = np.vstack(
            [
                np.hstack([carried[:, :w], carried[:, w + start :]]),
                np.hstack([block[:, gone], block[:, start:n], block[:, others]]),
            ]
        )
        Q, R = np.linalg.qr(stacked[:, :w], mode="complete")
        stacked = Q.T @ stacked[:, w:]
        carried = np.hstack([R[:w], np.zeros((w, start)), stacked[:w]])
        Q, _ = np.linalg.qr(stacked[w:, : stop - start])
        Rd[start:stop, start:] = Q.T @ stacked[w:]
        Rd[start:stop, start:stop] = np.triu(Rd[start:stop, start:stop])


def triangularize(Ab: FloatArray) -> FloatArray:
    """The upper triangular factor of a QR decomposition of (m, n) rows, always (n, n)."""
    m, n = Ab.shape
    if m < n:
        Ab = np.vstack([Ab, np.zeros((n - m, n))])
    qr, _, _, info = lapack.dgeqrf(np.asfortranarray(Ab))
    if info != 0:
        raise ValueError(f"LAPACK's geqrf rejected argument {-info}")
    return np.asfortranarray(np.triu(qr[:n]))
