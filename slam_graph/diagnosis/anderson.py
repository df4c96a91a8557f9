# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Faster convergence of steps that each take off a part of the distance (Anderson 1965).

Steps of reweighted least squares, whose derivatives leave out those of the weights, end linearly:
each is, say, 0.7 times the one before. How they changed along the last changes of the unknowns
tells where they vanish.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray

_DEPTH = 3
"""Most changes that are remembered."""


class AndersonSteps:
    """The changes of n unknowns by their last steps."""

    def __init__(self) -> None:
        self._step: FloatArray | None = None  # the last one
        self._size = np.inf  # its square, in units of the standard deviations
        self._change = np.zeros(0)  # what it led to
        self._changes: list[FloatArray] = []
        self._of_steps: list[FloatArray] = []

    def change(self, step: FloatArray, information: FloatArray) -> FloatArray:
        """The change (n,) that is to be tried instead of a step.

        After a step that is longer than the one before it begins anew.

        Args:
            step: (n,) that least squares ask for.
            information: (n, n) about the unknowns: the norm in which steps are to vanish.
        """
        size = float(step @ information @ step)
        if size > self._size:
            self.forget()
        self._size = size
        if self._step is not None:
            self._changes.append(self._change)
            self._of_steps.append(step - self._step)
            del self._changes[:-_DEPTH], self._of_steps[:-_DEPTH]
        self._step = step
        if not self._changes:
            return step
        root = np.linalg.cholesky(information).T
        by, steps = np.array(self._changes).T, np.array(self._of_steps).T
        parts = np.linalg.lstsq(root @ steps, root @ step, rcond=1e-6)[0]
        return np.asarray(step - (by + steps) @ parts)

    def made(self, change: FloatArray) -> None:
        """Note the change (n,) that was made."""
        self._change = change

    def forget(self) -> None:
        """Begin anew: steps before do not tell how the next ones change."""
        self._step, self._size = None, np.inf
        self._changes.clear()
        self._of_steps.clear()
