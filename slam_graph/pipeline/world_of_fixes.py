# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What position fixes tell: the world, which a ground truth may share, and the unit of length."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.backend import BackendConfig
from slam_graph.errors import DataError
from slam_graph.geometry import Similarity, Trajectory, interpolate
from slam_graph.results import RunInput
from slam_graph.sensors import AidingData

NO_SCALE = "one camera without an IMU, odometry or position fixes: all lengths are up to scale"
NOT_FOR_SMOOTHERS = (
    "GTSAM's smoothers take no scale from position fixes, which are not used: all lengths of one "
    "camera without an IMU or odometry are up to scale; use msckf, swf, okvis, ekf or iekf"
)
NOT_TOLD = (
    "nothing told the scale of one camera without an IMU or odometry in every segment (position "
    "fixes are missing, too few, too noisy, or along a straight line): lengths are up to scale"
)

_LEAST_FIXES = 8
_LARGER = 1.2
"""Fixes are at most this many times as far from the truth as from the truth aligned with them, or
as their noise, in the median: with a hundred fixes the one scatters by a tenth around the other."""


def usable_aiding(aiding: AidingData | None, asked: RunInput) -> AidingData | None:
    """What of fixes, known poses and odometry a run can use.

    Where nothing has told the unit of length yet, odometry does not cover enough to tell it, and
    GTSAM's smoothers cannot take it from fixes.
    """
    if aiding is None or asked.rig.has_scale:
        return aiding
    absolute = aiding.without_odometry() if _takes_scale(asked) else AidingData.empty()
    return absolute if len(absolute) else None


def _takes_scale(asked: RunInput) -> bool:
    """Whether the engine can go on in another unit of length."""
    return asked.config.algorithm.engine == "square_root"


def why_no_scale(aiding: AidingData | None, asked: RunInput) -> str:
    """Why lengths of one camera are up to scale from the beginning; empty if fixes may tell it.

    Args:
        aiding: all of the recording, as it is stamped; None if that is not known.
        asked: which part of it, and the settings.
    """
    backend, offset_ns = asked.config.backend, round(asked.rig.pose_offset_s * 1e9)
    if asked.rig.has_scale:
        return ""
    if aiding is None:
        return "" if _takes_scale(asked) else NO_SCALE
    known = backend.on_the_clock(aiding).within(
        asked.start_ns + offset_ns - 1, asked.end_ns + offset_ns
    )
    if not len(known.without_odometry()):
        return NO_SCALE
    return "" if _takes_scale(asked) else NOT_FOR_SMOOTHERS


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
