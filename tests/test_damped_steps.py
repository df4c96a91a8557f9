# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt: laws of the loop, whatever the problem and the damping."""

from collections.abc import Callable

import numpy as np
import pytest

from slam_graph.arrays import FloatArray
from slam_graph.backend.solve.damped_steps import (
    Attempt,
    Damping,
    GainRatioDamping,
    TenfoldDamping,
    levenberg_marquardt,
)

DAMPINGS: dict[str, Callable[[], Damping]] = {
    "gain_ratio": lambda: GainRatioDamping(1e-4),
    "tenfold": lambda: TenfoldDamping(1e-4, 1e6),
}


class Residuals:
    """Half the squared residuals of a function of x, damped relative to the diagonal."""

    def __init__(
        self,
        residuals: Callable[[FloatArray], FloatArray],
        jacobian: Callable[[FloatArray], FloatArray],
        start: FloatArray,
    ) -> None:
        self.x = self.before = start
        self.linearizations = 0
        self._residuals, self._jacobian = residuals, jacobian

    def value(self) -> float:
        return 0.5 * float(np.sum(self._residuals(self.x) ** 2))

    def linearize(self) -> None:
        self.linearizations += 1
        J, r = self._jacobian(self.x), self._residuals(self.x)
        self.H, self.g = J.T @ J, J.T @ r

    def solve(self, damping: float) -> float:
        damped = self.H + damping * np.diag(np.diag(self.H))
        try:
            self.step = -np.linalg.solve(damped, self.g)
        except np.linalg.LinAlgError:
            return np.inf
        return float(-self.g @ self.step - 0.5 * self.step @ self.H @ self.step)

    def apply(self) -> None:
        self.before, self.x = self.x, self.x + self.step

    def undo(self) -> None:
        self.x = self.before


def rosenbrock(start: FloatArray) -> Residuals:
    return Residuals(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
        start,
    )


def small_cost(attempt: Attempt) -> bool:
    return attempt.after <= 1e-14


@pytest.mark.parametrize("damping", DAMPINGS)
def test_it_descends_to_the_minimum(damping: str) -> None:
    problem = rosenbrock(np.array([-1.2, 1.0]))
    steps = levenberg_marquardt(problem, 200, small_cost, DAMPINGS[damping]())
    assert steps.converged
    assert np.all(np.diff(steps.costs) < 0)
    assert steps.costs[-1] == problem.value()
    np.testing.assert_allclose(problem.x, [1.0, 1.0], atol=1e-6)
    # one linearisation for each step that was kept: rejected steps use the last one again
    assert problem.linearizations == steps.accepted


def test_a_linear_problem_takes_one_step_without_damping() -> None:
    rng = np.random.default_rng(0)
    A, b = rng.standard_normal((8, 3)), rng.standard_normal(8)
    problem = Residuals(lambda x: A @ x - b, lambda x: A, np.zeros(3))
    attempts: list[Attempt] = []
    damping = TenfoldDamping(1e-4, 1e6)
    levenberg_marquardt(problem, 1, lambda _: False, damping, attempts.append)
    np.testing.assert_allclose(problem.x, np.linalg.lstsq(A, b, rcond=None)[0], atol=1e-12)
    (attempt,) = attempts
    assert attempt.before - attempt.after == pytest.approx(attempt.predicted)


@pytest.mark.parametrize("damping", DAMPINGS)
def test_a_step_that_does_not_lower_the_cost_is_undone(damping: str) -> None:
    start = np.array([0.7, -0.3])
    problem = Residuals(lambda x: np.array([1.0, *(x - start)]), lambda x: np.eye(3, 2), start)
    steps = levenberg_marquardt(problem, 1000, lambda _: False, DAMPINGS[damping]())
    assert steps.accepted == 0
    assert not steps.converged
    assert steps.rejected < 1000  # the damping is exhausted before
    assert np.array_equal(problem.x, start)


@pytest.mark.parametrize("damping", DAMPINGS)
def test_a_singular_problem_is_left_where_it_is(damping: str) -> None:
    problem = Residuals(lambda x: x[:1] ** 2 + 1.0, lambda x: np.zeros((1, 2)), np.ones(2))
    steps = levenberg_marquardt(problem, 100, lambda _: False, DAMPINGS[damping]())
    assert steps.accepted == 0
    assert np.array_equal(problem.x, np.ones(2))
