# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Robust losses on the length of a whitened residual, for iteratively reweighted least squares.

With e the length in standard deviations and c the width of the loss, Huber's is quadratic up to c
and linear beyond, Cauchy's is c²/2 log(1 + e²/c²), whose weight vanishes for large e (Zhang 1997).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from slam_graph.arrays import FloatArray

LossName = Literal["none", "huber", "cauchy"]

WIDTH_2D = 2.45
"""The length that 95 % of all two-dimensional residuals without outliers do not exceed."""

MEDIAN_2D = math.sqrt(2.0 * math.log(2.0))
"""The length that half of them do not exceed."""

MEDIAN_1D = 0.6745
"""Median of the absolute value of a normal variable, in units of its standard deviation."""


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """A loss and its width.

    Attributes:
        name: which loss.
        width: from which length on residuals count less, in standard deviations.
    """

    name: LossName = "huber"
    width: float = WIDTH_2D

    @property
    def vanishes(self) -> bool:
        """Whether the weight of large residuals goes to zero, faster than they grow."""
        return self.name == "cauchy"

    def weights(self, error: FloatArray) -> FloatArray:
        """Weights (N,) of iteratively reweighted least squares for lengths (N,)."""
        if self.name == "huber":
            return self.width / np.maximum(error, self.width)
        if self.name == "cauchy":
            return 1.0 / (1.0 + (error / self.width) ** 2)
        return np.ones_like(error)

    def value(self, error: FloatArray) -> FloatArray:
        """The loss (N,) of lengths (N,); half the square without a robust one."""
        width = self.width
        if self.name == "huber":
            return np.where(error <= width, 0.5 * error**2, width * (error - 0.5 * width))
        if self.name == "cauchy":
            return np.asarray(0.5 * width**2 * np.log1p((error / width) ** 2), dtype=np.float64)
        return 0.5 * error**2
