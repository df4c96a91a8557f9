# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The seven figures that summarise a series of errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Statistics:
    """Summary of N errors, in their unit (`sse`: in its square).

    Attributes:
        rmse: root of the mean square.
        mean: arithmetic mean.
        median: middle value.
        std: standard deviation, divided by N.
        min: smallest.
        max: largest.
        sse: sum of squares.
    """

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float

    @staticmethod
    def of(errors: NDArray[np.float64]) -> Statistics:
        """The statistics of (N,) errors, N ≥ 1."""
        squares = errors * errors
        return Statistics(
            rmse=float(np.sqrt(squares.mean())),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            std=float(errors.std()),
            min=float(errors.min()),
            max=float(errors.max()),
            sse=float(squares.sum()),
        )
