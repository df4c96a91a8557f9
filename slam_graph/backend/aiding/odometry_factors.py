# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry of wheels or legs as a factor between frames."""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import OdometryConfig
from slam_graph.sensors import AidingData

_LEAST_ROTATION_RAD, _LEAST_POSITION_M = 1e-4, 1e-3
"""Standard deviations of a motion of no length."""
_UNEXPECTED = 5.0
"""A way that is measured so many σ too long is not so by its noise."""


def motion_sigmas(turn_rad: float, way_m: float, config: OdometryConfig) -> FloatArray:
    """Standard deviations of a motion by odometry: of its rotation (rad) and translation (m), (2,).

    Variances grow with the distance and with the angle of the motion.
    """
    root = np.sqrt(way_m)
    position = config.position_noise * root + config.position_noise_per_rad * turn_rad
    rotation = config.rotation_noise * root + config.rotation_noise_per_rad * turn_rad
    return np.array([rotation + _LEAST_ROTATION_RAD, position + _LEAST_POSITION_M])


def odometry_factor(
    frames: tuple[int, int],
    moved: tuple[FloatArray, FloatArray],
    way_m: float,
    config: OdometryConfig,
) -> gtsam.NonlinearFactor:
    """The motion between two frames by the odometry.

    Args:
        frames: indices of the earlier and the later one.
        moved: rotation vector (3,) and translation (3,) of the body, in its frame at the first.
        way_m: length of the way as it is estimated. It must not be that of the odometry: a
            measured way that is too long would count less than one that is too short, and lengths
            would come out too small by σ² / way² (1 % where σ is a tenth of the way). Only where
            that is much longer it counts.
        config: noise; see `motion_sigmas`.
    """
    turn, shift = moved
    turn_rad, measured_m = float(np.linalg.norm(turn)), float(np.linalg.norm(shift))
    sigmas = motion_sigmas(turn_rad, way_m, config)
    if measured_m > way_m + _UNEXPECTED * sigmas[1]:  # it has set off
        sigmas = motion_sigmas(turn_rad, measured_m, config)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sigmas, 3))
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift)
    first, last = (gtsam.symbol("x", frame) for frame in frames)
    return gtsam.BetweenFactorPose3(first, last, pose, noise)


class OdometryFactors:
    """Makes factors of the odometry from frame to frame."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config, self._data = config, AidingData.empty()
        self._came, self._asked, self._used = False, False, False

    def take(self, data: AidingData) -> None:
        """Take what was received of the last seconds, in the place of what was taken before."""
        self._data = data
        self._came |= len(data.odometry_stamps_ns) > 0

    @property
    def is_unused(self) -> bool:
        """Whether there was odometry, and none from any frame to the next."""
        return self._came and self._asked and not self._used

    def between(self, from_ns: int, to_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """As `AidingData.odometry_between`; None where odometry is not to be used."""
        return self._data.odometry_between(from_ns, to_ns) if self._config.enabled else None

    def factors(
        self, frames: tuple[int, int], stamps_ns: tuple[int, int], speed: float
    ) -> list[gtsam.NonlinearFactor]:
        """The motion from one frame to the next, if the odometry has it.

        Args:
            frames: indices of the earlier and the later one.
            stamps_ns: their times.
            speed: at the earlier one, as it is estimated, m/s.
        """
        moved = self.between(*stamps_ns)
        self._asked |= self._config.enabled
        if moved is None:
            return []
        self._used = True
        way_m = speed * (stamps_ns[1] - stamps_ns[0]) * 1e-9
        return [odometry_factor(frames, moved, way_m, self._config)]
