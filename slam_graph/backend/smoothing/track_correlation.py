# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How far the errors of a track are correlated over time: its statistical inefficiency.

A patch that is tracked slides slowly off its point, so that the error of one observation is nearly
that of the one before. Taken for white noise, the many observations of a track make covariances far
too small. The model is an autoregressive process of first order in each camera,

    E[ε_s ε_t] = σ² ρ^|s - t|,

over keyframes s and t. The mean of many such errors has the variance of white noise with
σ² (1 + ρ) / (1 - ρ). By this factor, the statistical inefficiency, the information of the images is
too large (Bartlett 1946, effective sample size). It is exact for errors that are slow beside
1 / (1 - ρ) keyframes, such as drift, and too large for those from one keyframe to the next. White
noise beside such errors hides a part of them; tracks in images show none.

At the minimum, what can be seen of ε are the residuals e = P ε, P = I - Q Qᵀ the projection off the
three directions of the point of the track, which takes most of what is slow. So ρ and σ are those
whose expected sums tr(P Σ P) and tr(P L P Σ P), L the mean over neighbours in time, are the sums
eᵀ e and eᵀ L e of the residuals (method of moments). Errors of the poses are neglected.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.smoothing.recording_cost import LinearReprojection

_TRACKS = 200
"""The longest tracks that the correlation is read from."""
_LEAST_OBSERVATIONS, _MOST_OBSERVATIONS = 8, 64
"""Shorter tracks tell nothing, as their points follow their errors. Of longer ones the first
observations are taken, which is enough, as the time grows with the cube of their number."""
_CORRELATIONS = np.concatenate([[0.0], np.arange(0.1, 0.96, 0.05)])
"""Values of ρ between which expected sums are interpolated. Errors that are still slower hardly
change within a track, and its point follows them."""


def statistical_inefficiency(linear: LinearReprojection) -> float:
    """Variance of slow errors of tracks over that of white noise, σ² (1 + ρ) / (1 - ρ).

    Args:
        linear: the reprojection errors at the minimum, whitened with the standard deviation of
            white noise, which σ is relative to.

    Returns:
        The statistical inefficiency, at least one.
    """
    obs, starts = linear.obs, linear.obs.starts
    counts = np.diff(starts)
    longest = np.argsort(-counts, kind="stable")[:_TRACKS]
    longest = longest[counts[longest] >= _LEAST_OBSERVATIONS]
    if len(longest) == 0:
        return 1.0
    sums = np.zeros((2, 1 + len(_CORRELATIONS)))
    for track in longest:
        begin = starts[track]
        rows = slice(begin, begin + min(counts[track], _MOST_OBSERVATIONS))
        residuals, by_point = linear.r[rows], linear.by_point[rows]
        sums += _sums(residuals, by_point, obs.camera[rows], obs.frame[rows])
    (square, *squares), (product, *products) = sums
    ratios = np.divide(products, squares)
    correlation = float(np.interp(product / square, ratios, _CORRELATIONS))
    variance = float(square / np.interp(correlation, _CORRELATIONS, squares))
    return max(variance * (1.0 + correlation) / (1.0 - correlation), 1.0)


def _sums(
    residuals: FloatArray, by_point: FloatArray, camera: IntArray, frame: IntArray
) -> FloatArray:
    """Sums (2, 1 + C) of squares and of neighbours: of a track, and expected for each ρ."""
    Q, _ = np.linalg.qr(by_point.reshape(-1, 3))
    P = np.eye(len(Q)) - Q @ Q.T
    e = P @ residuals.ravel()
    together = camera[:, None] == camera
    apart = np.abs(frame[:, None] - frame)
    L = np.kron(np.where(together & (apart == 1), 0.5, 0.0), np.eye(2))
    powers = _CORRELATIONS ** np.arange(apart.max() + 1)[:, None]
    expected = []
    for M in (P, P @ L @ P):
        products = M[0::2, 0::2] + M[1::2, 1::2]
        sums = np.bincount(apart[together], products[together], len(powers))
        expected.append(sums @ powers)
    return np.column_stack([[e @ e, e @ L @ e], expected])
