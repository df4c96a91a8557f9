# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which matches of features are true: by one drift of all of them, and by how well each one fits.

The mathematics is described where it is used (`backend/smoothing/projected_matches.py`).
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "drift_consensus",
    "drift_consensus_numpy",
    "mixture_probabilities",
    "mixture_probabilities_numpy",
]

_NO_CHANCE = 1e-300
"""Keeps probabilities defined where both densities vanish."""


@compiled("f8[::1](f8[::1], f8[::1], f8[::1], f8, i8)")
def mixture_probabilities(
    squares: FloatArray, depths: FloatArray, chances: FloatArray, median: float, steps: int
) -> FloatArray:
    """Probability of each match to be true, by expectation maximisation.

    Args:
        squares: (P,) squared offsets in the image, in standard deviations.
        depths: (P,) absolute offsets of inverse depths, in standard deviations; ascending, for
            their median.
        chances: (P,) probability that a false match has an offset in the image below a standard
            deviation.
        median: that of the absolute value of a standard normal variable.
        steps: how many are taken.
    """
    count = len(squares)
    true, others = np.empty(count), np.empty(count)
    for k in range(count):
        true[k] = math.exp(-0.5 * (squares[k] + depths[k] * depths[k])) / (2.0 * math.pi)
    probabilities = np.full(count, 0.5)
    for _ in range(steps):
        n, share = 0, 0.0
        for k in range(count):
            share += probabilities[k]
            if probabilities[k] <= 0.5:
                others[n] = depths[k]
                n += 1
        share /= max(count, 1)
        scatter = 1.0
        if n > 0:
            scatter = max(0.5 * (others[(n - 1) // 2] + others[n // 2]) / median, 1.0)
        for k in range(count):
            relative = depths[k] / scatter
            false = chances[k] / math.pi * math.exp(-0.5 * (relative * relative)) / scatter
            own = share * true[k]
            probabilities[k] = own / (own + (1.0 - share) * false + _NO_CHANCE)
    return probabilities


def mixture_probabilities_numpy(
    squares: FloatArray, depths: FloatArray, chances: FloatArray, median: float, steps: int
) -> FloatArray:
    """`mixture_probabilities` in NumPy."""
    true = np.exp(-0.5 * (squares + depths**2)) / (2.0 * math.pi)
    probabilities = np.full(len(squares), 0.5)
    for _ in range(steps if len(squares) else 0):
        others = depths[probabilities <= 0.5]
        scatter = max(float(np.median(others)) / median, 1.0) if len(others) else 1.0
        false = chances / math.pi * np.exp(-0.5 * (depths / scatter) ** 2) / scatter
        share = np.mean(probabilities)
        probabilities = share * true / (share * true + (1.0 - share) * false + _NO_CHANCE)
    return probabilities


@compiled()
def _residual(
    J: FloatArray, offsets: FloatArray, p: int, drift: FloatArray, residuals: FloatArray
) -> float:
    """Squared length of what is left of the offset of match p, which is written to residuals."""
    square = 0.0
    for i in range(offsets.shape[1]):
        rest = offsets[p, i]
        for a in range(4):
            rest -= J[p, i, a] * drift[a]
        residuals[p, i] = rest
        square += rest * rest
    return square


@compiled()
def _fitted(J: FloatArray, offsets: FloatArray, rows: IntArray, weights: FloatArray) -> FloatArray:
    """The drift (4,) that fits some matches best, by Cholesky's method."""
    L, x = np.zeros((4, 4)), np.zeros(4)
    for a in range(4):
        L[a, a] = weights[a]
    for p in rows:
        for i in range(offsets.shape[1]):
            for a in range(4):
                x[a] += J[p, i, a] * offsets[p, i]
                for b in range(a + 1):
                    L[a, b] += J[p, i, a] * J[p, i, b]
    for a in range(4):
        for b in range(a + 1):
            rest = L[a, b]
            for c in range(b):
                rest -= L[a, c] * L[b, c]
            L[a, b] = math.sqrt(rest) if a == b else rest / L[b, b]
        for b in range(a):
            x[a] -= L[a, b] * x[b]
        x[a] /= L[a, a]
    for a in range(3, -1, -1):
        for b in range(a + 1, 4):
            x[a] -= L[b, a] * x[b]
        x[a] /= L[a, a]
    return x


@compiled("b1[::1](f8[:, :, ::1], f8[:, ::1], i8[:, ::1], f8[::1], f8, i8, f8[:, ::1])")
def drift_consensus(
    J: FloatArray,
    offsets: FloatArray,
    pairs: IntArray,
    weights: FloatArray,
    limit: float,
    refinements: int,
    residuals: FloatArray,
) -> BoolArray:
    """The largest set of matches that are consistent with one drift.

    Args:
        J: (P, m, 4) Jacobians of the offsets by the drift.
        offsets: (P, m) in standard deviations.
        pairs: (S, 2) two matches for each drift that is tried.
        weights: (4,) of the prior that the drift is zero.
        limit: largest residual of a consistent match, in standard deviations.
        refinements: how often the drift is fitted to all matches that are consistent with it.
        residuals: (P, m), becomes what is left of the offsets.

    Returns:
        (P,) which matches are in the set.
    """
    count = len(offsets)
    best, most = np.zeros(4), -1
    chosen, square = np.zeros(count, np.bool_), limit * limit
    for s in range(len(pairs)):
        drift = _fitted(J, offsets, pairs[s], weights)
        hits = 0
        for p in range(count):
            if _residual(J, offsets, p, drift, residuals) < square:
                hits += 1
            elif hits + count - p - 1 <= most:
                break
        if hits > most:
            best, most = drift, hits
    for turn in range(refinements + 1):
        for p in range(count):
            chosen[p] = _residual(J, offsets, p, best, residuals) < square
        if turn < refinements:
            best = _fitted(J, offsets, np.flatnonzero(chosen), weights)
    return chosen


def drift_consensus_numpy(
    J: FloatArray,
    offsets: FloatArray,
    pairs: IntArray,
    weights: FloatArray,
    limit: float,
    refinements: int,
    residuals: FloatArray,
) -> BoolArray:
    """`drift_consensus` in NumPy."""

    def fitted(J: FloatArray, offsets: FloatArray) -> FloatArray:
        J, offsets = J.reshape(len(J), -1, 4), offsets.reshape(len(J), -1, 1)
        transposed = J.transpose(0, 2, 1)
        normal = transposed @ J + np.diag(weights)
        return np.asarray(np.linalg.solve(normal, transposed @ offsets)[:, :, 0])

    drifts = fitted(J[pairs], offsets[pairs])
    lengths = np.linalg.norm(offsets - np.einsum("pij,sj->spi", J, drifts), axis=2)
    drift = drifts[np.argmax(np.sum(lengths < limit, axis=1))]
    for _ in range(refinements):
        consistent = np.linalg.norm(offsets - J @ drift, axis=1) < limit
        drift = fitted(J[None, consistent], offsets[None, consistent])[0]
    residuals[:] = offsets - J @ drift
    return np.asarray(np.linalg.norm(residuals, axis=1) < limit)
