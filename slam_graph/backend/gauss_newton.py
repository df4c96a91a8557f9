# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2, Gauss-Newton: steps that minimise the cost.

Each step linearises every residual, stacks the rows under the prior's triangular factor, restores
the triangle by QR, and moves the estimates by the solution. The triangle of the last step is the
posterior Gaussian that marginalization works on. Levenberg-Marquardt adds rows that hold the step
back, and takes a step only if it lowers the cost.
"""

from __future__ import annotations

import numpy as np

from slam_graph.backend.cost import Cost, Linearization
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.square_root import Layout, SquareRootInformation

INITIAL_DAMPING = 1e-4
MAX_DAMPING = 1e6


def minimize(
    cost: Cost, policy: GaussNewtonPolicy, linear: Linearization | None = None
) -> SquareRootInformation:
    """Take steps on a cost.

    Args:
        cost: moved in place: its state, and its new features.
        policy: kind and number of steps.
        linear: the linearisation at the current estimates, where it is known already.

    Returns:
        The posterior over an increment of the final estimates, linearised where the last step was.

    Raises:
        numpy.linalg.LinAlgError: if the cost leaves a variable undetermined.
    """
    if policy.damping == "levenberg_marquardt":
        return _levenberg_marquardt(cost, policy, linear)
    layout = cost.layout()
    for step in range(policy.max_steps):
        if linear is None or step > 0:
            linear = cost.linearize()
        posterior = _system(cost, linear, layout)
        delta = posterior.solution()
        cost.apply(delta, linear, layout)
        posterior = posterior.shifted(delta)
        if np.max(np.abs(delta), initial=0.0) < policy.tolerance:
            break
    return posterior


def linearized(cost: Cost) -> SquareRootInformation:
    """A cost as a Gaussian over an increment of the current estimates."""
    return _system(cost, cost.linearize(), cost.layout())


def _system(cost: Cost, linear: Linearization, layout: Layout) -> SquareRootInformation:
    """The linearised cost as a Gaussian over an increment of the estimates."""
    rows = np.concatenate([cost.factor_rows(layout), cost.rows(linear, layout)])
    return cost.prior_at_estimate().updated(rows)


def _levenberg_marquardt(
    cost: Cost, policy: GaussNewtonPolicy, linear: Linearization | None
) -> SquareRootInformation:
    layout = cost.layout()
    linear = linear or cost.linearize()
    system, error, damping = _system(cost, linear, layout), cost.error(linear), INITIAL_DAMPING
    for _ in range(policy.max_steps):
        delta = _damped(system, damping).solution()
        before = cost.snapshot()
        cost.apply(delta, linear, layout)
        trial = cost.linearize()
        trial_error = cost.error(trial)
        if not trial_error < error:
            cost.restore(before)
            damping *= 10.0
            if damping > MAX_DAMPING:
                break
            continue
        gain, error, linear = error - trial_error, trial_error, trial
        system = _system(cost, linear, layout)
        damping = max(0.1 * damping, 1e-9)
        if gain < policy.tolerance * error:
            break
    return system


def _damped(system: SquareRootInformation, damping: float) -> SquareRootInformation:
    """The system with rows that pull every increment to zero, in proportion to its curvature."""
    n = system.layout.size
    rows = np.zeros((n, n + 1))
    np.fill_diagonal(rows, np.sqrt(damping) * np.linalg.norm(system.R, axis=0))
    return system.updated(rows)
