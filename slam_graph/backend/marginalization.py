# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 3, marginalization: variables leave, and the Gaussian prior that they leave behind.

min over (x_K, x_M) of c = min over x_K of (min over x_M of c): the inner minimum of the linearised
cost is again a quadratic in x_K, the marginal prior. A QR whose columns begin with x_M gives it
without forming the information matrix (see `SquareRootInformation.marginal`).
"""

from __future__ import annotations

from collections.abc import Sequence

from slam_graph.backend.policies import MarginalizationPolicy
from slam_graph.backend.square_root import SquareRootInformation
from slam_graph.backend.state import State


def marginalize(
    posterior: SquareRootInformation,
    state: State,
    keep: Sequence[int],
    policy: MarginalizationPolicy,
) -> SquareRootInformation:
    """Eliminate all variables but `keep` and make the rest the prior of the next step.

    Args:
        posterior: over an increment of the current estimates.
        state: the variables that leave are removed from it; those that stay keep the linearisation
            points that the prior was made with (first-estimates Jacobians), or, without that, are
            linearised anew at their estimates.
        keep: keys that stay, in the order of the new prior's columns.
        policy: whether first-estimates Jacobians are used.

    Returns:
        The prior as a function of the offsets of the estimates from their linearisation points.
    """
    prior = posterior.marginal(keep)
    state.remove([key for key in posterior.layout.dims if key not in prior.layout])
    if not policy.first_estimates:
        state.rebase()
    state.freeze(keep)  # the steps to come must not move what the prior is a function of
    return prior.shifted(-state.offset(prior.layout))
