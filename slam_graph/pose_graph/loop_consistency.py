# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pairwise consistency of loop closures, from short cycles through the odometry between them.

Two loop closures (a, b) and (c, d) whose ends are near each other form a cycle a → b → d → c → a
with the odometry between b and d and between c and a. Composed, a cycle is the identity up to its
noise, which is small as long as the stretches of odometry are short. True loop closures of one
revisit are consistent; false ones are consistent with their neighbours only by chance (Mangelson,
Dominic, Eustice and Vasudevan 2018; here only neighbours are compared).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.pose_graph.graph import PoseGraph, Poses

_NEIGHBOURHOOD = 10
"""Two loop closures are compared if their ends are at most this many poses apart."""

_MIN_GROUP = 5
"""Least size of a connected group of consistent loop closures that confirm each other."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of neighbouring loop closures.

    Attributes:
        members: (P, 2) rows among the loop closures.
        consistent: (P,) whether the cycle of the pair closes.
    """

    members: IntArray
    consistent: BoolArray


def confirmed_loops(graph: PoseGraph, along_odometry: Poses, bound: float) -> IntArray:
    """Rows of the loop closures that are confirmed by others.

    A confirmed loop closure belongs to a connected group of at least `_MIN_GROUP` consistent ones,
    and is consistent with more of its neighbours than it is inconsistent with.

    Args:
        graph: the pose graph.
        along_odometry: poses composed along consecutive edges.
        bound: largest χ² of a consistent cycle.
    """
    loops = np.flatnonzero(~graph.is_odometry)
    if len(loops) < _MIN_GROUP:
        return loops[:0]
    pairs, count = _compare(graph, loops, along_odometry, bound), len(loops)
    consistent, inconsistent = pairs.members[pairs.consistent], pairs.members[~pairs.consistent]
    links = coo_matrix((np.ones(len(consistent)), tuple(consistent.T)), shape=(count, count))
    group = connected_components(links, directed=False)[1]
    large = np.bincount(group)[group] >= _MIN_GROUP
    for_, against = (
        np.bincount(rows.ravel(), minlength=count) for rows in (consistent, inconsistent)
    )
    confirmed: IntArray = loops[large & (for_ > against)]
    return confirmed


def _compare(graph: PoseGraph, loops: IntArray, along: Poses, bound: float) -> _Pairs:
    """Test the cycles of all pairs of neighbouring loop closures."""
    ends, measured = _ordered(graph.edges[loops], graph.measured.select(loops))
    members = cKDTree(ends).query_pairs(_NEIGHBOURHOOD, p=np.inf, output_type="ndarray")
    noise = _Noise.of(graph, loops)
    (a, b), (c, d) = ends[members[:, 0]].T, ends[members[:, 1]].T
    chained = (noise.chain[a] == noise.chain[c]) & (noise.chain[b] == noise.chain[d])
    members, a, b, c, d = members[chained], a[chained], b[chained], c[chained], d[chained]
    first, second = measured.select(members[:, 0]), measured.select(members[:, 1])
    stretches = _between(along, b, d), _between(along, c, a)
    cycle = first.compose(stretches[0]).compose(second.inverse()).compose(stretches[1])
    # a rotation error anywhere moves the end of the cycle by at most half of its length
    lever = 0.5 * sum(np.linalg.norm(p.translations, axis=1) for p in (first, second, *stretches))
    of_R, of_t = noise.of_cycles(members, a, b, c, d)
    squared = cycle.angles() ** 2 / of_R + np.sum(cycle.translations**2, axis=1) / (
        of_t + of_R * lever**2
    )
    return _Pairs(members, squared < bound)


@dataclass(frozen=True, slots=True, eq=False)
class _Noise:
    """Variances, averaged over the axes of rotation (rad²) and translation (m²).

    Attributes:
        loops: (2, L) of the loop closures.
        odometry: (2, N) summed over the odometry up to each pose.
        chain: (N,) number of the unbroken chain of odometry of each pose.
    """

    loops: FloatArray
    odometry: FloatArray
    chain: IntArray

    @staticmethod
    def of(graph: PoseGraph, loops: IntArray) -> _Noise:
        d, covariance = graph.dimension, np.linalg.inv(graph.angle_information)
        axes = np.diagonal(covariance, axis1=1, axis2=2)
        variances = np.stack([axes[:, d:].mean(axis=1), axes[:, :d].mean(axis=1)])
        steps = np.full((2, len(graph.keys)), np.nan)
        consecutive = graph.is_odometry
        steps[:, graph.edges[consecutive].max(axis=1)] = variances[:, consecutive]
        missing = np.isnan(steps[0])
        return _Noise(
            variances[:, loops], np.cumsum(np.nan_to_num(steps), axis=1), np.cumsum(missing)
        )

    def of_cycles(
        self, members: IntArray, a: IntArray, b: IntArray, c: IntArray, d: IntArray
    ) -> FloatArray:
        """(2, P) variances summed around each cycle."""
        odometry = self.odometry
        stretches = np.abs(odometry[:, b] - odometry[:, d]) + np.abs(
            odometry[:, a] - odometry[:, c]
        )
        summed: FloatArray = self.loops[:, members].sum(axis=2) + stretches
        return summed


def _ordered(ends: IntArray, measured: Poses) -> tuple[IntArray, Poses]:
    """Edges reversed where needed, so that the first end is the earlier pose."""
    back, inverse = ends[:, 0] > ends[:, 1], measured.inverse()
    return np.sort(ends, axis=1), Poses(
        np.where(back[:, None, None], inverse.rotations, measured.rotations),
        np.where(back[:, None], inverse.translations, measured.translations),
    )


def _between(poses: Poses, first: IntArray, second: IntArray) -> Poses:
    """Relative poses first_T_second."""
    return poses.select(first).inverse().compose(poses.select(second))
