# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimisation: cost construction, and steps until the cost no longer falls.

Module 2 of pose-graph optimisation: steps until the cost no longer falls, taken by GTSAM.
`gauss_newton` (the default), `levenberg_marquardt` and `dogleg` are GTSAM's batch optimizers;
`isam2` adds the poses one by one, as if they were being recorded (Kaess, Johannsson, Roberts, Ila,
Leonard and Dellaert 2012), and ends with Gauss-Newton. Orderings are COLAMD's: METIS, GTSAM's
default elsewhere, crashes on poses without edges.

Cost construction takes all poses and no features, Gauss-Newton goes on until convergence, and
nothing is marginalised, so that one pass of the loop is the whole algorithm.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from heapq import heappop, heappush
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.pose_graph.gnc import graduated_nonconvexity
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_cost import PoseGraphCost, construct, loss_weights
from slam_graph.pose_graph.graph_initialization import initialize
from slam_graph.pose_graph.gtsam_graph import (
    factor_graph,
    gtsam_poses,
    poses_of,
    values_of,
)
from slam_graph.pose_graph.pose_graph_policy import (
    PoseGraphCostPolicy,
    PoseGraphPolicy,
    PoseGraphStepsPolicy,
)
from slam_graph.pose_graph.pose_graph_solution import Minimum, PoseGraphSolution

_NEGLIGIBLE_COST = 1e-14
"""A cost of less than this for each edge is rounding: all edges agree."""

_SHRINKING = 0.01
"""Decreases of the cost that shrink to so much of the last are those of Gauss-Newton near its
minimum: they foretell the decrease of the next step."""

_ROUNDING = 1e-9
"""A relative increase of the cost up to this is rounding."""


