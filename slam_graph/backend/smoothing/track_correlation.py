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
_AT_ONCE = 50
"""So many tracks are taken at once: more of them take memory, and no less time."""
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
    sizes = np.minimum(counts[longest], _MOST_OBSERVATIONS)
    for size in np.unique(sizes).tolist():  # tracks of the same length at once
        same = starts[longest[sizes == size]]
        for first in range(0, len(same), _AT_ONCE):
            rows = same[first : first + _AT_ONCE, None] + np.arange(size)
            sums += _sums(linear.r[rows], linear.by_point[rows], obs.camera[rows], obs.frame[rows])
    (square, *squares), (product, *products) = sums
    ratios = np.divide(products, squares)
    correlation = float(np.interp(product / square, ratios, _CORRELATIONS))
    variance = float(square / np.interp(correlation, _CORRELATIONS, squares))
    return max(variance * (1.0 + correlation) / (1.0 - correlation), 1.0)


def _sums(
    residuals: FloatArray, by_point: FloatArray, camera: IntArray, frame: IntArray
) -> FloatArray:
    """Sums (2, 1 + C) of squares and of neighbours: of some tracks, and expected for each ρ.

    Args:
        residuals: (T, n, 2) of T tracks with n observations each.
        by_point: (T, n, 2, 3) their derivatives by the points.
        camera: (T, n) of the observations.
        frame: (T, n) their keyframes.
    """
    tracks, n = camera.shape
    Q, _ = np.linalg.qr(by_point.reshape(tracks, 2 * n, 3))
    errors = residuals.reshape(tracks, 2 * n, 1)
    e = (errors - Q @ (Q.transpose(0, 2, 1) @ errors)).reshape(tracks, n, 2)
    together = camera[:, :, None] == camera[:, None]
    apart = np.abs(frame[:, :, None] - frame[:, None])
    L = np.where(together & (apart == 1), 0.5, 0.0)
    of_axes = [np.ascontiguousarray(Q[:, axis::2]) for axis in range(2)]
    LQ = [L @ part for part in of_axes]
    S = sum(part.transpose(0, 2, 1) @ own for part, own in zip(of_axes, LQ, strict=True))
    # L is the same on both axes, so that P L P = L - Q (L Q)ᵀ - (L Q) Qᵀ + Q (Qᵀ L Q) Qᵀ
    P, PLP = np.broadcast_to(2.0 * np.eye(n), L.shape).copy(), 2.0 * L
    for part, own in zip(of_axes, LQ, strict=True):
        P -= part @ part.transpose(0, 2, 1)
        half = (own - 0.5 * part @ S) @ part.transpose(0, 2, 1)
        PLP -= half + half.transpose(0, 2, 1)
    powers = _CORRELATIONS ** np.arange(apart.max() + 1)[:, None]
    lags = apart.ravel()
    expected = [np.bincount(lags, (M * together).ravel()) @ powers for M in (P, PLP)]
    return np.column_stack([[np.sum(e * e), np.sum(e * (L @ e))], expected])
