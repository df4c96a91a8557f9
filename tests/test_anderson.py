# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Accelerated steps end where the plain ones would, sooner."""

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnosis.anderson import AndersonSteps

GOAL = np.array([0.3, -1.0, 2.0])
PARTS = np.diag([0.2, 0.5, 0.9])
"""What each step takes off the distance along an axis."""
INFORMATION = np.diag([1.0, 4.0, 100.0])


def distances(accelerated: bool, count: int) -> list[float]:
    """Distances from the goal after each of some steps."""
    x, found, faster = np.zeros(3), list[float](), AndersonSteps()
    for _ in range(count):
        step: FloatArray = PARTS @ (GOAL - x)
        change = faster.change(step, INFORMATION) if accelerated else step
        x = x + change
        faster.made(change)
        found.append(float(np.linalg.norm(GOAL - x)))
    return found


def test_linear_steps_end_after_as_many_changes_as_there_are_unknowns() -> None:
    assert distances(accelerated=True, count=5)[-1] < 1e-9 < distances(False, 30)[-1]


def test_the_first_step_is_the_plain_one_and_so_is_that_after_a_longer_one() -> None:
    faster, step = AndersonSteps(), np.array([1.0, 0.0, 0.0])
    for longer in (1.0, 2.0, 3.0):
        np.testing.assert_array_equal(faster.change(longer * step, INFORMATION), longer * step)
        faster.made(longer * step)


def test_what_is_forgotten_does_not_count() -> None:
    faster, step = AndersonSteps(), np.array([1.0, 0.0, 0.0])
    faster.change(step, INFORMATION)
    faster.made(step)
    faster.forget()
    np.testing.assert_array_equal(faster.change(0.5 * step, INFORMATION), 0.5 * step)
