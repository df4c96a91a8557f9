# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of bundle adjustment (a row of the table of policies).

Cost construction: all poses and features, no pose costs. Gauss-Newton: until convergence.
Marginalization: none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from slam_graph.backend import RobustLoss
from slam_graph.settings import Settings, expert

Intrinsics = Literal["per_camera", "shared", "fixed"]
Robust = Literal["none", "huber", "cauchy"]


class BalCostPolicy(Settings):
    """Module 1: all cameras, all points, and the loss of a residual."""

    intrinsics: Intrinsics = "per_camera"
    """Which intrinsics (focal length and distortion) are estimated: per_camera (photographs from
    many cameras), shared (one camera took them all; begins at their median), or fixed."""
    robust: Robust = "none"
    """Robust loss of the reprojection errors: huber or cauchy where observations contain outliers;
    both take more steps, and cauchy needs a good start."""
    robust_width_px: float = expert(2.45, gt=0)
    """Reprojection error beyond which the robust loss grows more slowly than the square (2.45: the
    95 % circle of a noise of 1 px)."""

    @property
    def loss(self) -> RobustLoss:
        """The loss as the back end has it, for errors in pixels."""
        return RobustLoss(self.robust, self.robust_width_px)


class BalStepsPolicy(Settings):
    """Module 2: Levenberg-Marquardt steps."""

    moved: ClassVar[Mapping[str, str]] = {
        "initial_damping": "is a constant now: INITIAL_DAMPING in bundle_adjustment/bal_solve.py"
    }

    max_steps: int = expert(100, ge=1)
    """Largest number of steps, rejected ones included."""
    tolerance: float = expert(1e-6, gt=0)
    """Steps end when the relative decrease of the cost is less."""


class BalPolicy(Settings):
    """Bundle adjustment as a row of the table."""

    cost: BalCostPolicy = BalCostPolicy()
    """Cost construction."""
    gauss_newton: BalStepsPolicy = BalStepsPolicy()
    """Gauss-Newton steps, damped."""
