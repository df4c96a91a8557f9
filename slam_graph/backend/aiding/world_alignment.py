# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The alignment of the estimator's own world with that of position fixes.

Cameras and IMU know neither where they are nor in which direction north is; without an IMU not even
where down is. Fixes along a path tell it: the motion of the world, in position and yaw or in all
six degrees of freedom, that brings the path to the fixes. Some fixes are wrong by far (multipath),
so it is found by graduated non-convexity with the loss of Geman and McClure (Yang, Antonante,
Tzoumas & Carlone 2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.world_gauge import turned_axes
from slam_graph.errors import DataError
from slam_graph.geometry import Similarity

MIN_FIXES = 8
"""Fewer fixes show no outliers among them."""
_LEAST_SHARE = 0.6
"""Part of the fixes that must fit."""
_ROTATION_SIGMA_RAD = 0.03
"""Largest standard deviation of a rotation that counts as known: the engine is linear over it."""
_WIDTH = 3.4
"""Residuals (σ) beyond which a fix is an outlier: the 99 % sphere."""
_SHRINKING = 1.4
"""Factor by which the loss comes nearer to that of outliers from one step to the next."""
_STEPS = 4
"""Gauss-Newton steps at the end."""


@dataclass(frozen=True, slots=True, eq=False)
class WorldAlignment:
    """Where the estimator's world is in that of the fixes.

    Attributes:
        motion: fixes_T_own of the two worlds.
        covariance: of the gauge after the motion, (4, 4) or (6, 6), in the order of
            `world_gauge`: position (m), then yaw or rotation (rad).
        centre: (3,) the point about which the world turns, in the world of the fixes.
        fits: (N,) which fixes fit.
    """

    motion: gtsam.Pose3
    covariance: FloatArray
    centre: FloatArray
    fits: BoolArray


def align_world(
    places: FloatArray,
    fixes: FloatArray,
    covariances: FloatArray,
    centre: FloatArray,
    level: bool,
) -> WorldAlignment | None:
    """The motion that brings a path to fixes of it; None as long as they do not tell it.

    Args:
        places: (N, 3) estimated positions of the antenna.
        fixes: (N, 3) measured ones.
        covariances: (N, 3, 3) of their differences but for the motion, m².
        centre: (3,) the point, in the world of the estimate, about which the world turns.
        level: whether gravity is measured, so that the motion is one in position and yaw.
    """
    if len(places) < MIN_FIXES:
        return None
    roots = np.linalg.inv(np.linalg.cholesky(covariances))  # whiten by these
    try:
        start = Similarity.of_positions(fixes, places, "yaw" if level else "se3")
    except DataError:
        return None
    motion = gtsam.Pose3(gtsam.Rot3(start.rotation), start.translation)
    distances = _distances(motion, places, fixes, roots)
    scale = max(2.0 * float(distances.max() / _WIDTH) ** 2, 1.0)
    while scale > 1.0:  # the loss is nearly quadratic at first
        weights = (scale * _WIDTH**2 / (distances**2 + scale * _WIDTH**2)) ** 2
        motion, _ = _step(motion, places, fixes, roots, weights, centre, level)
        distances = _distances(motion, places, fixes, roots)
        scale /= _SHRINKING
    information = np.zeros((4, 4))
    for _ in range(_STEPS):
        fits = distances < _WIDTH
        if np.count_nonzero(fits) < max(MIN_FIXES, _LEAST_SHARE * len(fits)):
            return None
        weights = fits.astype(np.float64)
        motion, information = _step(motion, places, fixes, roots, weights, centre, level)
        distances = _distances(motion, places, fixes, roots)
    if np.linalg.cond(information) > 1e12:
        return None
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    if np.sqrt(np.diag(covariance)[3:].max()) > _ROTATION_SIGMA_RAD:
        return None
    return WorldAlignment(motion, covariance, _moved(motion, centre[None])[0], fits)


def _moved(motion: gtsam.Pose3, places: FloatArray) -> FloatArray:
    """Positions (N, 3) after a motion."""
    moved: FloatArray = places @ motion.rotation().matrix().T + motion.translation()
    return moved


def _distances(
    motion: gtsam.Pose3, places: FloatArray, fixes: FloatArray, roots: FloatArray
) -> FloatArray:
    """Residuals (N,) in σ."""
    residuals = fixes - _moved(motion, places)
    return np.asarray(np.linalg.norm(np.einsum("nij,nj->ni", roots, residuals), axis=1))


def _step(
    motion: gtsam.Pose3,
    places: FloatArray,
    fixes: FloatArray,
    roots: FloatArray,
    weights: FloatArray,
    centre: FloatArray,
    level: bool,
) -> tuple[gtsam.Pose3, FloatArray]:
    """One Gauss-Newton step, and the information (4, 4) or (6, 6) on the gauge."""
    moved, axes = _moved(motion, places), turned_axes(level)
    middle = _moved(motion, centre[None])[0]
    J = np.zeros((len(places), 3, 3 + len(axes)))
    J[:, :, :3] = np.eye(3)
    J[:, :, 3:] = np.cross(axes, (moved - middle)[:, None]).transpose(0, 2, 1)
    white = np.sqrt(weights)[:, None, None] * np.einsum("nij,njk->nik", roots, J)
    rows = np.sqrt(weights)[:, None] * np.einsum("nij,nj->ni", roots, fixes - moved)
    white, right = white.reshape(-1, J.shape[2]), rows.reshape(-1)
    delta = np.linalg.lstsq(white, right, rcond=None)[0]
    turn = gtsam.Rot3.Expmap(axes.T @ delta[3:])
    # x -> turn (x - middle) + middle + shift
    shift = middle + delta[:3] - turn.rotate(middle)
    return gtsam.Pose3(turn, shift).compose(motion), white.T @ white
