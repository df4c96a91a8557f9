# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of BAL problems: the loop of every algorithm here, with the policies of BA.

Cost construction takes all poses and features and no costs between poses, Gauss-Newton goes on
until convergence, and nothing is marginalised, so that one pass of the loop is all there is.

Module 2 of bundle adjustment: Levenberg-Marquardt steps until the cost no longer falls.

The damping follows how well the linearised cost predicts the true one (Nielsen 1999).
"""

from __future__ import annotations

import numpy as np

from slam_graph.bundle_adjustment.bal_cost import BalCost, construct, first_estimates, moved
from slam_graph.bundle_adjustment.bal_policy import (
    BalMinimum,
    BalPolicy,
    BalSolution,
    BalStepsPolicy,
)
from slam_graph.bundle_adjustment.bal_problem import (
    POSE_DIM,
    BalEstimates,
    BalPart,
    BalProblem,
    project,
    usable,
)
from slam_graph.bundle_adjustment.bal_schur import (
    GAUGE_DIM,
    BalStep,
    NormalEquations,
    Structure,
    damped_step,
    normal_equations,
    restored,
    structure,
)
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError

NOTHING_PER_OBSERVATION = 1e-14
"""A cost of less than this for each observation is rounding: all pixels agree."""

LEAST_DAMPING = 1e-10
MOST_DAMPING = 1e12

FREE_DAMPING = 0.1
"""With more damping than this, small steps may be the damping's doing: no sign of convergence."""


def minimize(
    cost: BalCost, start: BalEstimates, policy: BalStepsPolicy, diagnostics: Diagnostics
) -> BalMinimum:
    """Take steps on a cost until it no longer falls.

    Raises:
        EstimationError: if the cost is not finite at the start, or the problem too large.
    """
    fixed, estimates, value = structure(cost), start, cost(start)
    if not np.isfinite(value):
        raise EstimationError(f"{cost.part.problem.name}: the cost at the start is not finite")
    start_cost, nothing = value, NOTHING_PER_OBSERVATION * len(cost.part.problem.pixels)
    damping, growth, rejected, converged, step = policy.initial_damping, 2.0, 0, False, 0
    equations = None
    while step < policy.max_steps and damping < MOST_DAMPING and not converged:
        step += 1
        equations = equations or normal_equations(cost, estimates, fixed)
        tried, lower, predicted = _tried(cost, fixed, equations, estimates, damping)
        enough = policy.tolerance * value
        free = damping <= FREE_DAMPING
        if lower < value:
            converged = lower <= nothing or (free and value - lower <= enough)
            gain = (value - lower) / predicted
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            damping, growth = max(damping, LEAST_DAMPING), 2.0
            estimates, value, equations = tried, lower, None
        else:
            rejected += 1
            converged = value <= nothing or (free and predicted <= enough)
            damping, growth = damping * growth, 2.0 * growth
    if not converged:
        still = "no step lowers the cost" if damping >= MOST_DAMPING else "the cost still falls"
        diagnostics.warn(
            "bal_not_converged", f"{cost.part.problem.name}: {still} after {step} steps"
        )
    return BalMinimum(estimates, start_cost, value, step, rejected, converged)


def _tried(
    cost: BalCost,
    fixed: Structure,
    equations: NormalEquations,
    estimates: BalEstimates,
    damping: float,
) -> tuple[BalEstimates, float, float]:
    """Where a step leads, what that costs, and by how much the cost was to fall.

    The cost is infinite if the equations have no solution.
    """
    try:
        step: BalStep = damped_step(cost, fixed, equations, damping)
    except np.linalg.LinAlgError:
        return estimates, np.inf, np.inf
    if not np.isfinite(step.predicted):
        return estimates, np.inf, np.inf
    tried = moved(estimates, step.by_camera, step.by_point)
    return tried, cost(tried), step.predicted


def adjust_bundle(
    problem: BalProblem,
    policy: BalPolicy | None = None,
    diagnostics: Diagnostics | None = None,
) -> BalSolution:
    """Estimate all cameras and points of a problem.

    Args:
        problem: cameras, points and observations.
        policy: how; the defaults if not said.
        diagnostics: counts what is left out, and what did not go as asked.

    Raises:
        DataError: if nothing of the problem can be used.
        EstimationError: if the cost cannot be minimised.
    """
    policy, diagnostics = policy or BalPolicy(), diagnostics or Diagnostics()
    part = usable(problem, diagnostics)
    start = first_estimates(part, policy.cost)

    # 1. Cost construction: all poses and features, no costs between poses.
    cost = construct(part, policy.cost)
    _check_determined(cost, diagnostics)
    # 2. Gauss-Newton steps until convergence.
    with np.errstate(all="ignore"):  # a step to where nothing is finite is not taken
        minimum = minimize(cost, start, policy.gauss_newton, diagnostics)
    # 3. Marginalization: none, every pose and feature stays.

    held = part.problem.prior is not None  # then there is no gauge to restore
    estimates = minimum.estimates if held else restored(part, minimum.estimates)
    _check_depths(part, estimates, diagnostics)
    everything = problem.estimates.updated(part.cameras, part.points, estimates)
    return BalSolution(problem, part, minimum, everything)


def _check_determined(cost: BalCost, diagnostics: Diagnostics) -> None:
    """Count a cost that has fewer residuals than unknowns."""
    part = cost.part
    unknowns = cost.variables.shape[1] + 3 * part.problem.points
    residuals = 2 * len(part.problem.camera)
    if part.problem.prior is None:
        unknowns -= GAUGE_DIM * (int(part.groups.max()) + 1)
    else:
        residuals += POSE_DIM * part.problem.cameras
    if residuals < unknowns:
        diagnostics.warn(
            "bal_underdetermined",
            f"{part.problem.name}: {residuals} coordinates of pixels for {unknowns} unknowns: what "
            "comes out is one of many solutions",
        )


def _check_depths(part: BalPart, estimates: BalEstimates, diagnostics: Diagnostics) -> None:
    """Count observations of points that have ended behind their camera."""
    problem = part.problem
    _, depths = project(estimates, problem.camera, problem.point)
    for row in np.flatnonzero(depths <= 0):
        diagnostics.warn(
            "bal_point_ended_behind_camera",
            f"{problem.name}: point {part.points[problem.point[row]]} ended behind camera "
            f"{part.cameras[problem.camera[row]]}, which saw it",
        )
