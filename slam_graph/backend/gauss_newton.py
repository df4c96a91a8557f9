# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2, Gauss-Newton: steps that minimise the cost.

Each step linearises every residual, stacks the rows under the prior's triangular factor, restores
the triangle by QR, and moves the estimates by the solution. The triangle of the last step is the
posterior Gaussian that marginalization works on. Levenberg-Marquardt adds rows that hold the step
back, and takes a step only if it lowers the cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_graph.backend.cost import Cost, Linearization
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.square_root import Layout, SquareRootInformation

FloatArray = NDArray[np.float64]

INITIAL_DAMPING = 1e-4
MAX_DAMPING = 1e6
MAX_REPEATED_STEPS = 4
"""How often a step is repeated at most where it is too large to be linear."""


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
    layout, costs = cost.layout(), [cost.value()]
    for step in range(policy.max_steps):
        if linear is None or step > 0:
            linear = cost.linearize()
        posterior, delta = _step(cost, linear, layout)
        costs.append(cost.value())
        if np.max(np.abs(delta), initial=0.0) < policy.tolerance:
            break
    minimum = Minimum(posterior, tuple(costs))
    return minimum if again is None else _repeated(cost, layout, minimum, delta, again)


def _step(
    cost: Cost, linear: Linearization, layout: Layout
) -> tuple[SquareRootInformation, FloatArray]:
    """Move a cost by one step: the posterior, at the new estimates, and the step (n,)."""
    posterior = _system(cost, linear, layout)
    delta = posterior.solution()
    cost.apply(delta, linear, layout)
    return posterior.shifted(delta), delta


def _repeated(
    cost: Cost, layout: Layout, minimum: Minimum, delta: FloatArray, again: Again
) -> Minimum:
    """Take more steps as long as the last one asks for it and they lower the cost."""
    while len(minimum.costs) <= MAX_REPEATED_STEPS and again(minimum.posterior, delta):
        before = cost.snapshot()
        posterior, delta = _step(cost, cost.linearize(), layout)
        value = cost.value()
        if not value < minimum.costs[-1]:
            cost.restore(before)
            break
        minimum = Minimum(posterior, (*minimum.costs, value), repeated=True)
    return minimum


def linearized(cost: Cost) -> SquareRootInformation:
    """A cost as a Gaussian over an increment of the current estimates."""
    return _system(cost, cost.linearize(), cost.layout())


def _system(cost: Cost, linear: Linearization, layout: Layout) -> SquareRootInformation:
    """The linearised cost as a Gaussian over an increment of the estimates."""
    rows = np.concatenate([cost.factor_rows(layout), cost.rows(linear, layout)])
    return cost.prior_at_estimate().updated(rows)


def _levenberg_marquardt(
    cost: Cost, policy: GaussNewtonPolicy, linear: Linearization | None
) -> Minimum:
    layout = cost.layout()
    linear = linear or cost.linearize()
    system, costs, damping = _system(cost, linear, layout), [cost.value()], INITIAL_DAMPING
    for _ in range(policy.max_steps):
        delta = _damped(system, damping).solution()
        before = cost.snapshot()
        cost.apply(delta, linear, layout)
        value = cost.value()
        if not value < costs[-1]:
            cost.restore(before)
            damping *= 10.0
            if damping > MAX_DAMPING:
                break
            continue
        gain = costs[-1] - value
        costs.append(value)
        linear = cost.linearize()
        system = _system(cost, linear, layout)
        damping = max(0.1 * damping, 1e-9)
        if gain < policy.tolerance * value:
            break
    return Minimum(system, tuple(costs))


def _damped(system: SquareRootInformation, damping: float) -> SquareRootInformation:
    """The system with rows that pull every increment to zero, in proportion to its curvature."""
    n = system.layout.size
    rows = np.zeros((n, n + 1))
    np.fill_diagonal(rows, np.sqrt(damping) * np.linalg.norm(system.R, axis=0))
    return system.updated(rows)
