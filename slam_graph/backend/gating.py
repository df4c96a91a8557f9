# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The Mahalanobis (χ²) gate: is a residual as large as its predicted covariance allows?"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

FloatArray = NDArray[np.float64]


def squared_mahalanobis(r: FloatArray, H: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis distances of whitened residuals.

    Args:
        r: (J, m) residuals in standard deviations of their measurement noise.
        H: (J, m, n) their derivatives by the state.
        covariance: (n, n) of the state, or (J, n, n).

    Returns:
        (J,) rᵀ (H P Hᵀ + I)⁻¹ r; χ² distributed with m degrees of freedom.
    """
    S = H @ covariance @ H.transpose(0, 2, 1) + np.eye(H.shape[1])
    distances: FloatArray = np.einsum("ji,ji->j", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
    return distances


def threshold(dof: NDArray[np.int64], confidence: float) -> FloatArray:
    """The χ² quantile for each number of degrees of freedom."""
    table = _quantiles(int(dof.max(initial=1)), confidence)
    return table[dof]


@lru_cache(maxsize=64)
def _quantiles(largest: int, confidence: float) -> FloatArray:
    # the quantile of χ² with k degrees of freedom is 2 P⁻¹(k/2, p), P the incomplete gamma function
    return np.concatenate([[0.0], 2.0 * gammaincinv(0.5 * np.arange(1, largest + 1), confidence)])
