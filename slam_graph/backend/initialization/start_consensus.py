# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Static features of a start in motion: RANSAC over whole tracks with one inertial motion as model.

The equations of the alignment, with the position of each feature eliminated, hold for static
features only: no velocity and gravity explain the tracks of an object that accelerates or turns
together with the measured specific force. So RANSAC (Fischler & Bolles 1981, with the score of Torr
& Zisserman 2000) with the closed-form alignment as model finds the static features even where most
features are dynamic. An object in uniform motion is an inertial frame like any other: against it
the larger group wins.

All samples are solved together, by the normal equations of each feature, which are computed once:
good enough for samples. `constrained_solution` is for the final motion.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.initialization.visual_inertial_alignment import (
    MIN_DEPTH_M,
    NEWTON_STEPS,
    AlignmentEquations,
)
from slam_graph.kernels.secular import constrained_solutions

_SAMPLES = 100
"""If half of the features are static, one sample of four has only such with a probability of
0.998."""
_SAMPLE_FEATURES = 4
"""Features in a sample."""
_REFINED = 5
"""How many of the best samples are refined by their inliers."""
_REFINEMENTS = 3
"""How often a sample is refined by its inliers."""
_RIDGE = 1e-13
"""Keeps the equations of a sample solvable that does not determine the velocity."""
_POINT_RIDGE = 1e-14
"""Keeps those of a feature solvable that is seen without parallax."""
_UPPER = np.triu_indices(4)
"""Rows and columns of an upper triangle."""
_FACTORS = (1.0, -1.0, -0.5)
"""Of tᵖ a in the coefficients of position (p = 0), velocity (1) and gravity (2)."""


