# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2, Gauss-Newton: steps that minimise the cost.

Each step linearises every residual, stacks the rows under the prior's triangular factor, restores
the triangle by QR, and moves the estimates by the solution. The triangle of the last step is the
posterior Gaussian that marginalization works on. After the first step, which makes a filter, steps
are only taken as long as they lower the cost; Levenberg-Marquardt adds rows that hold a step back
that would not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.cost import Cost, Linearization
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.solve.damped_steps import (
    Attempt,
    TenfoldDamping,
    levenberg_marquardt,
)
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation

_INITIAL_DAMPING = 1e-4
_MAX_DAMPING = 1e6
_MAX_REPEATED_STEPS = 4
"""Steps in all, at most, where the calibration moves too far for the first to be linear."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """What the steps have come to.

    Attributes:
        posterior: over an increment of the final estimates, linearised where the last step was.
        costs: the cost before the first step and after each step that was taken; of a single step
            that nothing depends on by what it promised, which takes no time.
        repeated: whether there were more steps than the policy has, because one was too large.
        converged: whether the steps ended because the cost fell no more; True without damping,
            where that is not judged.
    """

    posterior: SquareRootInformation
    costs: tuple[float, ...]
    repeated: bool = False
    converged: bool = True


Again = Callable[[SquareRootInformation, FloatArray], bool]
"""Whether a step (n,) under its posterior asks for one more."""


Hopeful = Callable[[Attempt], bool]
"""Whether it is worth going on after a step that was tried and did not end the minimisation."""


def minimize(
    cost: Cost,
    policy: GaussNewtonPolicy,
    linear: Linearization | None = None,
    again: Again | None = None,
    predicted: SquareRootInformation | None = None,
    hopeful: Hopeful | None = None,
) -> Minimum:
    """Take steps on a cost.

    Args:
        cost: moved in place: its state, and its new features.
        policy: kind and number of steps.
        linear: the linearisation at the current estimates, where it is known already.
        again: asks for more steps than the policy has, up to `_MAX_REPEATED_STEPS` in all.
        predicted: what is known without images at the current estimates, where that is known. It
            is changed: copies of large matrices take time and memory.
        hopeful: is asked after each step of Levenberg-Marquardt; where it says no, the steps end
            without having converged.

    Raises:
        numpy.linalg.LinAlgError: if the cost leaves a variable undetermined.
    """
    if policy.damping == "levenberg_marquardt":
        return _levenberg_marquardt(cost, policy, linear, predicted, hopeful)
    linear = linear or cost.linearize(summed=True)
    layout, before = cost.layout(), cost.value(linear, predicted)
    posterior, delta, promised = _step(cost, linear, layout, predicted)
    judged = policy.max_steps > 1 or again is not None
    minimum = Minimum(posterior, (before, cost.value() if judged else before - promised))
    while _another(policy, minimum, delta, again):
        undo = cost.snapshot()
        posterior, delta, _ = _step(cost, cost.linearize(summed=True), layout)
        value = cost.value()
        if not value < minimum.costs[-1]:
            cost.restore(undo)
            break
        steps = len(minimum.costs)
        minimum = Minimum(posterior, (*minimum.costs, value), repeated=steps > policy.max_steps)
    return minimum


def _another(
    policy: GaussNewtonPolicy, minimum: Minimum, delta: FloatArray, again: Again | None
) -> bool:
    """Whether the last step asks for one more."""
    steps = len(minimum.costs) - 1
    if steps < policy.max_steps:
        return bool(np.max(np.abs(delta), initial=0.0) >= policy.tolerance)
    return again is not None and steps < _MAX_REPEATED_STEPS and again(minimum.posterior, delta)


def _step(
    cost: Cost,
    linear: Linearization,
    layout: Layout,
    predicted: SquareRootInformation | None = None,
) -> tuple[SquareRootInformation, FloatArray, float]:
    """Move a cost by one step.

    Returns:
        The posterior, at the new estimates; the step (n,); and by how much the cost falls if it is
        as linear as it was taken for.
    """
    posterior = _system(cost, linear, layout, predicted)
    delta = posterior.solution()
    cost.apply(delta, linear, layout)
    promised = _promised(posterior)
    return posterior.shifted(delta, overwrite=True), delta, promised


def linearized(cost: Cost, linear: Linearization | None = None) -> SquareRootInformation:
    """A cost as a Gaussian over an increment of the current estimates.

    Args:
        cost: of some estimates.
        linear: its linearisation there, summed up, where it is known already.
    """
    return _system(cost, linear or cost.linearize(summed=True), cost.layout())


def _system(
    cost: Cost,
    linear: Linearization,
    layout: Layout,
    predicted: SquareRootInformation | None = None,
) -> SquareRootInformation:
    """The linearised cost as a Gaussian over an increment of the estimates."""
    if predicted is None:
        rows = cost.factor_rows(layout)
        system = cost.prior_at_estimate().updated(rows, overwrite=True, overwrite_rows=True)
    else:
        system = predicted.over(layout)
    for rows in cost.rows(linear, layout):
        system = system.updated(rows, overwrite=True, overwrite_rows=True)
    return system


def _levenberg_marquardt(
    cost: Cost,
    policy: GaussNewtonPolicy,
    linear: Linearization | None,
    predicted: SquareRootInformation | None,
    hopeful: Hopeful | None,
) -> Minimum:
    """Gauss-Newton steps, with damping from the first one on that does not lower the cost."""
    problem, given_up = _DampedCost(cost, linear, predicted), False

    def converged(attempt: Attempt) -> bool:
        if not attempt.accepted:
            return attempt.predicted < policy.tolerance * attempt.before
        gain = attempt.before - attempt.after
        undamped = 0.0 if attempt.damping else attempt.predicted
        return max(gain, undamped) < policy.tolerance * attempt.after

    def ended(attempt: Attempt) -> bool:
        nonlocal given_up
        done = converged(attempt)
        given_up = not (done or hopeful is None or hopeful(attempt))
        return done or given_up

    damping = TenfoldDamping(_INITIAL_DAMPING, _MAX_DAMPING)
    steps = levenberg_marquardt(problem, policy.max_steps, ended, damping)
    return Minimum(problem.posterior(), steps.costs, converged=steps.converged and not given_up)


class _DampedCost:
    """A cost as `levenberg_marquardt` takes it (see `DampedProblem`)."""

    def __init__(
        self, cost: Cost, linear: Linearization | None, predicted: SquareRootInformation | None
    ) -> None:
        self._cost, self._layout, self._given = cost, cost.layout(), linear
        # with new variables among its columns the QR would round differently
        known = predicted is not None and predicted.layout is self._layout
        self._predicted = predicted if known else None
        self._delta: FloatArray | None = None

    def value(self) -> float:
        """The cost under the robust loss."""
        return self._cost.value(self._given)

    def linearize(self) -> None:
        """Linearise all residuals."""
        self._linear = self._given or self._cost.linearize(summed=True)
        self._system = _system(self._cost, self._linear, self._layout, self._predicted)
        self._given, self._predicted, self._delta = None, None, None

    def solve(self, damping: float) -> float:
        """Solve the damped system; the decrease that the undamped one predicts."""
        self._delta = _damped(self._system, damping).solution()
        return _promised(self._system)

    def apply(self) -> None:
        """Move the state."""
        assert self._delta is not None, "solved before"
        self._before = self._cost.snapshot()
        self._cost.apply(self._delta, self._linear, self._layout)

    def undo(self) -> None:
        """Move the state back."""
        self._cost.restore(self._before)
        self._delta = None

    def posterior(self) -> SquareRootInformation:
        """At the current estimates, linearised where the last step was."""
        return self._system if self._delta is None else self._system.shifted(self._delta)


def _promised(system: SquareRootInformation) -> float:
    """By how much the linearised cost falls from no step to the best one."""
    return 0.5 * float(system.d @ system.d)


def _damped(system: SquareRootInformation, damping: float) -> SquareRootInformation:
    """The system with rows that pull every increment to zero, in proportion to its curvature."""
    if damping == 0.0:
        return system
    n = system.layout.size
    rows = np.zeros((n, n + 1))
    np.fill_diagonal(rows, np.sqrt(damping) * np.linalg.norm(system.R, axis=0))
    return system.updated(rows)
