# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry of wheels or legs as a factor between frames."""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import OdometryConfig

_LEAST_ROTATION_RAD, _LEAST_POSITION_M = 1e-4, 1e-3
"""Standard deviations of a motion of no length."""


def odometry_factor(
    frames: tuple[int, int], moved: tuple[FloatArray, FloatArray], config: OdometryConfig
) -> gtsam.NonlinearFactor:
    """The motion between two frames by the odometry.

    Its variances grow with the distance and with the angle of the motion.

    Args:
        frames: indices of the earlier and the later one.
        moved: rotation vector (3,) and translation (3,) of the body, in its frame at the first.
        config: noise.
    """
    turn, shift = moved
    metres, radians = float(np.linalg.norm(shift)), float(np.linalg.norm(turn))
    position = config.position_noise * np.sqrt(metres) + config.position_noise_per_rad * radians
    rotation = config.rotation_noise * np.sqrt(metres) + config.rotation_noise_per_rad * radians
    sigmas = np.repeat([rotation + _LEAST_ROTATION_RAD, position + _LEAST_POSITION_M], 3)
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift)
    first, last = (gtsam.symbol("x", frame) for frame in frames)
    return gtsam.BetweenFactorPose3(first, last, pose, noise)