class _Model:
    """The equations of J features with their positions eliminated, for the motion alone.

    Motions (S, 6) are velocity and gravity in the frame of the first body.
    """

    def __init__(self, equations: AlignmentEquations, gravity: float) -> None:
        obs, motion = equations.obs, equations.motion
        H = _normal_equations(equations)
        of_point, others = H[:, :3, :3], H[:, :3, 3:]
        size = np.einsum("jii->j", of_point)[:, None, None] + 1e-300
        by_motion = np.linalg.solve(of_point + _POINT_RIDGE * size * np.eye(3), others)
        rest = H[:, 3:, 3:] - others.transpose(0, 2, 1) @ by_motion
        count = len(obs.ids)
        self._squares = rest.reshape(count, 49)
        self._gravity = gravity
        self._dof = np.maximum(2 * obs.counts - 3, 1)
        t = motion.times_s[obs.frame]

        def mean(values: FloatArray) -> FloatArray:
            """Mean (J,) over the observations of each feature."""
            return np.asarray(np.bincount(obs.feature, values, count) / obs.counts)

        # from the mean position of the body to the feature, by (velocity, gravity, -1)
        away = -by_motion
        away[:, :, :3] -= mean(t)[:, None, None] * np.eye(3)
        away[:, :, 3:6] -= 0.5 * mean(t**2)[:, None, None] * np.eye(3)
        for axis, column in enumerate(motion.displacements[obs.frame].T):
            away[:, axis, 6] += mean(column)
        self._away = np.ascontiguousarray(away.transpose(1, 2, 0))  # (3, 7, J)

    def solve(self, weights: FloatArray) -> FloatArray:
        """Motions (S, 6) from features weighted by (S, J); not finite where undetermined."""
        M = (weights**2 @ self._squares).reshape(-1, 7, 7)
        x = np.empty((len(M), 6))
        constrained_solutions(M, self._gravity, _RIDGE, NEWTON_STEPS, x)
        return x

    def errors(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the features say of motions x (S, 6).

        Returns:
            Their mean squared residual (S, J) on the plane z = 1, and their mean distances (S, J)
            from the body, m.
        """
        y = np.column_stack([x, -np.ones(len(x))])  # with the factor of the right-hand side
        squares = (y[:, :, None] * y[:, None, :]).reshape(-1, 49) @ self._squares.T
        away = y @ self._away
        away *= away
        distances = np.maximum(np.sqrt(away[0] + away[1] + away[2]), MIN_DEPTH_M)
        return np.maximum(squares, 0.0) / self._dof / distances**2, distances


def _normal_equations(equations: AlignmentEquations) -> FloatArray:
    """Normal equations (J, 10, 10) of each feature: its position, velocity, gravity, b.

    With the rows a of the position, those of velocity and gravity are -t a and -½ t² a. So all are
    made of the sums over the observations of tᵖ aᵀ a, tᵖ aᵀ b and b².
    """
    obs, a, b, t = equations.obs, equations.by_point, equations.b, equations.times_s
    if equations.rig.wide:  # errors are divided by distances, not by depths
        weights = np.sqrt(1.0 + np.sum(obs.normalized**2, axis=1))
        a, b = a * weights[:, None, None], b * weights[:, None]
    columns = np.empty((2, 4, len(obs)))
    columns[:, :3], columns[:, 3] = a.transpose(1, 2, 0), b.T
    first, second = columns
    products = first[_UPPER[0]] * first[_UPPER[1]]
    products += second[_UPPER[0]] * second[_UPPER[1]]
    S = np.empty((len(obs.ids), 5, 4, 4))
    for power in range(5):
        # the observations of a feature follow one another
        sums = np.add.reduceat(products, obs.starts[:-1], axis=1).T
        S[:, power, _UPPER[0], _UPPER[1]] = S[:, power, _UPPER[1], _UPPER[0]] = sums
        products *= t
    H = np.empty((len(S), 10, 10))
    for i in range(3):
        for k in range(3):
            factor = _FACTORS[i] * _FACTORS[k]
            H[:, 3 * i : 3 * i + 3, 3 * k : 3 * k + 3] = factor * S[:, i + k, :3, :3]
        H[:, 3 * i : 3 * i + 3, 9] = _FACTORS[i] * S[:, i, :3, 3]
        H[:, 9, 3 * i : 3 * i + 3] = H[:, 3 * i : 3 * i + 3, 9]
    H[:, 9, 9] = S[:, 0, 3, 3]
    return H


def random_samples(count: int, rng: np.random.Generator) -> FloatArray:
    """Which of some features are in each sample (S, J): ones, and zeros elsewhere.

    Floyd's algorithm for all samples at once: of the numbers from 0 to j the one that is drawn, or
    j if the sample has that one. The draws are those of `rng.choice` for one sample after the
    other, those by which it shuffles included, and so are the samples; `rng.choice` takes fifty
    times as long.

    Args:
        count: number of features, J.
        rng: draws them.
    """
    size = min(_SAMPLE_FEATURES, count)
    last = np.arange(count - size, count)
    most = np.concatenate([last, np.arange(size - 1, 0, -1)])
    drawn = rng.integers(0, most, (_SAMPLES, len(most)), endpoint=True)
    samples, rows = np.zeros((_SAMPLES, count)), np.arange(_SAMPLES)
    for column, j in enumerate(last):
        number = drawn[:, column]
        samples[rows, np.where(samples[rows, number] == 0.0, number, j)] = 1.0
    return samples


def static_features(
    equations: AlignmentEquations, gravity: float, tolerance: float, rng: np.random.Generator
) -> BoolArray:
    """Which features (J,) are static: those that agree on one motion of the body.

    Args:
        equations: of features seen from at least three of the frames.
        gravity: its magnitude, m/s².
        tolerance: largest root mean square residual on the plane z = 1.
        rng: draws the samples.
    """
    count, limit = len(equations.obs.ids), tolerance**2
    model = _Model(equations, gravity)

    def scores(errors: FloatArray) -> FloatArray:
        return np.asarray(np.sum(np.minimum(errors, limit), axis=1))

    motions = model.solve(np.vstack([np.ones(count), random_samples(count, rng)]))
    motions = motions[np.isfinite(motions).all(axis=1)]
    if not len(motions):
        return np.ones(count, np.bool_)
    errors, distances = model.errors(motions)
    chosen = np.argsort(scores(errors), kind="stable")[:_REFINED]
    best, errors, distances = motions[chosen], errors[chosen], distances[chosen]
    for _ in range(_REFINEMENTS):
        agree = errors < limit
        better = model.solve(agree / distances)
        known = np.asarray(np.isfinite(better).all(axis=1, keepdims=True))
        best = np.where(known & agree.any(axis=1, keepdims=True), better, best)
        errors, distances = model.errors(best)
    return np.asarray(errors[int(np.argmin(scores(errors)))] < limit)