def minimize(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """Take steps on a cost until it no longer falls.

    Raises:
        EstimationError: if the linear problem of a step has no solution, damped or not.
    """
    try:
        minimum = _METHODS[policy.method](cost, start, policy, diagnostics)
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
    """Gauss-Newton, and Levenberg-Marquardt after a step that fails or does not lower the cost."""
    optimizer = gtsam.GaussNewtonOptimizer(
        cost.factors(),
        values_of(start),
        _parameters(gtsam.GaussNewtonParams(), policy.tolerance, policy.max_steps),
    )
    negligible, before = _NEGLIGIBLE_COST * len(cost.edges), 0.0
    for step in range(1, policy.max_steps + 1):
        values, error = gtsam.Values(optimizer.values()), optimizer.error()  # a view otherwise
        lower = _iterated(optimizer)
        decrease, small = error - lower, policy.tolerance * error
        # decreases shrink at least by the same factor from step to step near the minimum
        nearly = 0.0 < decrease <= _SHRINKING * before and decrease**2 <= small * before
        if lower <= negligible or nearly or -_ROUNDING * error <= decrease <= small:
            return Minimum(poses_of(optimizer.values(), start.dimension), lower, step, True)
        before = decrease
        if not lower < error:
            diagnostics.warn(
                "pose_graph_step_damped",
                f"{cost.graph.name}: Gauss-Newton step {step} does not lower the cost; "
                "Levenberg-Marquardt continues",
            )
            last = poses_of(values, start.dimension)
            damped = _optimized(_LM, cost, last, policy, max(policy.max_steps - step, 1))
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
    return _optimized(_LM, cost, start, policy, policy.max_steps)


def _isam2(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """iSAM2 pose by pose, then Gauss-Newton, which removes its approximations."""
    last = _incremental(cost, start, policy, diagnostics)
    settled = _gauss_newton(cost, last, policy, diagnostics)
    return replace(settled, steps=len(start) + settled.steps)


def _dogleg(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Minimum:
    """Powell's dogleg."""
    dogleg = (gtsam.DoglegOptimizer, gtsam.DoglegParams)
    return _optimized(dogleg, cost, start, policy, policy.max_steps)


def _optimized(
    kind: tuple[Callable[..., Any], Callable[[], Any]],
    cost: PoseGraphCost,
    start: Poses,
    policy: PoseGraphStepsPolicy,
    max_steps: int,
) -> Minimum:
    """The minimum that an optimizer of GTSAM finds; `kind`: its class and that of its settings."""
    optimizer_of, parameters_of = kind
    parameters = _parameters(parameters_of(), policy.tolerance, max_steps)
    optimizer = optimizer_of(cost.factors(), values_of(start), parameters)
    values = optimizer.optimize()
    steps = int(optimizer.iterations())
    poses = poses_of(values, start.dimension)
    return Minimum(poses, optimizer.error(), steps, steps < max_steps)


def _parameters(parameters: Any, tolerance: float, max_steps: int) -> Any:
    """Set the parameters of an optimizer of GTSAM."""
    parameters.setOrderingType("COLAMD")
    parameters.setMaxIterations(max_steps)
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    return parameters


def _incremental(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, diagnostics: Diagnostics
) -> Poses:
    """Estimates of iSAM2 after adding the poses by id, each with its edges to those before it.

    Args:
        cost: all factors.
        start: estimates of the anchors; every other pose is initialised by its first edge.
        policy: when poses are relinearised.
        diagnostics: counts if QR had to be used instead of Cholesky, which is slower.

    Raises:
        RuntimeError: if the problem cannot be solved.
    """
    try:
        return _added_one_by_one(cost, start, policy, "CHOLESKY")
    except RuntimeError:
        diagnostics.warn(
            "pose_graph_eliminated_by_qr",
            f"{cost.graph.name}: too poorly conditioned for Cholesky; iSAM2 starts again with QR",
        )
        return _added_one_by_one(cost, start, policy, "QR")


def _added_one_by_one(
    cost: PoseGraphCost, start: Poses, policy: PoseGraphStepsPolicy, factorization: str
) -> Poses:
    """The estimates of iSAM2 after the last pose."""
    isam2 = gtsam.ISAM2(_isam2_parameters(policy, factorization))
    graph = cost.graph.keep_edges(cost.rows)
    ends, measured = graph.edges.tolist(), gtsam_poses(graph.measured)
    anchors = graph.anchors.tolist()
    priors = dict(zip(anchors, cost.anchors, strict=True))
    guesses = dict(zip(anchors, gtsam_poses(start.select(graph.anchors)), strict=True))
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
    """Poses by id, each as soon as an edge connects it to an earlier one, with these edges."""
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


_LM = (gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams)

_METHODS = {
    "gauss_newton": _gauss_newton,
    "levenberg_marquardt": _levenberg_marquardt,
    "dogleg": _dogleg,
    "isam2": _isam2,
}


def optimize_pose_graph(
    graph: PoseGraph,
    policy: PoseGraphPolicy | None = None,
    diagnostics: Diagnostics | None = None,
) -> PoseGraphSolution:
    """Estimate all poses of a graph.

    Args:
        graph: poses and edges.
        policy: settings; the defaults if not given.
        diagnostics: counts what did not go as asked.

    Raises:
        DataError: if the graph does not allow the initialization that is asked for.
        EstimationError: if the cost cannot be minimised.
    """
    policy, diagnostics = policy or PoseGraphPolicy(), diagnostics or Diagnostics()
    start, weights = _initial_estimates(graph, policy.cost, diagnostics)

    # 1. Cost construction: all poses, no features.
    cost = construct(graph, policy.cost, weights)
    # 2. Gauss-Newton steps until convergence.
    minimum = minimize(cost, start, policy.gauss_newton, diagnostics)
    # 3. Marginalization: none, every pose stays.

    return PoseGraphSolution(graph, start, minimum, _weights(cost, minimum.poses, weights))


def _initial_estimates(
    graph: PoseGraph, policy: PoseGraphCostPolicy, diagnostics: Diagnostics
) -> tuple[Poses, FloatArray]:
    """Initial poses, and weights (M,) of the edges: 0 for those that `gnc` rejected."""
    if policy.robust == "gnc":
        try:
            return graduated_nonconvexity(graph, policy, diagnostics)
        except RuntimeError as error:
            reason = " ".join(str(error).split(".")[0].split())
            raise EstimationError(f"{graph.name}: gnc failed: {reason}") from error
    how = policy.initialization
    if how == "auto":
        how = "chordal" if policy.robust == "none" else "odometry"
    return initialize(graph, how, diagnostics), np.ones(len(graph.edges))


def _weights(cost: PoseGraphCost, poses: Poses, weights: FloatArray) -> FloatArray:
    """(M,) final weights of all edges, those of the robust loss included."""
    final = weights.copy()
    final[cost.rows] *= loss_weights(cost, poses)
    return final
