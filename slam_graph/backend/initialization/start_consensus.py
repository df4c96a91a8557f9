# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Static features of a start in motion: RANSAC over whole tracks with one inertial motion as model.

The equations of the alignment, with the position of each feature eliminated, hold for static
features only: no velocity and gravity explain the tracks of an object that accelerates or turns
together with the measured specific force. So RANSAC (Fischler & Bolles 1981, with the score of Torr
& Zisserman 2000) with the closed-form alignment as model finds the static features even where most
features are dynamic. An object in uniform motion is an inertial frame like any other: against it
the larger group wins.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.cost.feature_factors import eliminate_points
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.initialization.visual_inertial_alignment import (
    MIN_DEPTH_M,
    Alignment,
    Motion,
    alignment_equations,
    constrained_solution,
)

_SAMPLES = 100
"""If half of the features are static, one sample of four has only such with a probability of
0.998."""
_SAMPLE_FEATURES = 4
"""Features in a sample."""
_REFINED = 5
"""How many of the best samples are refined by their inliers."""
_REFINEMENTS = 3
"""How often a sample is refined by its inliers."""


class _Model:
    """The equations of J features with their positions eliminated, for the motion alone."""

    def __init__(
        self, obs: Observations, motion: Motion, rig: RigProjection, gravity: float
    ) -> None:
        by_point, by_motion, b = alignment_equations(obs, motion, rig, np.ones(len(obs)))
        others = np.concatenate([by_motion, b[:, :, None]], axis=2)
        self._R, rest = eliminate_points(obs, by_point, others)
        self._R = self._R + 1e-9 * np.eye(3)
        self._top, self._rows = rest[:, :3], rest[:, 3:]
        self._squares = self._rows.transpose(0, 2, 1) @ self._rows
        self._gravity = gravity
        self._dof = np.maximum(2 * obs.counts - 3, 1)
        self._counts = obs.counts
        t = motion.times_s[obs.frame]
        self._t, self._tt = self._mean(obs, t), self._mean(obs, t**2)
        self._shift = np.column_stack(
            [self._mean(obs, column) for column in motion.displacements[obs.frame].T]
        )

    def _mean(self, obs: Observations, values: FloatArray) -> FloatArray:
        """Mean (J,) over the observations of each feature."""
        return np.asarray(np.bincount(obs.feature, values, len(obs.ids)) / self._counts)

    def solve(self, features: NDArray[np.int64], weights: FloatArray | None) -> FloatArray | None:
        """Velocity and gravity (6,) from some features, None if they do not determine them."""
        rows = self._rows[features]
        if weights is not None:
            rows = rows * weights[features, None, None]
        A = rows.reshape(-1, 7)
        try:
            found: Alignment = constrained_solution(A[:, :6], A[:, 6], self._gravity)
        except (np.linalg.LinAlgError, ValueError):
            return None
        x = np.concatenate([found.velocity, found.gravity])
        return x if np.isfinite(x).all() else None

    def distances(self, x: FloatArray) -> FloatArray:
        """Mean distances (J,) of the features from the body under a motion x (6,), m."""
        right = self._top[:, :, 6] - self._top[:, :, :6] @ x
        points = np.linalg.solve(self._R, right[:, :, None])[:, :, 0]
        eyes = self._t[:, None] * x[:3] + 0.5 * self._tt[:, None] * x[3:] + self._shift
        return np.asarray(np.maximum(np.linalg.norm(points - eyes, axis=1), MIN_DEPTH_M))

    def errors(self, x: FloatArray) -> FloatArray:
        """Mean squared residual (J,) of the features on the plane z = 1 under a motion x (6,)."""
        y = np.append(x, -1.0)
        squares = np.einsum("i,jik,k->j", y, self._squares, y)
        return np.asarray(np.maximum(squares, 0.0) / self._dof / self.distances(x) ** 2)


def static_features(
    obs: Observations,
    motion: Motion,
    rig: RigProjection,
    gravity: float,
    tolerance: float,
    rng: np.random.Generator,
) -> BoolArray:
    """Which features (J,) are static: those that agree on one motion of the body.

    Args:
        obs: features seen from at least three of the frames.
        motion: inertial motion between the frames.
        rig: mounting of the cameras.
        gravity: its magnitude, m/s².
        tolerance: largest root mean square residual on the plane z = 1.
        rng: draws the samples.
    """
    model, count, limit = _Model(obs, motion, rig, gravity), len(obs.ids), tolerance**2

    def score(x: FloatArray) -> float:
        return float(np.sum(np.minimum(model.errors(x), limit)))

    motions = [model.solve(np.arange(count), None)]
    for _ in range(_SAMPLES):
        sample = rng.choice(count, min(_SAMPLE_FEATURES, count), replace=False)
        motions.append(model.solve(sample, None))
    best = sorted((x for x in motions if x is not None), key=score)[:_REFINED]
    if not best:
        return np.ones(count, np.bool_)
    x = min((_refined(model, x, limit) for x in best), key=score)
    return np.asarray(model.errors(x) < limit)


def _refined(model: _Model, x: FloatArray, limit: float) -> FloatArray:
    """A motion that is computed from its inliers again and again."""
    for _ in range(_REFINEMENTS):
        agree = np.flatnonzero(model.errors(x) < limit)
        better = model.solve(agree, 1.0 / model.distances(x)) if len(agree) else None
        if better is None:
            break
        x = better
    return x
