# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2 of pose-graph optimisation: steps until the cost no longer falls, taken by GTSAM.

Orderings are COLAMD's: METIS, GTSAM's default elsewhere, crashes on poses that no edge touches.

A pose graph solved pose by pose with iSAM2, as if it were being recorded.

Kaess, Johannsson, Roberts, Ila, Leonard and Dellaert 2012.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from heapq import heappop, heappush
from typing import Any

import gtsam
import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_cost import PoseGraphCost
from slam_graph.pose_graph.gtsam_graph import factor_graph, native, poses_of, values_of
from slam_graph.pose_graph.pose_graph_policy import Minimum, PoseGraphStepsPolicy


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
    isam2 = gtsam.ISAM2(_isam2_parameters(policy, factorization))
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


def _isam2_parameters(policy: PoseGraphStepsPolicy, factorization: str) -> gtsam.ISAM2Params:
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


NOTHING_PER_EDGE = 1e-14
"""A cost of less than this for each edge is rounding: all edges agree."""

ROUNDING = 1e-9
"""A cost that rises by no more than this part of it has not risen."""


def minimize(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """Take steps on a cost until it no longer falls.

    Raises:
        EstimationError: if the linear problem of a step has no solution, damped or not.
    """
    try:
        minimum = METHODS[policy.method](cost, start, policy, diagnostics)
    except RuntimeError as error:
        reason = " ".join(str(error).split(".")[0].split())
        raise EstimationError(f"{cost.graph.name}: {policy.method} failed: {reason}") from error
    if not np.isfinite(minimum.cost):
        raise EstimationError(f"{cost.graph.name}: {policy.method} failed: the cost is not finite")
    if not minimum.converged:
        diagnostics.warn(
            "pose_graph_not_converged",
            f"{cost.graph.name}: the cost still falls after {minimum.steps} steps",
        )
    return minimum


def _gauss_newton(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """Gauss-Newton; Levenberg-Marquardt from where a step fails or does not lower the cost."""
    optimizer = gtsam.GaussNewtonOptimizer(
        cost.factors(), values_of(start), _parameters(gtsam.GaussNewtonParams(), policy)
    )
    nothing = NOTHING_PER_EDGE * len(cost.edges)
    for step in range(1, policy.max_steps + 1):
        values, error = gtsam.Values(optimizer.values()), optimizer.error()  # a view otherwise
        lower = _iterated(optimizer)
        if lower <= nothing or -ROUNDING * error <= error - lower <= policy.tolerance * error:
            return Minimum(poses_of(optimizer.values(), start.dimension), lower, step, True)
        if not lower < error:
            diagnostics.warn(
                "pose_graph_step_damped",
                f"{cost.graph.name}: step {step} of Gauss-Newton does not lower the cost; "
                "Levenberg-Marquardt goes on",
            )
            rest = policy.model_copy(update={"max_steps": max(policy.max_steps - step, 1)})
            damped = _levenberg_marquardt(
                cost, poses_of(values, start.dimension), rest, diagnostics
            )
            return replace(damped, steps=step + damped.steps)
    last = poses_of(optimizer.values(), start.dimension)
    return Minimum(last, optimizer.error(), policy.max_steps, False)


def _iterated(optimizer: gtsam.GaussNewtonOptimizer) -> float:
    """The cost after one more step; infinite if the step has no solution."""
    try:
        optimizer.iterate()
    except RuntimeError:
        return float("inf")
    return float(optimizer.error())


def _levenberg_marquardt(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """Levenberg-Marquardt."""
    return _optimized(
        gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams(), cost, start, policy
    )


def _isam2(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """iSAM2 pose by pose, and then Gauss-Newton, which leaves nothing of its approximations."""
    last = incremental(cost, start, policy, diagnostics)
    settled = _gauss_newton(cost, last, policy, diagnostics)
    return replace(settled, steps=len(start) + settled.steps)


def _dogleg(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """Powell's dogleg."""
    return _optimized(gtsam.DoglegOptimizer, gtsam.DoglegParams(), cost, start, policy)


def _optimized(
    optimizer_of: Callable[..., Any],
    parameters: Any,
    cost: PoseGraphCost,
    start: Poses,
    policy: PoseGraphStepsPolicy,
) -> Minimum:
    """What one of GTSAM's optimizers comes to."""
    optimizer = optimizer_of(cost.factors(), values_of(start), _parameters(parameters, policy))
    values = optimizer.optimize()
    steps = int(optimizer.iterations())
    poses = poses_of(values, start.dimension)
    return Minimum(poses, optimizer.error(), steps, steps < policy.max_steps)


def _parameters(parameters: Any, policy: PoseGraphStepsPolicy) -> Any:
    """Parameters of one of GTSAM's optimizers, filled in."""
    parameters.setOrderingType("COLAMD")
    parameters.setMaxIterations(policy.max_steps)
    parameters.setRelativeErrorTol(policy.tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    return parameters


METHODS = {
    "gauss_newton": _gauss_newton,
    "levenberg_marquardt": _levenberg_marquardt,
    "dogleg": _dogleg,
    "isam2": _isam2,
}
