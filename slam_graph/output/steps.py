# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The size of each frame's problem, how many steps it took, and what they did to the cost."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class StepLog:
    """A growing table with a row for each frame in which steps were taken."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._steps = array("l")
        self._columns = array("l")
        self._costs = array("d")

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def append(self, stamp_ns: int, costs: Sequence[float], columns: int) -> None:
        """Add a frame.

        Args:
            stamp_ns: its time.
            costs: before the first step and after each; at least one.
            columns: dimension of the state.
        """
        self._columns.append(columns)
        self._stamps_ns.append(stamp_ns)
        self._steps.append(len(costs) - 1)
        self._costs.extend((costs[0], costs[-1]))

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(N,) times of the frames."""
        return np.array(self._stamps_ns, dtype=np.int64)

    @property
    def steps(self) -> NDArray[np.int64]:
        """(N,) numbers of steps that were taken."""
        return np.array(self._steps, dtype=np.int64)

    @property
    def columns(self) -> NDArray[np.int64]:
        """(N,) dimensions of the state while the steps were taken."""
        return np.array(self._columns, dtype=np.int64)

    @property
    def costs(self) -> NDArray[np.float64]:
        """(N, 2) cost before the first step and after the last."""
        return np.array(self._costs, dtype=np.float64).reshape(-1, 2)
