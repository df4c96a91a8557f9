# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which of many doubtful matches between two visits of a place agree on how far it drifted.

A visual-inertial estimate drifts by a shift and a turn about the vertical (Kelly & Sukhatme 2011;
gravity shows the rest), so true matches between two short visits are all off by the same four
numbers, and false ones by anything. The offset of a match is linear in these,

    offset ≈ J [shift; turn],

and the largest set that agrees is found by RANSAC over pairs of matches.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import binom

from slam_graph.arrays import BoolArray, FloatArray

DRIFT_SIGMAS = np.array([0.1, 0.1, 0.1, 0.02])
"""How far a place may well have drifted: shift (m) and turn (rad), weakly held to zero."""
MAX_FALSE_ALARMS = 0.01
SAMPLES = 100
REFINEMENTS = 3


def by_drift(by_point: FloatArray, arms: FloatArray) -> FloatArray:
    """Derivatives (P, 2, 4) of the pixels of points that shift and turn about the vertical.

    Args:
        by_point: (P, 2, 3) of the pixels by the points in the world.
        arms: (P, 3) from the centre of the turn to the points, in the world.
    """
    turned = np.stack([-arms[:, 1], arms[:, 0], np.zeros(len(arms))], axis=1)
    return np.concatenate([by_point, by_point @ turned[:, :, None]], axis=2)


def agreeing(
    J: FloatArray,
    offsets: FloatArray,
    limit: float,
    chance: float,
    tests: int,
    rng: np.random.Generator,
) -> tuple[BoolArray, FloatArray]:
    """Which matches agree on a drift, or on none, if that is more of them than chance explains.

    How many sets of wrong matches are to be expected in which as many agree must be small
    (a contrario: Moisan & Stival 2004).

    Args:
        J: (P, 2, 4) derivatives of the offsets by the drift.
        offsets: (P, 2) in standard deviations.
        limit: on the length of what the drift does not explain.
        chance: probability that a wrong match has an offset shorter than a standard deviation.
        tests: number of sets that are looked at.
        rng: draws samples.

    Returns:
        agree: (P,) none, if it may be chance.
        left: (P,) length of what the drift leaves of each offset.
    """
    count, chance = len(offsets), min(limit**2 * chance, 1.0)
    lengths = np.linalg.norm(offsets, axis=1)
    undrifted = lengths < limit
    alarms = tests * binom.sf(np.sum(undrifted) - 1, count, chance)
    agree, left = _largest_set(J, offsets, limit, rng)
    if alarms < MAX_FALSE_ALARMS and np.sum(undrifted) >= np.sum(agree):
        return undrifted, lengths
    # two of them were chosen to fit
    drifted = tests * math.comb(count, 2) * binom.sf(np.sum(agree) - 3, count - 2, chance)
    if drifted < MAX_FALSE_ALARMS:
        return agree, left
    return undrifted & (alarms < MAX_FALSE_ALARMS), lengths


def _largest_set(
    J: FloatArray, offsets: FloatArray, limit: float, rng: np.random.Generator
) -> tuple[BoolArray, FloatArray]:
    """The largest set (P,) that one drift explains, and what it leaves of each offset (P,)."""
    pairs = rng.permuted(np.tile(np.arange(len(J)), (SAMPLES, 1)), axis=1)[:, :2]
    drifts = _least_squares(J[pairs], offsets[pairs])
    left = np.linalg.norm(offsets - np.einsum("pij,sj->spi", J, drifts), axis=2)
    agree = left[np.argmax(np.sum(left < limit, axis=1))] < limit
    for _ in range(REFINEMENTS):
        drift = _least_squares(J[None, agree], offsets[None, agree])[0]
        remainder = np.linalg.norm(offsets - J @ drift, axis=1)
        agree = remainder < limit
    return agree, remainder


def _least_squares(J: FloatArray, offsets: FloatArray) -> FloatArray:
    """Drifts (S, 4) that explain each of some sets of matches (S, P, 2, 4) and (S, P, 2)."""
    J, offsets = J.reshape(len(J), -1, 4), offsets.reshape(len(J), -1, 1)
    transposed = J.transpose(0, 2, 1)
    normal = transposed @ J + np.diag(DRIFT_SIGMAS**-2.0)
    return np.asarray(np.linalg.solve(normal, transposed @ offsets)[:, :, 0])
