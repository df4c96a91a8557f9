# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Squared sums that are cut off where normal noise seldom is, so that outliers count little."""

from __future__ import annotations

import numpy as np
import scipy  # its parts are imported when they are first used

from slam_graph.arrays import FloatArray


def winsorised(squares: FloatArray, dof: FloatArray, quantile: float) -> FloatArray:
    """Squares (J,) cut off at a quantile, with mean one under normal noise.

    Args:
        squares: (J,) in units of what is expected of them.
        dof: (J,) degrees of freedom of the χ² distributions that they have but for a factor.
        quantile: of these.
    """
    half = 0.5 * dof
    largest = scipy.special.gammaincinv(half, quantile)
    below = scipy.special.gammainc(half + 1.0, largest)
    expected = below + largest / half * (1.0 - quantile)
    return np.asarray(np.minimum(squares, largest / half) / expected, dtype=np.float64)
