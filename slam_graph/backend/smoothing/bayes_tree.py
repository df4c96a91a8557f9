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
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.solve.state import dim


@dataclass(frozen=True, slots=True, eq=False)
class Clique:
    """A clique of a Bayes tree.

    Attributes:
        columns: of each variable in [R S], the frontal variables first.
        frontals: the frontal variables.
        R: (f, f) upper triangular.
        S: (f, s).
        parent: number of the parent among the cliques; -1 at a root.
        shared: (s,) columns of the separator in the parent.
    """

    columns: dict[int, slice]
    frontals: list[int]
    R: FloatArray
    S: FloatArray
    parent: int
    shared: IntArray


def cliques_of(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, wanted: Container[int]
) -> list[Clique]:
    """The cliques of the Bayes tree of a linear problem, parents before children.

    Args:
        graph: the whitened linear problem; it must determine all variables.
        ordering: of the elimination.
        wanted: variables of interest. Leaves without one are left out.
    """
    tree = graph.eliminateMultifrontal(ordering)
    waiting = [(root, -1) for root in tree.roots()]
    cliques: list[Clique] = []
    while waiting:
        clique, parent = waiting.pop()
        conditional, children = clique.conditional(), clique.nrChildren()
        keys, R = list(conditional.keys()), np.array(conditional.R())  # copies: the tree owns it
        ends = np.cumsum([dim(key) for key in keys]).tolist()
        frontals = keys[: ends.index(len(R)) + 1]
        if children == 0 and not any(key in wanted for key in frontals):
            continue
        columns = {k: slice(a, b) for k, a, b in zip(keys, [0, *ends], ends, strict=False)}
        above = [cliques[parent].columns[key] for key in keys[len(frontals) :]]
        shared = np.array([i for c in above for i in range(c.start, c.stop)], np.int64)
        S = np.array(conditional.S()).reshape(len(R), len(shared))
        cliques.append(Clique(columns, frontals, R, S, parent, shared))
        waiting += [(clique[i], len(cliques) - 1) for i in range(children)]
    return cliques


def joint_covariances(cliques: list[Clique]) -> Iterator[tuple[Clique, FloatArray]]:
    """Each clique with the joint covariance of all its variables, in the order of its columns.

    Square roots are passed on from parent to child. Differences of variables may be known far
    better than the variables themselves, and would be lost in the rounding of covariances.

    Args:
        cliques: parents before children.
    """
    children = np.bincount([c.parent for c in cliques if c.parent >= 0], minlength=len(cliques))
    roots: dict[int, FloatArray] = {}
    for number, clique in enumerate(cliques):
        f, s = clique.S.shape
        root = np.zeros((f + s, f + s))
        root[:f, :f] = solve_triangular(clique.R, np.eye(f))
        if s:
            rows = roots[clique.parent][clique.shared]
            separator = np.asarray(np.linalg.qr(rows.T, mode="r")).T
            root[:f, f:] = -root[:f, :f] @ clique.S @ separator
            root[f:, f:] = separator
            children[clique.parent] -= 1
            if children[clique.parent] == 0:
                del roots[clique.parent]
        if children[number]:
            roots[number] = root
        yield clique, root @ root.T


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
                w[clique.columns[key]] += right[key]
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
        found |= {key: y[clique.columns[key]] for key in clique.frontals}
    return found
