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
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation

INITIAL_DAMPING = 1e-4
MAX_DAMPING = 1e6
MAX_REPEATED_STEPS = 4
"""Steps in all, at most, where the calibration moves too far for the first to be linear."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """What the steps have come to.

    Attributes:
        posterior: over an increment of the final estimates, linearised where the last step was.
        costs: the cost before the first step and after each step that was taken.
        repeated: whether there were more steps than the policy has, because one was too large.
    """

    posterior: SquareRootInformation
    costs: tuple[float, ...]
    repeated: bool = False


Again = Callable[[SquareRootInformation, FloatArray], bool]
"""Whether a step (n,) under its posterior asks for one more."""


def minimize(
    cost: Cost,
    policy: GaussNewtonPolicy,
    linear: Linearization | None = None,
    again: Again | None = None,
) -> Minimum:
    """Take steps on a cost.

    Args:
        cost: moved in place: its state, and its new features.
        policy: kind and number of steps.
        linear: the linearisation at the current estimates, where it is known already.
        again: asks for more steps than the policy has, up to `MAX_REPEATED_STEPS` in all.

    Raises:
        numpy.linalg.LinAlgError: if the cost leaves a variable undetermined.
    """
    if policy.damping == "levenberg_marquardt":
        return _levenberg_marquardt(cost, policy, linear)
    layout, before = cost.layout(), cost.value()
    posterior, delta = _step(cost, linear or cost.linearize(summed=True), layout)
    minimum = Minimum(posterior, (before, cost.value()))
    while _another(policy, minimum, delta, again):
        undo = cost.snapshot()
        posterior, delta = _step(cost, cost.linearize(summed=True), layout)
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
    return again is not None and steps < MAX_REPEATED_STEPS and again(minimum.posterior, delta)


def _step(
    cost: Cost, linear: Linearization, layout: Layout
) -> tuple[SquareRootInformation, FloatArray]:
    """Move a cost by one step: the posterior, at the new estimates, and the step (n,)."""
    posterior = _system(cost, linear, layout)
    delta = posterior.solution()
    cost.apply(delta, linear, layout)
    return posterior.shifted(delta), delta


def linearized(cost: Cost) -> SquareRootInformation:
    """A cost as a Gaussian over an increment of the current estimates."""
    return _system(cost, cost.linearize(summed=True), cost.layout())


def _system(cost: Cost, linear: Linearization, layout: Layout) -> SquareRootInformation:
    """The linearised cost as a Gaussian over an increment of the estimates."""
    rows = np.concatenate([cost.factor_rows(layout), cost.rows(linear, layout)])
    return cost.prior_at_estimate().updated(rows)


def _levenberg_marquardt(
    cost: Cost, policy: GaussNewtonPolicy, linear: Linearization | None
) -> Minimum:
    """Gauss-Newton steps, with damping from the first one on that does not lower the cost."""
    layout = cost.layout()
    linear = linear or cost.linearize(summed=True)
    system, costs, damping = _system(cost, linear, layout), [cost.value()], 0.0
    for left in reversed(range(policy.max_steps)):
        delta = _damped(system, damping).solution()
        before = cost.snapshot()
        cost.apply(delta, linear, layout)
        value = cost.value()
        if not value < costs[-1]:
            cost.restore(before)
            if _promised(system) < policy.tolerance * costs[-1] or damping > MAX_DAMPING:
                break
            damping = max(10.0 * damping, INITIAL_DAMPING)
            continue
        gain = costs[-1] - value
        costs.append(value)
        if left == 0 or max(gain, 0.0 if damping else _promised(system)) < policy.tolerance * value:
            return Minimum(system.shifted(delta), tuple(costs))
        linear = cost.linearize(summed=True)
        system = _system(cost, linear, layout)
        damping = 0.1 * damping if damping > INITIAL_DAMPING else 0.0
    return Minimum(system, tuple(costs))


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
