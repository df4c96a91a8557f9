# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The solution of a bundle adjustment: the estimates, and how well they fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.bundle_adjustment.bal_cost import reprojection_errors
from slam_graph.bundle_adjustment.bal_file import bal_lines
from slam_graph.bundle_adjustment.bal_problem import BalEstimates, BalPart, BalProblem, usable
from slam_graph.diagnostics import Diagnostics
from slam_graph.display import Displayed


@dataclass(frozen=True, slots=True, eq=False)
class BalMinimum:
    """Where the steps ended.

    Attributes:
        estimates: of the cameras and points in the cost.
        start_cost: half the sum of squared reprojection errors (or of their loss) at the start.
        cost: the same at the end.
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


@dataclass(frozen=True, eq=False, repr=False)
class BalSolution(Displayed):
    """The result of a bundle adjustment.

    Attributes:
        problem: the whole problem.
        part: the part of it that was in the cost.
        minimum: where the steps ended.
        estimates: of all cameras and points; those that were not in the cost are unchanged.
    """

    problem: BalProblem
    part: BalPart
    minimum: BalMinimum
    estimates: BalEstimates

    @staticmethod
    def unsolved(problem: BalProblem) -> BalSolution:
        """A problem as it is: what could be adjusted of it, with its own estimates.

        Raises:
            DataError: if nothing of it can be estimated.
        """
        return BalSolution.of(problem, problem.estimates)

    @staticmethod
    def of(problem: BalProblem, estimates: BalEstimates) -> BalSolution:
        """Estimates that come from elsewhere, e.g. from a file, as a solution.

        Args:
            problem: as it was.
            estimates: of all its cameras and points.

        Raises:
            DataError: if nothing of it can be estimated.
        """
        part = usable(problem, Diagnostics())
        minimum = BalMinimum(part.problem.estimates, np.nan, np.nan, 0, 0, False)
        return BalSolution(problem, part, minimum, estimates)

    @property
    def is_solved(self) -> bool:
        """Whether the estimates are others than those of the problem."""
        return self.estimates is not self.problem.estimates

    def __repr__(self) -> str:
        part, minimum = self.part.problem, self.minimum
        return (
            f"BalSolution({self.problem.name}: {part.cameras} cameras, {part.points} points, "
            f"cost {minimum.cost:.6g}, {'' if minimum.converged else 'not '}converged)"
        )

    def _facts(self) -> dict[str, object]:
        minimum, rms = self.minimum, {k: np.sqrt(np.mean(e**2)) for k, e in self.errors_px.items()}
        return {
            "problem": self.problem,
            "cost": f"{minimum.start_cost:.6g} to {minimum.cost:.6g}",
            "reprojection RMS": f"{rms['before']:.4g} to {rms['after']:.4g} px",
            "steps": f"{minimum.steps}, {'' if minimum.converged else 'not '}converged",
        }

    def plot(self) -> Any:
        """The scene from three sides, and a histogram of the reprojection errors, as a figure."""
        part, adjusted = self.part.problem, self.adjusted
        return self._drawn_by("bundle_picture").bundle_figure(
            f"{self.problem.name}  ·  {part.cameras} cameras, {part.points} points, "
            f"{len(part.camera)} observations",
            adjusted.points,
            adjusted.centres(),
            self.errors_px,
        )

    def _sketch(self) -> Any:
        return self.plot()

    @cached_property
    def adjusted(self) -> BalEstimates:
        """The estimates of the cameras and points that were in the cost."""
        return self.estimates.select(self.part.cameras, self.part.points)

    @cached_property
    def errors_px(self) -> dict[str, FloatArray]:
        """Reprojection errors of the observations in the cost: (N,) before and after."""
        problem = self.part.problem
        return {
            "before": reprojection_errors(problem, problem.estimates),
            "after": reprojection_errors(problem, self.adjusted),
        }

    def problem_lines(self) -> Iterator[str]:
        """The whole problem as it was read, in BAL's format."""
        return bal_lines(self.problem, self.problem.estimates)

    def lines(self) -> Iterator[str]:
        """The whole problem with its estimates, in BAL's format."""
        return bal_lines(self.problem, self.estimates)
