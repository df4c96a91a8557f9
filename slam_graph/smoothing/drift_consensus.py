# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""RANSAC over the relative drift between two visits of a place, given uncertain feature matches.

A visual-inertial estimate drifts in four degrees of freedom, position and yaw (Kelly & Sukhatme
2011; gravity determines roll and pitch). So all true matches between two short visits are offset by
the same four numbers, and false ones by anything. The offset of a match is linear in these,

    offset ≈ J [shift; yaw],

and the largest consistent set is found by RANSAC over pairs of matches.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import binom

from slam_graph.arrays import BoolArray, FloatArray

_DRIFT_SIGMAS = np.array([0.1, 0.1, 0.1, 0.02])
"""Standard deviation of the drift between visits, a weak prior: shift (m) and yaw (rad)."""
_MAX_FALSE_ALARMS = 0.01
_SAMPLES = 100
_REFINEMENTS = 3


def drift_jacobian(by_point: FloatArray, arms: FloatArray) -> FloatArray:
    """(P, 2, 4) Jacobians of pixels by a shift and yaw of the points.

    Args:
        by_point: (P, 2, 3) Jacobians of the pixels by the points in the world.
        arms: (P, 3) from the centre of rotation to the points, in the world.
    """
    turned = np.stack([-arms[:, 1], arms[:, 0], np.zeros(len(arms))], axis=1)
    return np.concatenate([by_point, by_point @ turned[:, :, None]], axis=2)


def consistent_matches(
    J: FloatArray,
    offsets: FloatArray,
    limit: float,
    chance: float,
    tests: int,
    rng: np.random.Generator,
) -> tuple[BoolArray, FloatArray]:
    """Matches that are consistent with one drift, or with none, if they are more than by chance.

    The expected number of equally large consistent sets among false matches (the number of false
    alarms) must be small (a contrario: Moisan & Stival 2004).

    Args:
        J: (P, 2, 4) Jacobians of the offsets by the drift.
        offsets: (P, 2) in standard deviations.
        limit: largest residual of a consistent match, in standard deviations.
        chance: probability that a false match has an offset shorter than a standard deviation.
        tests: number of sets of matches that are tested.
        rng: draws the samples.

    Returns:
        consistent: (P,) all false if the set may be chance.
        residuals: (P,) length of each offset after removal of the drift.
    """
    count, chance = len(offsets), min(limit**2 * chance, 1.0)
    lengths = np.linalg.norm(offsets, axis=1)
    undrifted = lengths < limit
    alarms = tests * binom.sf(np.sum(undrifted) - 1, count, chance)
    consistent, residuals = _largest_set(J, offsets, limit, rng)
    if alarms < _MAX_FALSE_ALARMS and np.sum(undrifted) >= np.sum(consistent):
        return undrifted, lengths
    # two matches were sampled to fit
    drifted = tests * math.comb(count, 2) * binom.sf(np.sum(consistent) - 3, count - 2, chance)
    if drifted < _MAX_FALSE_ALARMS:
        return consistent, residuals
    return undrifted & (alarms < _MAX_FALSE_ALARMS), lengths


def _largest_set(
    J: FloatArray, offsets: FloatArray, limit: float, rng: np.random.Generator
) -> tuple[BoolArray, FloatArray]:
    """The largest set (P,) consistent with one drift, and the residuals (P,) of all offsets."""
    pairs = rng.permuted(np.tile(np.arange(len(J)), (_SAMPLES, 1)), axis=1)[:, :2]
    drifts = _least_squares(J[pairs], offsets[pairs])
    residuals = np.linalg.norm(offsets - np.einsum("pij,sj->spi", J, drifts), axis=2)
    consistent = residuals[np.argmax(np.sum(residuals < limit, axis=1))] < limit
    for _ in range(_REFINEMENTS):
        drift = _least_squares(J[None, consistent], offsets[None, consistent])[0]
        refined = np.linalg.norm(offsets - J @ drift, axis=1)
        consistent = refined < limit
    return consistent, refined


def _least_squares(J: FloatArray, offsets: FloatArray) -> FloatArray:
    """Least-squares drifts (S, 4) of sets of matches with J (S, P, 2, 4) and offsets (S, P, 2)."""
    J, offsets = J.reshape(len(J), -1, 4), offsets.reshape(len(J), -1, 1)
    transposed = J.transpose(0, 2, 1)
    normal = transposed @ J + np.diag(_DRIFT_SIGMAS**-2.0)
    return np.asarray(np.linalg.solve(normal, transposed @ offsets)[:, :, 0])
