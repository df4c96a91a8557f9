# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt over a recording, with factors that serve several steps.

A factor costs many times as much as a gradient and a solution by it. After a step that hardly
changes the cost, or changes it as predicted, the factor is nearly that of the new estimates, and
steps by it converge, linearly and fast (the chord method: Kelley 1995, ch. 5). Only the states keep
their factor: features, which cost little and change most, are eliminated anew in each step.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from slam_graph.backend.smoothing.recording_cost import Estimates, Factor, RecordingCost
from slam_graph.backend.smoothing.state_elimination import EliminatedStates
from slam_graph.errors import EstimationError

_FIRST_DAMPING = 1e-5
_MAX_DAMPING = 1e5
"""Steps end when the damping exceeds this."""
_SMALL_STEP = 0.02
"""A factor is kept after a step that lowers the cost by less than this part of it."""
_AGREEMENT = 0.1
"""A new factor is also kept if its step lowers the cost by what it predicts but for this part."""
_CONTRACTION = 0.2
"""An earlier factor is kept only as long as each step lowers the cost by less than this part of
what the step before did."""
_CAUTION = 0.01
"""Steps by an earlier factor converge linearly. They end when the steps that would follow,
contracting as the last two did, would lower the cost by less than this part of the tolerance."""


def minimized(
    cost: RecordingCost,
    estimates: Estimates,
    tolerance: float,
    max_steps: int,
    count_step: Callable[[], None],
) -> tuple[Estimates, float, EliminatedStates | None]:
    """Go to the minimum of a cost.

    Args:
        cost: the cost.
        estimates: where to start.
        tolerance: steps end when the relative decrease of the cost is less.
        max_steps: largest number of steps.
        count_step: is called after each step.

    Returns:
        The minimum, the cost there, and the factor by which the last step was taken; None if
        another one was tried in vain afterwards, or if it was damped more than the first.

    Raises:
        EstimationError: if the cost is not finite.
    """
    value, damping = cost.value(estimates), _FIRST_DAMPING
    damped = damping
    factor: Factor | None = None
    known: EliminatedStates | None = None
    before, chord = math.inf, 0
    for _ in range(max_steps):
        linear = cost.linearized(estimates)
        while True:
            fresh = factor is None
            try:
                if factor is None:
                    known = None  # it is large
                    factor, damped = linear.factor(damping), damping
                else:
                    factor = factor.renewed(linear, damped)
                step = factor.step(linear)
                moved = estimates.moved(step)
                # an earlier factor that predicts more than all of the cost is not that of this one
                after = cost.value(moved) if fresh or step.predicted <= value else math.nan
            except (np.linalg.LinAlgError, RuntimeError):
                after = math.nan
            if after <= value or damping > _MAX_DAMPING:
                break
            factor = None
            damping *= 10.0 if fresh else 1.0
        if factor is None or not after <= value:
            break
        known = factor.states if damped <= _FIRST_DAMPING else None
        decrease, estimates, value = value - after, moved, after
        count_step()
        chord = 0 if fresh else chord + 1
        rate = min(decrease / before, 0.5) if chord > 1 else 0.5
        left = decrease * rate / (1.0 - rate)  # what is gained if steps go on contracting like this
        if (decrease if fresh else left / _CAUTION) <= tolerance * value:
            break
        damping *= 0.1 if fresh else 1.0
        slow = not fresh and decrease > _CONTRACTION * before
        as_predicted = abs(decrease - step.predicted) < _AGREEMENT * step.predicted
        if slow or (decrease > _SMALL_STEP * value and not (fresh and as_predicted)):
            factor = None
        before = decrease
    if not math.isfinite(value):
        raise EstimationError("the cost of the bundle adjustment is not finite")
    return estimates, value, known
