# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The row of bundle adjustment in the table of policies, for problems in BAL's format.

Cost construction: all poses and features, no pairwise pose costs. Gauss-Newton: until convergence.
Marginalization: none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.bundle_adjustment.bal_problem import BalEstimates, BalPart, BalProblem
from slam_graph.settings.base import Settings

Intrinsics = Literal["per_camera", "shared", "fixed"]
Robust = Literal["none", "huber", "cauchy"]


class BalCostPolicy(Settings):
    """Module 1: all cameras, all points, and how a residual counts."""

    intrinsics: Intrinsics = "per_camera"
    """Focal length and distortion: estimated for each camera, once for all (from their median), or
    left as they are."""
    robust: Robust = "none"
    """Loss that weighs down large reprojection errors."""
    robust_width_px: float = Field(2.45, gt=0)
    """Width of the robust loss on the length of a reprojection error (2.45: the 95 % circle of
    a noise of 1 px)."""

    @property
    def loss(self) -> RobustLoss:
        """The loss as the back end has it, for errors in pixels."""
        return RobustLoss(self.robust, self.robust_width_px)


class BalStepsPolicy(Settings):
    """Module 2: Levenberg-Marquardt steps."""

    max_steps: int = Field(100, ge=1)
    """Number of steps at most, rejected ones included."""
    tolerance: float = Field(1e-6, gt=0)
    """Steps end when the cost falls by less, relative to its value."""
    initial_damping: float = Field(1e-4, gt=0)
    """Damping of the first step, relative to the diagonal of the information."""


class BalPolicy(Settings):
    """Bundle adjustment as a row of the table."""

    cost: BalCostPolicy = BalCostPolicy()
    """Cost construction."""
    gauss_newton: BalStepsPolicy = BalStepsPolicy()
    """Gauss-Newton steps, damped."""


@dataclass(frozen=True, slots=True, eq=False)
class BalMinimum:
    """Where steps have led to.

    Attributes:
        estimates: of the cameras and points in the cost.
        start_cost: half the squared reprojection errors under the loss, at the start.
        cost: the same in the end.
        steps: number of steps, rejected ones included.
        rejected: how many steps did not lower the cost.
        converged: whether the cost stopped falling before the number of steps was used up.
    """

    estimates: BalEstimates
    start_cost: float
    cost: float
    steps: int
    rejected: int
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class BalSolution:
    """What came of a bundle adjustment.

    Attributes:
        problem: the whole problem.
        part: what of it was in the cost.
        minimum: what the steps have led to.
        estimates: of all cameras and points; those that were not in the cost are as they were.
    """

    problem: BalProblem
    part: BalPart
    minimum: BalMinimum
    estimates: BalEstimates
