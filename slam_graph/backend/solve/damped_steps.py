# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Damped Gauss-Newton steps (Levenberg-Marquardt) on any least-squares problem.

A problem keeps its own estimates and knows how to linearise itself, solve the damped normal
equations and move. `levenberg_marquardt` decides which steps are kept, how the damping λ follows
them, and when to stop:

    linearize at x
    repeat:  δ = solve(λ),  x ← x + δ
             cost lower:   keep x, less damping, linearize again
             otherwise:    undo, more damping

What λ multiplies (the diagonal of the information, or the identity) is the problem's choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


class DampedProblem(Protocol):
    """A cost over estimates that the problem keeps and moves."""

    def value(self) -> float:
        """The cost at the current estimates; infinite or NaN where it is not defined."""
        ...

    def linearize(self) -> None:
        """Linearise at the current estimates."""
        ...

    def solve(self, damping: float) -> float:
        """Solve the last linearisation with some damping, and keep the step.

        Returns:
            The decrease of the cost that the linearisation predicts; infinite if there is no
            solution (the problem is then not moved).
        """
        ...

    def apply(self) -> None:
        """Move the estimates by the last step."""
        ...

    def undo(self) -> None:
        """Take the last `apply` back."""
        ...


@dataclass(frozen=True, slots=True)
class Attempt:
    """One step that was tried.

    Attributes:
        before: cost before it.
        after: cost after it; infinite if the step had no solution.
        predicted: decrease of the cost that the linearisation predicted.
        damping: λ of the step.
    """

    before: float
    after: float
    predicted: float
    damping: float

    @property
    def accepted(self) -> bool:
        """Whether the step lowered the cost; only such steps are kept."""
        return self.after < self.before


class Damping(Protocol):
    """How the damping follows the steps."""

    @property
    def value(self) -> float:
        """λ of the next step."""
        ...

    @property
    def exhausted(self) -> bool:
        """Whether λ has grown so large that no step is worth trying."""
        ...

    def update(self, attempt: Attempt) -> None:
        """Set λ for the step that follows an attempt."""
        ...


class GainRatioDamping:
    """λ by how well the linearised cost predicts the true one (Nielsen 1999).

    Args:
        initial: λ of the first step.
        least: λ is never less.
        most: λ from which on no step is tried.
    """

    def __init__(self, initial: float, least: float = 1e-10, most: float = 1e12) -> None:
        self.value = initial
        self._growth = 2.0
        self._least, self._most = least, most

    @property
    def exhausted(self) -> bool:
        """Whether λ has reached its limit."""
        return self.value >= self._most

    def update(self, attempt: Attempt) -> None:
        """Less damping the better the prediction was, ever more after each rejected step."""
        if attempt.accepted:
            gain = (attempt.before - attempt.after) / attempt.predicted
            self.value *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            self.value, self._growth = max(self.value, self._least), 2.0
        else:
            self.value, self._growth = self.value * self._growth, 2.0 * self._growth


class TenfoldDamping:
    """No damping until a step is rejected; ten times as much after each one that is.

    Args:
        first: λ after the first rejected step.
        most: no step is tried after one with more was rejected.
        relief: factor on λ after a step that was kept.
        negligible: λ that is not larger than this becomes zero then; `first` if not given.
    """

    def __init__(
        self, first: float, most: float, relief: float = 0.1, negligible: float | None = None
    ) -> None:
        self.value = 0.0
        self.exhausted = False
        self._first, self._most, self._relief = first, most, relief
        self._negligible = first if negligible is None else negligible

    def update(self, attempt: Attempt) -> None:
        """Less damping after a step that was kept, more after one that was not."""
        if attempt.accepted:
            self.value = self._relief * self.value if self.value > self._negligible else 0.0
        elif self.value > self._most:
            self.exhausted = True
        else:
            self.value = max(10.0 * self.value, self._first)


@dataclass(frozen=True, slots=True)
class Steps:
    """What the steps came to.

    Attributes:
        costs: the cost before the first step, and after each step that was kept.
        rejected: how many steps did not lower the cost.
        converged: whether the steps ended because of what `levenberg_marquardt` was told.
    """

    costs: tuple[float, ...]
    rejected: int
    converged: bool

    @property
    def accepted(self) -> int:
        """How many steps were kept."""
        return len(self.costs) - 1


def levenberg_marquardt(
    problem: DampedProblem,
    max_attempts: int,
    converged: Callable[[Attempt], bool],
    damping: Damping,
    report: Callable[[Attempt], None] | None = None,
) -> Steps:
    """Take damped Gauss-Newton steps until the cost no longer falls.

    Args:
        problem: moved in place to the last estimates that lowered its cost.
        max_attempts: number of steps at most, rejected ones included.
        converged: whether a step, kept or rejected, is the last one.
        damping: λ, and how it follows the steps.
        report: is given each attempt.
    """
    costs, rejected = [problem.value()], 0
    linear = False
    while len(costs) - 1 + rejected < max_attempts and not damping.exhausted:
        if not linear:
            problem.linearize()
            linear = True
        after, predicted = math.inf, problem.solve(damping.value)
        if math.isfinite(predicted):
            problem.apply()
            after = problem.value()
        attempt = Attempt(costs[-1], after, predicted, damping.value)
        if attempt.accepted:
            costs.append(after)
            linear = False
        else:
            rejected += 1
            if math.isfinite(predicted):
                problem.undo()
        damping.update(attempt)
        if report is not None:
            report(attempt)
        if converged(attempt):
            return Steps(tuple(costs), rejected, True)
    return Steps(tuple(costs), rejected, False)
