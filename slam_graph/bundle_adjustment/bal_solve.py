# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of BAL problems: the loop of every algorithm here, with the policies of BA.

Cost construction takes all poses and features and no pose costs, Levenberg-Marquardt steps go on
until convergence, and nothing is marginalised, so that one pass of the loop is the whole algorithm.
"""

from __future__ import annotations

import numpy as np

from slam_graph.backend import Attempt, GainRatioDamping, levenberg_marquardt
from slam_graph.bundle_adjustment.bal_cost import BalCost, construct, initial_estimates, retract
from slam_graph.bundle_adjustment.bal_policy import BalPolicy, BalStepsPolicy
from slam_graph.bundle_adjustment.bal_problem import (
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
    damped_step,
    normal_equations,
    restore_gauge,
    structure,
)
from slam_graph.bundle_adjustment.bal_solution import BalMinimum, BalSolution
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError

INITIAL_DAMPING = 1e-4
"""Of the first step, relative to the diagonal of the information."""
_NEGLIGIBLE_COST = 1e-14
"""A cost of less than this for each observation is rounding: all pixels agree."""
_CONVERGENCE_DAMPING = 0.1
"""A small decrease is a sign of convergence only up to this damping: beyond it, steps are small
because they are damped."""


def adjust_bundle(
    problem: BalProblem,
    policy: BalPolicy | None = None,
    diagnostics: Diagnostics | None = None,
) -> BalSolution:
    """Estimate all cameras and points of a problem.

    Args:
        problem: cameras, points and observations.
        policy: settings; the defaults if not given.
        diagnostics: counts what is left out, and what did not go as asked.

    Raises:
        DataError: if nothing of the problem can be used.
        EstimationError: if the cost cannot be minimised.
    """
    policy, diagnostics = policy or BalPolicy(), diagnostics or Diagnostics()
    part = usable(problem, diagnostics)
    start = initial_estimates(part, policy.cost)

    # 1. Cost construction: all poses and features, no pose costs.
    cost = construct(part, policy.cost)
    _check_determined(cost, diagnostics)
    # 2. Gauss-Newton steps until convergence.
    with np.errstate(all="ignore"):  # a step to where nothing is finite is not taken
        minimum = _minimize(cost, start, policy.gauss_newton, diagnostics)
    # 3. Marginalization: none, every pose and feature stays.

    estimates = restore_gauge(part, minimum.estimates)
    _check_depths(part, estimates, diagnostics)
    everything = problem.estimates.updated(part.cameras, part.points, estimates)
    return BalSolution(problem, part, minimum, everything)


def _minimize(
    cost: BalCost, start: BalEstimates, policy: BalStepsPolicy, diagnostics: Diagnostics
) -> BalMinimum:
    """Take steps on a cost until it no longer falls.

    Raises:
        EstimationError: if the cost is not finite at the start, or the problem too large.
    """
    problem, damping = _DampedBundle(cost, start), GainRatioDamping(INITIAL_DAMPING)
    if not np.isfinite(problem.value()):
        raise EstimationError(f"{cost.part.problem.name}: the cost at the start is not finite")
    negligible = _NEGLIGIBLE_COST * len(cost.part.problem.pixels)

    def converged(attempt: Attempt) -> bool:
        if attempt.accepted:
            value, decrease = attempt.after, attempt.before - attempt.after
        else:
            value, decrease = attempt.before, attempt.predicted
        if value <= negligible:
            return True
        return (
            attempt.damping <= _CONVERGENCE_DAMPING
            and decrease <= policy.tolerance * attempt.before
        )

    steps = levenberg_marquardt(problem, policy.max_steps, converged, damping)
    count = steps.accepted + steps.rejected
    if not steps.converged:
        still = "no step lowers the cost" if damping.exhausted else "the cost still falls"
        diagnostics.warn(
            "bal_not_converged", f"{cost.part.problem.name}: {still} after {count} steps"
        )
    return BalMinimum(
        problem.estimates, steps.costs[0], steps.costs[-1], count, steps.rejected, steps.converged
    )


class _DampedBundle:
    """A bundle-adjustment cost as `levenberg_marquardt` takes it (see `DampedProblem`)."""

    def __init__(self, cost: BalCost, start: BalEstimates) -> None:
        self._cost, self._structure = cost, structure(cost)
        self.estimates = self._before = start
        self._equations: NormalEquations | None = None
        self._step: BalStep | None = None
        self._value: float | None = None

    def value(self) -> float:
        if self._value is None:
            self._value = self._cost(self.estimates)
        return self._value

    def linearize(self) -> None:
        self._equations = normal_equations(self._cost, self.estimates)

    def solve(self, damping: float) -> float:
        assert self._equations is not None
        try:
            self._step = damped_step(self._cost, self._structure, self._equations, damping)
        except np.linalg.LinAlgError:
            return np.inf
        return self._step.predicted

    def apply(self) -> None:
        assert self._step is not None
        self._before = self.estimates
        self.estimates = retract(self.estimates, self._step.by_camera, self._step.by_point)
        self._value = None

    def undo(self) -> None:
        self.estimates, self._value = self._before, None


def _check_determined(cost: BalCost, diagnostics: Diagnostics) -> None:
    """Count a cost that has fewer residuals than unknowns."""
    part = cost.part
    unknowns = cost.variables.shape[1] + 3 * part.problem.points
    unknowns -= GAUGE_DIM * (int(part.groups.max()) + 1)
    residuals = 2 * len(part.problem.camera)
    if residuals < unknowns:
        diagnostics.warn(
            "bal_underdetermined",
            f"{part.problem.name}: {residuals} residuals for {unknowns} unknowns: the result is "
            "one of many solutions",
        )


def _check_depths(part: BalPart, estimates: BalEstimates, diagnostics: Diagnostics) -> None:
    """Count observations of points that have ended behind their camera."""
    problem = part.problem
    _, depths = project(estimates, problem.camera, problem.point)
    for row in np.flatnonzero(depths <= 0):
        diagnostics.warn(
            "bal_point_ended_behind_camera",
            f"{problem.name}: point {part.points[problem.point[row]]} ended behind camera "
            f"{part.cameras[problem.camera[row]]}, which observes it",
        )
