# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A pose graph solved pose by pose with iSAM2, as if it were being recorded.

Kaess, Johannsson, Roberts, Ila, Leonard and Dellaert 2012.
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
from slam_graph.mapping.pose_graph_policy import PoseGraphStepsPolicy


def incremental(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Poses:
    """Add poses in the order of their ids, each with its edges to those before it.

    Args:
        cost: all factors.
        start: where the anchors are; all other poses begin where their first edge puts them.
        policy: when poses are linearised anew.
        diagnostics: counts if variables had to be eliminated by QR, which is slower and exact.

    Raises:
        RuntimeError: if the problem cannot be solved.
    """
    try:
        return _added_one_by_one(cost, start, policy, "CHOLESKY")
    except RuntimeError:
        diagnostics.warn(
            "pose_graph_eliminated_by_qr",
            f"{cost.graph.name}: too poorly conditioned for Cholesky; iSAM2 begins anew with QR",
        )
        return _added_one_by_one(cost, start, policy, "QR")


def _added_one_by_one(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, factorization: str
) -> Poses:
    """The estimates of iSAM2 when the last pose has come."""
    isam2 = gtsam.ISAM2(_parameters(policy, factorization))
    graph = cost.graph.keep_edges(cost.rows)
    ends, measured = graph.edges.tolist(), native(graph.measured)
    anchors = graph.anchors.tolist()
    priors = dict(zip(anchors, cost.anchors, strict=True))
    guesses = dict(zip(anchors, native(start.select(graph.anchors)), strict=True))
    for pose, edges in _arrivals(graph):
        factors = [cost.edges[row] for row in edges]
        if pose in priors:
            guess = guesses[pose]
            factors.append(priors[pose])
        else:
            (i, j), step = ends[edges[0]], measured[edges[0]]
            known = _estimate(isam2, j if i == pose else i, graph.dimension)
            guess = known.compose(step.inverse() if i == pose else step)
        values = gtsam.Values()
        values.insert(pose, guess)
        isam2.update(factor_graph(factors), values)
    return poses_of(isam2.calculateEstimate(), graph.dimension)


def _parameters(policy: PoseGraphStepsPolicy, factorization: str) -> gtsam.ISAM2Params:
    """Parameters of iSAM2."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(policy.relinearize_threshold)
    parameters.relinearizeSkip = policy.relinearize_skip
    parameters.setFactorization(factorization)
    return parameters


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
