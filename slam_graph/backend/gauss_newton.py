# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 2, Gauss-Newton: steps that minimise the cost.

Each step linearises every residual, stacks the rows under the prior's triangular factor, restores
the triangle by QR, and moves the estimates by the solution. The triangle of the last step is the
posterior Gaussian that marginalization works on.
"""

from __future__ import annotations

import numpy as np

from slam_graph.backend.cost import Cost, Linearization
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.square_root import SquareRootInformation


def minimize(
    cost: Cost, policy: GaussNewtonPolicy, linear: Linearization | None = None
) -> SquareRootInformation:
    """Take Gauss-Newton steps on a cost.

    Args:
        cost: moved in place: its state, and its new features.
        policy: how many steps.
        linear: the linearisation at the current estimates, where it is known already.

    Returns:
        The posterior over an increment of the final estimates, linearised where the last step was.

    Raises:
        numpy.linalg.LinAlgError: if the cost leaves a variable undetermined.
    """
    layout = cost.layout()
    for step in range(policy.max_steps):
        if linear is None or step > 0:
            linear = cost.linearize()
        rows = np.concatenate([cost.factor_rows(layout), cost.rows(linear, layout)])
        posterior = cost.prior_at_estimate().updated(rows)
        delta = posterior.solution()
        cost.apply(delta, linear, layout)
        posterior = posterior.shifted(delta)
    return posterior
