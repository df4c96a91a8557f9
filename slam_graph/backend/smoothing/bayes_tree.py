# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances and solutions of a large sparse Gaussian, from GTSAM's Bayes tree.

Elimination turns ‖A δ - b‖² into cliques ‖R δ_F + S δ_S - d‖² of frontal variables F, given
separator variables S that are all in the parent of the clique (Dellaert & Kaess 2017, ch. 5). So
the joint covariance of a clique follows from that of its parent,

    P_FS = -R⁻¹ S P_SS,   P_FF = R⁻¹ R⁻ᵀ + R⁻¹ S P_SS Sᵀ R⁻ᵀ.

This is the recursion of Takahashi, Fagan & Chen (1973) by blocks. It gives the covariances of all
variables that share a clique in about the time of the elimination, without a matrix of the whole
problem. GTSAM's `Marginals` starts anew for each question.

Differences of variables may be known far better than the variables themselves, and would be lost in
the rounding of covariances. So it is their upper triangular roots U, P = U Uᵀ, that are passed on
from parent to child:

    U_FF = R⁻¹,   U_FS = -R⁻¹ S U_SS.

The rows of the separator in the root of the parent are U_SS but for the columns of the variables
that the child does not have, few of them; these are folded into the others by QR.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import lapack, solve_triangular

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.solve.square_root import Layout
from slam_graph.backend.solve.state import dims_of

_BLOCK_SIZE = 32
"""Width of the blocks of LAPACK's triangular-pentagonal QR."""


@dataclass(frozen=True, slots=True, eq=False)
class Clique:
    """A clique of a Bayes tree.

    Attributes:
        layout: columns of [R S]: the frontal variables, then those of the separator in the order
            that they have in the parent.
        frontals: the frontal variables.
        R: (f, f) upper triangular.
        S: (f, s).
        parent: number of the parent among the cliques; -1 at a root.
        shared: (s,) columns of the separator in the parent, ascending.
    """

    layout: Layout
    frontals: list[int]
    R: FloatArray
    S: FloatArray
    parent: int
    shared: IntArray


def cliques_of(tree: gtsam.GaussianBayesTree, wanted: Container[int]) -> list[Clique]:
    """The cliques of the Bayes tree of a linear problem, parents before children.

    Args:
        tree: of a problem that determines all variables.
        wanted: variables of interest. Leaves without one are left out.
    """
    waiting = [(root, -1) for root in tree.roots()]
    cliques: list[Clique] = []
    while waiting:
        clique, parent = waiting.pop()
        conditional, children = clique.conditional(), clique.nrChildren()
        keys, R = list(conditional.keys()), np.array(conditional.R())  # copies: the tree owns it
        given = Layout(dims_of(keys))
        count = next(n for n, key in enumerate(keys, 1) if given.columns[key].stop == len(R))
        frontals, separator = keys[:count], keys[count:]
        if children == 0 and not any(key in wanted for key in frontals):
            continue
        above = Layout({}) if parent < 0 else cliques[parent].layout
        separator = sorted(separator, key=list(above.dims).index)
        S = np.array(conditional.S()).reshape(len(R), -1)
        S = S[:, given.indices(separator) - len(R)]
        layout = Layout(dims_of([*frontals, *separator]))
        cliques.append(Clique(layout, frontals, R, S, parent, above.indices(separator)))
        waiting += [(clique[i], len(cliques) - 1) for i in range(children)]
    return cliques


def joint_root_covariances(cliques: list[Clique]) -> Iterator[tuple[Clique, FloatArray]]:
    """Each clique with a root U (n, n) of the joint covariance U Uᵀ of all its variables.

    Args:
        cliques: parents before children.
    """
    children = np.bincount([c.parent for c in cliques if c.parent >= 0], minlength=len(cliques))
    roots: dict[int, FloatArray] = {}
    for number, clique in enumerate(cliques):
        f, s = clique.S.shape
        root = np.zeros((f + s, f + s))
        root[:f, :f] = _inverse(clique.R)
        if s:
            separator = _rows_of_root(roots[clique.parent], clique.shared)
            root[:f, f:] = -root[:f, :f] @ clique.S @ separator
            root[f:, f:] = separator
            children[clique.parent] -= 1
            if children[clique.parent] == 0:
                del roots[clique.parent]
        if children[number]:
            roots[number] = root
        yield clique, root


def _inverse(R: FloatArray) -> FloatArray:
    """R⁻¹ of an upper triangular R."""
    inverse, info = lapack.dtrtri(R)
    if info != 0:
        raise np.linalg.LinAlgError("the cost does not determine all of its variables")
    return np.triu(inverse)


def _rows_of_root(U: FloatArray, rows: IntArray) -> FloatArray:
    """The upper triangular root (s, s) of a part of the covariance U Uᵀ.

    Args:
        U: (n, n) upper triangular.
        rows: (s,) of the part, ascending.
    """
    others = np.ones(len(U), np.bool_)
    others[rows] = False
    part = U[rows]
    # LAPACK folds rows into an upper triangle; U_SSᵀ is a lower one, but upside down an upper one
    triangle = np.asfortranarray(part[:, rows].T[::-1, ::-1])
    beside = np.asfortranarray(part[:, others].T[:, ::-1])
    if len(beside):
        triangle, _, _, info = lapack.dtpqrt(0, min(_BLOCK_SIZE, len(rows)), triangle, beside)
        if info != 0:
            raise ValueError(f"LAPACK's tpqrt rejected argument {-info}")
    return np.ascontiguousarray(triangle[::-1, ::-1].T)


def solved(cliques: list[Clique], right: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
    """The solution x of (Aᵀ A) x = w.

    Args:
        cliques: parents before children. Those that were left out must have no part in w.
        right: w (n, m) of some of the variables; of the others it is zero.

    Returns:
        x (n, m) of each variable that is frontal in a clique.
    """
    width = next(iter(right.values())).shape[1]
    sums = [np.zeros((sum(clique.S.shape), width)) for clique in cliques]
    for number in range(len(cliques) - 1, -1, -1):  # Rᵀ y = w, children before parents
        clique, w = cliques[number], sums[number]
        f = len(clique.R)
        for key in clique.frontals:
            if key in right:
                w[clique.layout.columns[key]] += right[key]
        w[:f] = solve_triangular(clique.R, w[:f], trans="T")
        if clique.parent >= 0:
            w[f:] -= clique.S.T @ w[:f]
            sums[clique.parent][clique.shared] += w[f:]
    found: dict[int, FloatArray] = {}
    for clique, y in zip(cliques, sums, strict=True):  # R x = y, parents before children
        f = len(clique.R)
        if clique.parent >= 0:
            y[f:] = sums[clique.parent][clique.shared]
        y[:f] = solve_triangular(clique.R, y[:f] - clique.S @ y[f:])
        found |= {key: y[clique.layout.columns[key]] for key in clique.frontals}
    return found
