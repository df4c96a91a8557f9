# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Averages the observations of the frames between keyframes into those of the keyframes.

The IMU predicts the motion from a keyframe to the neighbouring frames to a fraction of a pixel. So
the reprojection errors of these frames are those of the keyframe with other noise, and their mean
replaces the error of the keyframe's own observation. The cost keeps its size.

The variance of a mean depends on the tracks, whose errors are correlated from frame to frame: with
the correlation ρ of two errors of a group, the mean of n has the variance σ² (ρ + (1 - ρ) / n). ρ
is measured as the intraclass correlation over all groups (Fisher 1925).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend import Geometry, Observations, RigProjection


def nearest_keyframe(stamps_ns: IntArray, keyframes: IntArray) -> IntArray:
    """(N,) number of the keyframe nearest to each frame in time."""
    times = stamps_ns[keyframes]
    return np.searchsorted(times[:-1] + np.diff(times) // 2, stamps_ns)


def averaged(
    obs: Observations,
    own: Geometry,
    seen: Observations,
    all_frames: Geometry,
    nearest: IntArray,
    projection: RigProjection,
    limit_px: float,
) -> tuple[Observations, FloatArray]:
    """Observations of keyframes, averaged over the frames around them.

    Args:
        obs: of the keyframes; frame indices are those of keyframes.
        own: poses of the keyframes, points of the features of `obs`.
        seen: observations of the same features in all frames.
        all_frames: poses of all frames, points of the features of `obs`.
        nearest: (N,) number of the keyframe nearest to each frame.
        projection: of the rig.
        limit_px: observations with a larger reprojection error are outliers.

    Returns:
        The observations, and their variances (M,) relative to that of a single observation;
        infinite where all observations of the group are outliers.
    """
    residuals, depths = projection.residuals(seen, all_frames)
    fits = (np.linalg.norm(residuals, axis=1) < limit_px) & (depths > 0.0)
    cameras = len(projection.cameras)
    key = _key(seen.feature, nearest[seen.frame], seen.camera, len(obs.frames), cameras)
    own_key = _key(obs.feature, obs.frame, obs.camera, len(obs.frames), cameras)
    row = np.minimum(np.searchsorted(own_key, key), len(own_key) - 1)
    counted = fits & (own_key[row] == key)
    row, residuals = row[counted], residuals[counted]
    counts = np.bincount(row, minlength=len(obs))
    sums = np.stack([np.bincount(row, residuals[:, i], len(obs)) for i in range(2)], axis=1)
    means = sums / np.maximum(counts, 1)[:, None]
    rho = _correlation(residuals, means[row], counts[row])
    predicted = obs.pixels - projection.residuals(obs, own)[0]
    variances = np.full(len(obs), np.inf)
    np.divide(1.0 - rho, counts, out=variances, where=counts > 0)
    return replace(obs, pixels=predicted + means), rho + variances


def _correlation(values: FloatArray, means: FloatArray, counts: IntArray) -> float:
    """Intraclass correlation, from 0 to 1, of values (N, 2) in groups.

    Args:
        values: of all groups.
        means: (N, 2) of the group of each value.
        counts: (N,) size of the group of each value.
    """
    shared = counts > 1
    values, means, counts = values[shared], means[shared], counts[shared]
    if len(values) == 0:
        return 0.0
    # groups of n have n - 1 degrees of freedom of their own
    within = float(np.mean(np.sum((values - means) ** 2, axis=1) * counts / (counts - 1)))
    total = float(np.mean(np.sum(values**2, axis=1)))
    return float(np.clip(1.0 - within / max(total, 1e-300), 0.0, 1.0))


def _key(
    feature: IntArray, keyframe: IntArray, camera: IntArray, keyframes: int, cameras: int
) -> IntArray:
    """A unique key of each observation, ascending in the order of observations."""
    return (feature * keyframes + keyframe) * cameras + camera
