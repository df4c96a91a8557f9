# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How far the bundle adjustment of a recording is, as a number of keyframes.

Nobody knows how many steps a minimisation will take. The number of minimisations is known better:
rounds of fusion, one with outliers if there is need, one without, one with correlated errors of
tracks, and steps that learn the noise of the IMU. Each has the same share, of which every step
takes a fixed part of what is left. So the progress never stands still, never goes back, and reaches
the end only at the end.
"""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[int, int, int], None]
"""Is given after each step: keyframes that are done, all keyframes, steps so far."""

_FUSION = 0.35
"""Part of the time that fusion takes; measured on recordings of 30 s."""
_PASSES = 4
"""Minimisations after fusion, and the steps that learn the noise of the IMU."""
_ROUND, _STEP = 0.5, 0.4
"""Part of what is left that a round of fusion, and a step of a minimisation, is taken to do."""


class SegmentProgress:
    """Reports the steps of a segment as keyframes of the whole recording.

    Args:
        report: is given the progress.
        done: keyframes that were adjusted before this segment.
        own: keyframes that this segment adds to them.
        keyframes: number of all keyframes.
        steps: that were taken before this segment.
        fuses: whether fusion comes first.
    """

    def __init__(
        self,
        report: Report,
        done: int,
        own: int,
        keyframes: int,
        *,
        steps: int,
        fuses: bool,
    ) -> None:
        self._report, self._keyframes, self._steps = report, keyframes, steps
        self._done, self._own = done, own
        self._fusion = _FUSION if fuses else 0.0
        self._part = 0.0
        self._pass = 0
        self._before = 0

    def fusing(self, steps: int, rounds: int) -> None:
        """A step of fusion was taken.

        Args:
            steps: of this segment so far.
            rounds: that are complete.
        """
        left = (1.0 - _ROUND) ** (rounds + self._within(steps, rounds))
        self._tell(steps, self._fusion * (1.0 - left))

    def solving(self, steps: int, passes: int) -> None:
        """A step of a later minimisation was taken.

        Args:
            steps: of this segment so far.
            passes: minimisations after fusion that are complete.
        """
        part = min((passes + self._within(steps, passes)) / _PASSES, 1.0)
        self._tell(steps, self._fusion + (1.0 - self._fusion) * part)

    def _within(self, steps: int, number: int) -> float:
        """The part of the current minimisation that is done."""
        if number != self._pass:
            self._pass, self._before = number, steps - 1
        return float(1.0 - (1.0 - _STEP) ** max(steps - self._before, 1))

    def _tell(self, steps: int, part: float) -> None:
        self._part = max(self._part, part)
        done = min(self._done + int(self._part * self._own), self._keyframes - 1)
        self._report(done, self._keyframes, self._steps + steps)
