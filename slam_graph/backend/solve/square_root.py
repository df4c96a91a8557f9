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
from functools import cached_property
from itertools import accumulate, islice

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from slam_graph.arrays import FloatArray
from slam_graph.backend.solve.triangles import solved, transposed_inverse, upper_part
from slam_graph.kernels.elimination import eliminate_columns, zeros_to_the_left

_BLOCK_SIZE = 16
"""Width of the blocks of LAPACK's triangular-pentagonal QR."""
_FEW_KEYS = 8
"""Columns of so few variables are counted one by one."""


class Layout:
    """Where each variable stands in a stacked tangent vector.

    Attributes:
        dims: dimension of each key, in the order of the columns.
        size: length of the stacked vector.
        begin: the layout that this one begins with, if it was made of it.
    """

    def __init__(self, dims: Mapping[int, int], begin: Layout | None = None) -> None:
        self.dims = dict(dims)
        self.size = sum(self.dims.values())
        self.begin = begin
        self._indices: dict[tuple[int, ...], NDArray[np.intp]] = {}

    @cached_property
    def starts(self) -> dict[int, int]:
        """The first column of each key."""
        begin = self.begin
        known, size = ({}, 0) if begin is None else (begin.starts, begin.size)
        keys, dims = (
            islice(of_all, len(known), None) for of_all in (self.dims, self.dims.values())
        )
        return known | dict(zip(keys, accumulate(dims, initial=size), strict=False))

    @cached_property
    def columns(self) -> dict[int, slice]:
        """The slice of each key; most layouts are never asked for it."""
        return {key: slice(start, start + self.dims[key]) for key, start in self.starts.items()}

    def __contains__(self, key: int) -> bool:
        return key in self.dims

    def extended(self, dims: Mapping[int, int]) -> Layout:
        """The layout with further keys appended.

        Raises:
            ValueError: if it has one of them.
        """
        if not self.dims.keys().isdisjoint(dims):
            raise ValueError("a variable cannot be appended twice")
        return Layout({**self.dims, **dims}, self.begin or self)

    def begins_with(self, other: Layout) -> bool:
        """Whether the first variables are those of another layout, in the same order."""
        return list(islice(self.dims.items(), len(other.dims))) == list(other.dims.items())

    def indices(self, keys: Iterable[int]) -> NDArray[np.intp]:
        """Column numbers of the keys, in the order given; not to be changed."""
        chosen = tuple(keys)
        known = self._indices.get(chosen)  # every step asks for the same ones several times
        if known is None:
            known = self._indices[chosen] = self._columns_of(chosen)
        return known

    def _columns_of(self, chosen: tuple[int, ...]) -> NDArray[np.intp]:
        if len(chosen) <= _FEW_KEYS:  # arrays of them take longer
            columns: list[int] = []
            for key in chosen:
                columns += range(start := self.starts[key], start + self.dims[key])
            return np.array(columns, np.intp)
        starts = np.array(list(map(self.starts.__getitem__, chosen)), np.intp)
        sizes = np.array(list(map(self.dims.__getitem__, chosen)), np.intp)
        ends = sizes.cumsum()
        shifts = (starts - (ends - sizes)).repeat(sizes)
        return np.asarray(np.arange(len(shifts)) + shifts, dtype=np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class Conditional:
    """What some variables are given others: the cost ‖R δ_gone + S δ_given - d‖².

    Attributes:
        gone: columns of the variables that it determines, `w` in all.
        given: columns of the others.
        rows: (w, w + n + 1) [R S d], R upper triangular.
    """

    gone: Layout
    given: Layout
    rows: FloatArray

    @staticmethod
    def nothing() -> Conditional:
        """Of no variables."""
        return Conditional(Layout({}), Layout({}), np.zeros((0, 1)))

    @property
    def layouts(self) -> tuple[Layout, Layout]:
        """`gone` and `given`."""
        return self.gone, self.given

    @property
    def keys(self) -> list[int]:
        """Keys of all variables, in the order of the columns."""
        return [*self.gone.dims, *self.given.dims]

    def solution(self, given: FloatArray) -> FloatArray:
        """The δ_gone (w,) of least cost where the others are at `given` (n,).

        Raises:
            numpy.linalg.LinAlgError: if some direction is not determined.
        """
        w = self.gone.size
        return solved(self.rows[:, :w], self.rows[:, -1] - self.rows[:, w:-1] @ given)

    def shifted(self, delta: FloatArray) -> Conditional:
        """The same as a function of δ - delta, delta (w + n,) over `gone` and `given`."""
        rows = self.rows.copy()
        rows[:, -1] -= self.rows[:, :-1] @ delta
        return Conditional(self.gone, self.given, rows)


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
        return self.over(self.layout.extended(dims)) if dims else self

    def over(self, layout: Layout, copy: bool = False) -> SquareRootInformation:
        """The same Gaussian over a layout that begins with its own: of the rest nothing is known.

        Args:
            layout: of all variables.
            copy: whether it is to have memory of its own in any case.

        Raises:
            ValueError: if the layout has other variables first.
        """
        if layout is self.layout and not copy:
            return self
        if layout is not self.layout and not layout.begins_with(self.layout):
            raise ValueError("the layout has other variables first")
        n, m = self.layout.size, layout.size
        Rd = np.empty((m + 1, m + 1), order="F")  # to fill all of it with zeros takes as long again
        Rd[:n, :n], Rd[:n, n:m], Rd[n:] = self.R, 0.0, 0.0
        Rd[:n, m] = self.d
        Rd[m, m] = self.Rd[n, n]
        return SquareRootInformation(layout, Rd)

    def shifted(self, delta: FloatArray, overwrite: bool = False) -> SquareRootInformation:
        """The same cost as a function of δ - delta: ‖R (δ + delta) - d‖².

        Args:
            delta: (n,).
            overwrite: whether this Gaussian, which nobody needs any more, may be changed.
        """
        Rd = self.Rd if overwrite else self.Rd.copy(order="F")
        Rd[:-1, -1] -= self.R @ delta
        return SquareRootInformation(self.layout, Rd)

    def updated(
        self, Ab: FloatArray, overwrite: bool = False, overwrite_rows: bool = False
    ) -> SquareRootInformation:
        """Fold in measurement rows.

        Where row i begins i columns behind the first one or later, the zeros are left out.

        Args:
            Ab: (m, n + 1) rows [A b] of the cost ‖A δ - b‖².
            overwrite: whether this Gaussian, which nobody needs any more, may be changed: copies
                of large matrices take a good part of the time.
            overwrite_rows: the same of the rows.
        """
        if len(Ab) == 0:
            return self
        rows = np.asfortranarray(Ab) if overwrite_rows else Ab.copy(order="F")
        first, staggered = zeros_to_the_left(rows)  # columns to the left are not touched
        if first == rows.shape[1]:
            return self
        rows = rows[:, first:]
        if len(rows) > 2 * rows.shape[1]:
            rows, staggered = triangularize(rows), True
        in_place = overwrite and first == 0
        triangle = self.Rd if in_place else self.Rd[first:, first:].copy(order="F")
        block, depth = min(_BLOCK_SIZE, len(triangle)), len(rows) if staggered else 0
        # in the copies themselves: new memory costs as much as the arithmetic
        triangle, _, _, info = lapack.dtpqrt(
            depth, block, triangle, rows, overwrite_a=True, overwrite_b=True
        )
        if info != 0:
            raise ValueError(f"LAPACK's tpqrt rejected argument {-info}")
        if first == 0:
            return SquareRootInformation(self.layout, triangle)
        Rd = self.Rd if overwrite else self.Rd.copy(order="F")
        Rd[first:, first:] = triangle
        return SquareRootInformation(self.layout, Rd)

    def with_noise(self, noise: FloatArray) -> SquareRootInformation:
        """The Gaussian after independent noise was added to its leading variables, x₁' = x₁ + w.

        The rows [R₁₁ R₁₂ d₁] are the conditional of x₁ given all others, x₂. The noise adds to its
        covariance and changes neither its mean, as a function of x₂, nor the marginal over x₂. So
        they become U⁻¹ R₁₁⁻¹ [R₁₁ R₁₂ d₁] with U Uᵀ = R₁₁⁻¹ R₁₁⁻ᵀ + Q, and the other rows stay:
        the cost is that of the leading block alone.

        Args:
            noise: (J, b, b) covariances Q of the noise of J variables of b columns, the first ones.

        Raises:
            numpy.linalg.LinAlgError: if the leading variables are not determined given the others.
        """
        count, b = noise.shape[:2]
        w = count * b
        if w == 0:
            return self
        inverse = transposed_inverse(self.R[:w, :w])  # R₁₁⁻ᵀ
        covariance = blas.dsyrk(1.0, inverse, trans=1, lower=1)
        blocks = np.arange(w).reshape(count, b)
        covariance[blocks[:, :, None], blocks[:, None, :]] += noise
        # Cholesky's factor from the last column on, Uᵀ
        root, info = lapack.dpotrf(np.asfortranarray(covariance[::-1, ::-1]), clean=1)
        if info != 0:
            raise np.linalg.LinAlgError("the leading variables are not determined")
        root, _ = lapack.dtrtri(np.asfortranarray(root[::-1, ::-1]), lower=1)  # U⁻ᵀ
        Rd = self.Rd.copy(order="F")
        Rd[:w, :w] = root.T
        turned = blas.dtrmm(1.0, inverse, root, lower=1)  # (U⁻¹ R₁₁⁻¹)ᵀ
        Rd[:w, w:] = blas.dtrmm(1.0, turned, self.Rd[:w, w:], lower=1, trans_a=1)
        return SquareRootInformation(self.layout, Rd)

    def solution(self) -> FloatArray:
        """The δ (n,) of least cost.

        Raises:
            numpy.linalg.LinAlgError: if some direction is not determined.
        """
        # with the last row, which LAPACK does not read: `R` alone is no block of memory, so a copy
        return solved(self.Rd[:, :-1], self.Rd[:, -1])[:-1]

    def covariance(self) -> FloatArray:
        """The (n, n) covariance R⁻¹ R⁻ᵀ."""
        inverse = self.root_covariance()
        return np.asarray(inverse @ inverse.T, dtype=np.float64)

    def covariance_of(self, keys: Sequence[int]) -> FloatArray:
        """The covariance of some variables only, in the order given."""
        root = self.columns_of_root(keys)
        return np.asarray(root.T @ root, dtype=np.float64)

    def columns_of_root(self, keys: Sequence[int]) -> FloatArray:
        """A root (m, k) of the covariance of some variables: columns of R⁻ᵀ, without zero rows."""
        columns = self.layout.indices(keys)
        first = int(columns.min(initial=self.layout.size))
        size = self.layout.size - first
        if 3 * len(columns) > size:  # the inverse of all is cheaper: it leaves zeros out
            return self.root_from(first)[:, columns - first]
        right = np.zeros((size, len(columns)), order="F")
        right[columns - first, np.arange(len(columns))] = 1.0
        root, info = lapack.dtrtrs(self.R[first:, first:], right, trans=1)
        if info != 0:
            raise np.linalg.LinAlgError("the information is singular")
        return np.asarray(root, dtype=np.float64)

    def root_from(self, first: int) -> FloatArray:
        """A root (m, m) of the covariance of all columns from one on, R⁻ᵀ of these."""
        return transposed_inverse(self.R[first:, first:])

    def root_covariance(self) -> FloatArray:
        """The (n, n) upper triangular R⁻¹, a root of the covariance."""
        return transposed_inverse(self.R).T

    def marginal(self, keep: Sequence[int]) -> SquareRootInformation:
        """The Gaussian over the variables `keep`, in that order, with all others eliminated."""
        return self.divided(keep)[1]

    def divided(self, keep: Sequence[int]) -> tuple[Conditional, SquareRootInformation]:
        """The conditional of all variables but `keep` given these, and the marginal over `keep`.

        Variables whose order changes go through one QR. The rows of the variables before them are
        rotated with the rows of the eliminated variables, from the bottom up. That costs O(n²) in
        the number n of rows, where a QR of all of them would cost O(n³).
        """
        staying = set(keep)
        gone = Layout({k: d for k, d in self.layout.dims.items() if k not in staying})
        kept = Layout({k: self.layout.dims[k] for k in keep})
        Rd = np.zeros((kept.size + 1, kept.size + 1), order="F")
        end = np.array([self.layout.size], np.intp)
        order = np.concatenate([self.layout.indices([*gone.dims, *keep]), end])
        lead, w = self._unmoved(keep), gone.size
        lead_gone = int(np.searchsorted(order[:w], lead))
        top = lead - lead_gone  # the rows of the marginal that come from the leading ones
        tail = np.concatenate([np.arange(lead_gone, w), np.arange(w + top, len(order))])
        triangle = triangularize(self.Rd[lead:, order[tail]])
        Rd[top:, top:] = triangle[w - lead_gone :, w - lead_gone :]
        carried = np.zeros((w, len(order)))
        carried[lead_gone:, tail] = triangle[: w - lead_gone]
        eliminate_columns(self.Rd[:lead], order, carried, Rd[:top])
        return Conditional(gone, kept, carried), SquareRootInformation(kept, Rd)

    def _unmoved(self, keep: Sequence[int]) -> int:
        """How many leading columns are of variables that leave, or stay in their order."""
        staying, place, columns = set(keep), 0, 0
        for mine, dim in self.layout.dims.items():
            if mine in staying:
                if keep[place] != mine:
                    break
                place += 1
            columns += dim
        return columns


def triangularize(Ab: FloatArray) -> FloatArray:
    """The upper triangular factor of a QR decomposition of (m, n) rows, always (n, n)."""
    n = Ab.shape[1]
    rows = trapezoidal(Ab)
    if len(rows) == n:
        return rows
    triangle = np.zeros((n, n), order="F")
    triangle[: len(rows)] = rows
    return triangle


def trapezoidal(Ab: FloatArray) -> FloatArray:
    """The upper factor of a QR decomposition of (m, n) rows, (min(m, n), n)."""
    if not len(Ab):
        return Ab
    qr, _, _, info = lapack.dgeqrf(np.asfortranarray(Ab))
    if info != 0:
        raise ValueError(f"LAPACK's geqrf rejected argument {-info}")
    return upper_part(qr[: Ab.shape[1]])
