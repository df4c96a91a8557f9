# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A pose graph solved pose by pose with iSAM2, as if it were being recorded.

Kaess, Johannsson, Roberts, Ila, Leonard and Dellaert 2012. When all poses are there, updates go on
until the cost no longer falls, so that the result is that of the batch solvers.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from heapq import heappop, heappush

import gtsam

from slam_graph.diagnostics import Diagnostics
from slam_graph.mapping.native_pose_graph import factor_graph, native, poses_of
from slam_graph.mapping.pose_graph import PoseGraph, Poses
from slam_graph.mapping.pose_graph_cost import PoseGraphCost
from slam_graph.mapping.pose_graph_policy import Minimum, PoseGraphStepsPolicy


def incremental(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """Add poses in the order of their ids, each with its edges to those before it.

    Args:
        cost: all factors.
        start: where the anchors are; all other poses begin where their first edge puts them.
        policy: when poses are linearised anew, and when updates end.
        diagnostics: not used; nothing can be repaired here.

    Raises:
        RuntimeError: if the problem cannot be solved.
    """
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(policy.relinearize_threshold)
    parameters.relinearizeSkip = policy.relinearize_skip
    isam2 = gtsam.ISAM2(parameters)
    graph = cost.graph.keep_edges(cost.rows)
    measured, at_anchors = native(graph.measured), native(start.select(graph.anchors))
    anchors = dict(zip(graph.anchors.tolist(), range(len(graph.anchors)), strict=True))
    ends = graph.edges.tolist()
    for pose, edges in _arrivals(graph):
        factors = [cost.edges[row] for row in edges]
        if pose in anchors:
            guess = at_anchors[anchors[pose]]
            factors.append(cost.anchors[anchors[pose]])
        else:
            i, j = ends[edges[0]]
            known = _estimate(isam2, j if i == pose else i, graph.dimension)
            step = measured[edges[0]]
            guess = known.compose(step.inverse() if i == pose else step)
        values = gtsam.Values()
        values.insert(pose, guess)
        isam2.update(factor_graph(factors), values)
    return _settled(isam2, cost, policy, graph.dimension)


def _settled(
    isam2: gtsam.ISAM2, cost: PoseGraphCost, policy: PoseGraphStepsPolicy, dimension: int
) -> Minimum:
    """The end of updates that linearise all poses anew until the cost no longer falls."""
    everything, steps = cost.factors(), len(cost.graph.keys)
    values = isam2.calculateEstimate()
    error = everything.error(values)
    for further in range(1, policy.max_steps + 1):
        isam2.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), force_relinearize=True)
        values = isam2.calculateEstimate()
        before, error = error, everything.error(values)
        if abs(before - error) <= policy.tolerance * before:
            return Minimum(poses_of(values, dimension), steps + further, True)
    return Minimum(poses_of(values, dimension), steps + policy.max_steps, False)


def _estimate(isam2: gtsam.ISAM2, key: int, dimension: int) -> gtsam.Pose2 | gtsam.Pose3:
    """The estimate of one pose."""
    if dimension == 2:
        return isam2.calculateEstimatePose2(key)
    return isam2.calculateEstimatePose3(key)


def _arrivals(graph: PoseGraph) -> Iterator[tuple[int, list[int]]]:
    """Poses by their ids, each as soon as an edge ties it to one before, with these edges."""
    neighbours: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for row, (i, j) in enumerate(graph.edges.tolist()):
        neighbours[i].append((j, row))
        neighbours[j].append((i, row))
    arrived: set[int] = set()
    waiting = graph.anchors.tolist()
    while waiting:
        pose = heappop(waiting)
        if pose in arrived:
            continue
        arrived.add(pose)
        yield pose, [row for other, row in neighbours[pose] if other in arrived]
        for other, _ in neighbours[pose]:
            if other not in arrived:
                heappush(waiting, other)
