# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2 of pose-graph optimisation: steps until the cost no longer falls, taken by GTSAM.

Orderings are COLAMD's: METIS, GTSAM's default elsewhere, crashes on poses that no edge touches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.mapping.native_pose_graph import poses_of, values_of
from slam_graph.mapping.pose_graph import Poses
from slam_graph.mapping.pose_graph_cost import PoseGraphCost
from slam_graph.mapping.pose_graph_incremental import incremental
from slam_graph.mapping.pose_graph_policy import Minimum, PoseGraphStepsPolicy

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
