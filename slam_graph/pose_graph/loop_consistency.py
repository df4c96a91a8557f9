# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures confirm each other, judged by short ways of odometry between them.

Two loop closures (a, b) and (c, d) whose ends are near each other close a cycle a → b → d → c → a
with the odometry between b and d and between c and a. The cycle is the identity up to its noise,
which is small as long as these ways are short: true loop closures of one revisit confirm each
other, and false ones agree with their neighbours only by chance. The test is that of pairwise
consistency (Mangelson, Dominic, Eustice and Vasudevan 2018), between neighbours only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.pose_graph.graph import PoseGraph, Poses

NEIGHBOURHOOD = 10
"""How many poses apart the ends of two loop closures may be to be compared."""

MIN_GROUP = 5
"""How many loop closures must be tied together by agreement to confirm each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Pairs of loop closures, and whether they agree.

    Attributes:
        members: (P, 2) rows among the loop closures.
        agree: (P,).
    """

    members: IntArray
    agree: NDArray[np.bool_]


def confirmed_loops(graph: PoseGraph, along_odometry: Poses, bound: float) -> IntArray:
    """Rows of the edges that are loop closures and confirmed by others.

    Such a one belongs to a group of at least `MIN_GROUP` that agreement ties together, and agrees
    with more of its neighbours than it contradicts.

    Args:
        graph: the pose graph.
        along_odometry: poses composed along consecutive edges.
        bound: χ² of a cycle that still agrees.
    """
    loops = np.flatnonzero(~graph.is_odometry)
    if len(loops) < MIN_GROUP:
        return loops[:0]
    pairs, count = _compare(graph, loops, along_odometry, bound), len(loops)
    agreeing, contrary = pairs.members[pairs.agree], pairs.members[~pairs.agree]
    links = coo_matrix((np.ones(len(agreeing)), tuple(agreeing.T)), shape=(count, count))
    group = connected_components(links, directed=False)[1]
    large = np.bincount(group)[group] >= MIN_GROUP
    friends, foes = (np.bincount(rows.ravel(), minlength=count) for rows in (agreeing, contrary))
    confirmed: IntArray = loops[large & (friends > foes)]
    return confirmed


def _compare(graph: PoseGraph, loops: IntArray, along: Poses, bound: float) -> Pairs:
    """Cycles of all loop closures that are near each other."""
    ends, measured = _ordered(graph.edges[loops], graph.measured.select(loops))
    members = cKDTree(ends).query_pairs(NEIGHBOURHOOD, p=np.inf, output_type="ndarray")
    noise = _Noise.of(graph, loops)
    (a, b), (c, d) = ends[members[:, 0]].T, ends[members[:, 1]].T
    chained = (noise.chain[a] == noise.chain[c]) & (noise.chain[b] == noise.chain[d])
    members, a, b, c, d = members[chained], a[chained], b[chained], c[chained], d[chained]
    first, second = measured.select(members[:, 0]), measured.select(members[:, 1])
    ways = _between(along, b, d), _between(along, c, a)
    cycle = first.compose(ways[0]).compose(second.inverse()).compose(ways[1])
    # A turn anywhere moves the end by at most half of what the way is long.
    lever = 0.5 * sum(np.linalg.norm(p.translations, axis=1) for p in (first, second, *ways))
    of_R, of_t = noise.of_cycles(members, a, b, c, d)
    squared = cycle.angles() ** 2 / of_R + np.sum(cycle.translations**2, axis=1) / (
        of_t + of_R * lever**2
    )
    return Pairs(members, squared < bound)


@dataclass(frozen=True, slots=True, eq=False)
class _Noise:
    """Mean variances of an axis, rotation and translation: rad² and m².

    Attributes:
        loops: (2, L) of the loop closures.
        odometry: (2, N) of all steps of odometry up to a pose.
        chain: (N,) number of the unbroken chain of odometry that a pose belongs to.
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
        """(2, P) variances summed around cycles."""
        odometry = self.odometry
        ways = np.abs(odometry[:, b] - odometry[:, d]) + np.abs(odometry[:, a] - odometry[:, c])
        summed: FloatArray = self.loops[:, members].sum(axis=2) + ways
        return summed


def _ordered(ends: IntArray, measured: Poses) -> tuple[IntArray, Poses]:
    """Edges turned so that the first end is the earlier pose."""
    back, inverse = ends[:, 0] > ends[:, 1], measured.inverse()
    return np.sort(ends, axis=1), Poses(
        np.where(back[:, None, None], inverse.rotations, measured.rotations),
        np.where(back[:, None], inverse.translations, measured.translations),
    )


def _between(poses: Poses, first: IntArray, second: IntArray) -> Poses:
    """Relative poses first_T_second."""
    return poses.select(first).inverse().compose(poses.select(second))
