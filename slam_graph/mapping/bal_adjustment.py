# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of BAL problems: the loop of every algorithm here, with the policies of BA.

Cost construction takes all poses and features and no costs between poses, Gauss-Newton goes on
until convergence, and nothing is marginalised, so that one pass of the loop is all there is.
"""

from __future__ import annotations

import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.mapping.bal_checks import usable
from slam_graph.mapping.bal_cost import BalCost, construct, first_estimates
from slam_graph.mapping.bal_gauge import GAUGE_DIM, restored
from slam_graph.mapping.bal_policy import BalPolicy, BalSolution
from slam_graph.mapping.bal_problem import POSE_DIM, BalEstimates, BalPart, BalProblem
from slam_graph.mapping.bal_projection import project
from slam_graph.mapping.bal_steps import minimize


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
