# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Factor graphs of single frames: a stage that keeps those that are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeGuard

from slam_graph.backend import Estimator
from slam_graph.diagnostics import Diagnostics
from slam_graph.pipeline.stage import EstimatedFrame, Stage
from slam_graph.results import RunResult

_FIRST_STAMP = 1_000_000_000
"""Whole numbers from here on are stamps in nanoseconds."""


class GraphKeeping(Stage):
    """Keeps the factor graph of the first estimated frame at or after each time asked for.

    Args:
        result: gets the graphs.
        estimator: the back end.
        times: in seconds after the first frame of the run; whole numbers from 1e9 on are stamps
            in ns (a float cannot hold them).
        diagnostics: counts the times after the last state.
    """

    def __init__(
        self,
        result: RunResult,
        estimator: Estimator,
        times: Sequence[int | float],
        diagnostics: Diagnostics,
    ) -> None:
        self._result, self._estimator, self._diagnostics = result, estimator, diagnostics
        start_ns = result.input.start_ns
        self._stamps_ns = sorted(
            time if _is_stamp(time) else start_ns + round(time * 1e9) for time in times
        )

    def frame(self, frame: EstimatedFrame) -> None:
        """Keep the graph if it is time for one."""
        stamp_ns = frame.features.stamp_ns
        if frame.state is None or not self._stamps_ns or stamp_ns < self._stamps_ns[0]:
            return
        self._stamps_ns = [time for time in self._stamps_ns if time > stamp_ns]
        self._result.graphs[stamp_ns] = self._estimator.factor_graph()

    def finish(self) -> None:
        """Warn of times for which there was no state."""
        for stamp_ns in self._stamps_ns:
            self._diagnostics.warn("graph_not_saved", f"no state at or after {stamp_ns} ns")


def _is_stamp(time: int | float) -> TypeGuard[int]:
    """Whether a time is a stamp, not seconds."""
    return isinstance(time, int) and time >= _FIRST_STAMP
