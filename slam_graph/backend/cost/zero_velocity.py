# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Standing still: how it is detected, and the factors that say so.

While a platform stands still a monocular system sees neither scale nor accelerometer bias, and
errors of the tracks would drive it away. Both the images and the IMU must agree that nothing moves:
the images alone cannot tell standing still from slow motion before a far scene, nor the IMU from
slow even motion. The images are compared over the whole window, so that a hovering platform, which
drifts, is told from one on the ground; running motors on the ground may shake the IMU.
"""

from __future__ import annotations

from collections import deque

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.backend.backend_config import ZeroVelocityConfig
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations

OWN_MOTION = 3.0
"""What moves by more than so many times what standing still allows, moves by itself, if others
move by so many times less."""

STILL_SHARE = 1.0 / 3.0
"""So many of the features must stand still, the others may be on something that moves by itself."""

MIN_FEATURES = 5
"""Fewer common features than this say nothing about the motion of the image."""


class StandstillDetector:
    """Decides for each frame whether the platform has stood still for a while.

    Attributes:
        since_ns: stamp of the first frame of the current standstill, None while moving.
        movers: ids (N,) of features that moved while the platform did not, or that are known to
            move, ascending: as long as they are tracked, they are no part of the world that stands
            still.
    """

    def __init__(self, config: ZeroVelocityConfig) -> None:
        self.config = config
        self.since_ns: int | None = None
        self.movers = np.zeros(0, np.int64)
        self._recent: deque[tuple[int, FeatureObservations]] = deque()

    def is_still(self, imu: ImuBuffer, stamp_ns: int, frame: FeatureFrame) -> bool:
        """Whether IMU and images agree that nothing has moved over the window.

        Args:
            imu: samples up to the frame.
            stamp_ns: time of the frame on the clock of the IMU.
            frame: compared by the features of its first camera.
        """
        start_ns = stamp_ns - round(self.config.window_s * 1e9)
        self._recent.append((stamp_ns, frame.cameras[0]))
        while len(self._recent) > 1 and self._recent[1][0] <= start_ns:
            self._recent.popleft()
        still = (
            self.config.enabled
            and self._recent[0][0] <= start_ns
            and self._images_are_still()
            and self._imu_is_calm(imu, start_ns, stamp_ns)
        )
        self.movers = np.intersect1d(self.movers, frame.cameras[0].ids)
        if still:
            self._note_movers()
        if not still:
            self.since_ns = None
        elif self.since_ns is None:
            self.since_ns = self._recent[0][0]
        return still

    def know_movers(self, ids: IntArray) -> None:
        """Note features (N,) of which it is known otherwise that they move by themselves."""
        self.movers = np.union1d(self.movers, ids)

    def _images_are_still(self) -> bool:
        now = self._recent[-1][1]
        references = (self._recent[0][1], self._recent[-2][1])
        now = now.select(~np.isin(now.ids, self.movers))
        return all(self._is_still_between(before, now) for before in references)

    def _is_still_between(self, before: FeatureObservations, now: FeatureObservations) -> bool:
        """Whether most features stand still, or many while the others are on something that moves.

        When the platform moves slowly, those that move least do so nearly as much as the median.
        """
        ids, motion = _common_motion_px(before, now)
        if len(ids) < MIN_FEATURES:
            return False
        least, median = np.quantile(np.linalg.norm(motion, axis=1), [STILL_SHARE, 0.5])
        limit_px = self.config.max_disparity_px
        return bool(median < limit_px or least < limit_px / OWN_MOTION)

    def _note_movers(self) -> None:
        now = self._recent[-1][1]
        for _, before in (self._recent[0], self._recent[len(self._recent) // 2], self._recent[-2]):
            ids, motion = _common_motion_px(before, now)
            own = np.linalg.norm(motion, axis=1)
            limit_px = OWN_MOTION * self.config.max_disparity_px
            self.movers = np.union1d(self.movers, ids[own > limit_px])

    def _imu_is_calm(self, imu: ImuBuffer, start_ns: int, stamp_ns: int) -> bool:
        if not imu.covers(start_ns):
            return False
        recent = imu.between(start_ns, stamp_ns)
        return bool(
            np.max(np.std(recent.gyro, axis=0)) < self.config.max_gyro_std
            and np.max(np.std(recent.accel, axis=0)) < self.config.max_accel_std
        )


def _common_motion_px(
    before: FeatureObservations, after: FeatureObservations
) -> tuple[IntArray, NDArray[np.float64]]:
    """Ids (N,) of common features, and how they moved (N, 2)."""
    ids, i, j = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    return ids, after.pixels[j] - before.pixels[i]


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
