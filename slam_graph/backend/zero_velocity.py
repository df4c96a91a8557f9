# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Standing still: how it is detected, and the factors that say so.

While a platform stands still a monocular system sees neither scale nor accelerometer bias, and
errors of the tracks would drive it away. Both the IMU and the images must agree that nothing moves:
the IMU alone cannot tell standing still from slow even motion, nor the images from a far scene.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X

from slam_graph.backend.config import ZeroVelocityConfig
from slam_graph.backend.imu import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations
from slam_graph.sensors.rig import Rig

MIN_FEATURES = 5
"""Fewer common features than this say nothing about the motion of the image."""


class ZeroVelocityDetector:
    """Decides for each frame whether the platform has stood still since the one before."""

    def __init__(self, config: ZeroVelocityConfig, rig: Rig) -> None:
        self.config = config
        self._reference: FeatureObservations | None = None

    def is_still(self, imu: ImuBuffer, stamp_ns: int, frame: FeatureFrame) -> bool:
        """Whether IMU and images agree that nothing has moved."""
        previous, self._reference = self._reference, frame.cameras[0]
        if not self.config.enabled or previous is None:
            return False
        return self._imu_is_still(imu, stamp_ns) and (
            _median_motion_px(previous, frame.cameras[0]) < self.config.max_disparity_px
        )

    def _imu_is_still(self, imu: ImuBuffer, stamp_ns: int) -> bool:
        start_ns = stamp_ns - round(self.config.window_s * 1e9)
        if not imu.covers(start_ns):
            return False
        recent = imu.between(start_ns, stamp_ns)
        return bool(
            np.max(np.std(recent.gyro, axis=0)) < self.config.max_gyro_std
            and np.max(np.std(recent.accel, axis=0)) < self.config.max_accel_std
        )


def _median_motion_px(before: FeatureObservations, after: FeatureObservations) -> float:
    """Median distance that common features moved, infinite if there are too few."""
    _, i, j = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    if len(i) < MIN_FEATURES:
        return float("inf")
    return float(np.median(np.linalg.norm(after.pixels[j] - before.pixels[i], axis=1)))


def zero_velocity_factors(
    i: int, j: int, config: ZeroVelocityConfig
) -> list[gtsam.NonlinearFactor]:
    """The pose of frame j equals that of frame i, and its velocity is zero."""
    between = gtsam.noiseModel.Diagonal.Sigmas(
        np.repeat([config.rotation_sigma, config.position_sigma], 3)
    )
    still = gtsam.noiseModel.Isotropic.Sigma(3, config.velocity_sigma)
    return [
        gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(), between),
        gtsam.PriorFactorVector(V(j), np.zeros(3), still),
    ]
