# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a ground truth is in the world of position fixes, so that nothing need be aligned."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.backend import BackendConfig
from slam_graph.errors import DataError
from slam_graph.geometry import Similarity, Trajectory, interpolate
from slam_graph.sensors import AidingData

_LEAST_FIXES = 8
_LARGER = 1.2
"""Fixes are at most this many times as far from the truth as from the truth aligned with them, or
as their noise, in the median: with a hundred fixes the one scatters by a tenth around the other."""


def is_in_world_of_fixes(
    truth: Trajectory | None, aiding: AidingData, config: BackendConfig
) -> bool:
    """Whether a truth is in the world of fixes or known poses of the same recording.

    A difference between two worlds that is below the noise of one fix is not seen.

    Args:
        truth: the true trajectory of the body; None says no.
        aiding: on the clock of the truth.
        config: lever arms of the antenna and of the sensor of known poses.
    """
    stamps_ns, positions = aiding.fix_stamps_ns, aiding.fix_positions
    arm_m, unknown_m = config.gnss.lever_arm_m, config.gnss.lever_arm_sigma_m
    sigmas = np.sqrt(np.trace(aiding.fix_covariances, axis1=1, axis2=2) + 3.0 * unknown_m**2)
    if not len(stamps_ns):
        stamps_ns, positions = aiding.pose_stamps_ns, aiding.pose_positions
        arm_m = config.known_poses.lever_arm_m
        sigmas = np.linalg.norm(aiding.pose_sigmas[:, :3], axis=1)
    known = np.isfinite(sigmas)
    if truth is None or len(truth) == 0 or not known.any():
        return False
    near, valid = interpolate(truth, stamps_ns[known])
    fixes, sigma = positions[known][valid], float(np.median(sigmas[known]))
    if len(fixes) < _LEAST_FIXES:
        return False
    arms = Rotation.from_quat(near.quaternions).apply(arm_m)
    near = Trajectory(near.stamps_ns, near.positions + arms, near.quaternions)
    apart = float(np.median(np.linalg.norm(fixes - near.positions, axis=1)))
    try:
        aligned = Similarity.of_positions(fixes, near.positions, "yaw").apply(near)
    except DataError:  # a path that determines no yaw
        return apart <= _LARGER * sigma
    rest = float(np.median(np.linalg.norm(fixes - aligned.positions, axis=1)))
    return apart <= _LARGER * max(rest, sigma)
