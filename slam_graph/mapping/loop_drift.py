# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How much odometry drifts, from what loop closures say of it.

Where a place is seen again after t seconds, odometry is off by its drift, of variance σ² t if that
is a random walk, and by the error of the loop closure. σ is what makes the median of all squared
errors, in units of these variances, the median of χ². False loop closures hardly change a median.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from slam_graph.mapping.loop_config import LoopClosureConfig
from slam_graph.mapping.loop_verification import Loop
from slam_graph.mapping.pose_graph import Poses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_LOOPS = 10
"""With fewer the settings hold."""
LEAST, MOST = 0.03, 10.0
"""What is learned is not less, nor more, than so many times what the settings say."""


def drift_sigmas(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    measured: Poses,
    config: LoopClosureConfig,
) -> tuple[float, float]:
    """Drift of the yaw (rad/√s) and of the position on each axis (m/√s).

    Args:
        stamps_ns: (N,) of the keyframes.
        poses: world_T_body of these by odometry.
        loops: between them.
        measured: (L,) relative poses of the loops.
        config: what holds if there are few loops.
    """
    said = config.odometry_rotation_sigma, config.odometry_position_sigma
    if len(loops) < MIN_LOOPS or not config.learn_drift:
        return said
    first, second = np.array([(x.first, x.second) for x in loops]).T
    seconds = np.abs(stamps_ns[second] - stamps_ns[first]) * 1e-9
    expected = poses.select(first).inverse().compose(poses.select(second))
    shift = measured.translations - expected.translations
    turn = measured.rotations.transpose(0, 2, 1) @ expected.rotations
    # of the turn, in the frame of the second body, the part about the vertical
    up = poses.rotations[second][:, 2]
    yaw = np.sum(up * Rotation.from_matrix(turn).as_rotvec(), axis=1)
    covariances = np.array([x.covariance for x in loops])
    of_yaw = np.einsum("ni,nij,nj->n", up, covariances[:, :3, :3], up)
    of_shift = np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    return (
        _sigma(yaw**2, of_yaw, seconds, 1, said[0]),
        _sigma(np.sum(shift**2, axis=1), of_shift, seconds, 3, said[1]),
    )


def _sigma(
    squares: FloatArray, variances: FloatArray, seconds: FloatArray, freedom: int, said: float
) -> float:
    """σ of a random walk over some seconds that explains squared errors beside their variances."""

    def excess(log_sigma: float) -> float:
        whole = variances + np.exp(2.0 * log_sigma) * seconds
        return float(np.median(squares / whole) - chi2.median(freedom))

    low, high = np.log(LEAST * said), np.log(MOST * said)
    if excess(low) <= 0.0:
        return float(np.exp(low))
    if excess(high) >= 0.0:
        return float(np.exp(high))
    return float(np.exp(brentq(excess, low, high)))
