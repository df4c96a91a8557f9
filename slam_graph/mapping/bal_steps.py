# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2 of bundle adjustment: Levenberg-Marquardt steps until the cost no longer falls.

The damping follows how well the linearised cost predicts the true one (Nielsen 1999).
"""

from __future__ import annotations

import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.mapping.bal_cost import BalCost, moved
from slam_graph.mapping.bal_policy import BalMinimum, BalStepsPolicy
from slam_graph.mapping.bal_problem import BalEstimates
from slam_graph.mapping.bal_schur import (
    BalStep,
    NormalEquations,
    Structure,
    damped_step,
    normal_equations,
    structure,
)

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
