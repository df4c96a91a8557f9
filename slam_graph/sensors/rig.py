# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A rig: cameras and one IMU, rigidly connected, with their calibration.

The body frame is the IMU frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.sensors.camera import Camera

_ROTATION_TOLERANCE = 1e-3
"""Largest element of R Rᵀ - I for which R counts as a rotation; files may have four digits only."""


@dataclass(frozen=True)
class ImuNoise:
    """Noise of an IMU, as continuous-time densities like those of Kalibr and EuRoC.

    Attributes:
        gyro_noise_density: rad/s/√Hz.
        gyro_random_walk: rad/s²/√Hz.
        accel_noise_density: m/s²/√Hz.
        accel_random_walk: m/s³/√Hz.
        rate_hz: nominal sampling rate.
    """

    gyro_noise_density: float = 1.6968e-4
    gyro_random_walk: float = 1.9393e-5
    accel_noise_density: float = 2.0e-3
    accel_random_walk: float = 3.0e-3
    rate_hz: float = 200.0


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera where it is mounted.

    Attributes:
        camera: intrinsics.
        body_T_camera: pose of the camera in the body (IMU) frame.
        time_offset_s: t_imu = t_camera + time_offset_s (Kalibr's `timeshift_cam_imu`).
        name: of the camera in its data set, e.g. ``cam0``.
        rolling_shutter: whether its rows are exposed one after the other. The estimator takes them
            as exposed at one time all the same.
    """

    camera: Camera
    body_T_camera: gtsam.Pose3
    time_offset_s: float = 0.0
    name: str = ""
    rolling_shutter: bool = False


@dataclass(frozen=True, eq=False)
class Rig:
    """All calibrated sensors of a platform.

    Attributes:
        cameras: in the order of the images of a frame.
        imu: noise of the IMU.
    """

    cameras: tuple[RigCamera, ...]
    imu: ImuNoise = field(default_factory=ImuNoise)

    def select(self, count: int) -> Rig:
        """The same rig with its first `count` cameras only."""
        if not 1 <= count <= len(self.cameras):
            raise DataError(f"asked for {count} cameras, the rig has {len(self.cameras)}")
        return Rig(self.cameras[:count], self.imu)


def pose_from_matrix(matrix: FloatArray, where: str) -> gtsam.Pose3:
    """A pose from a 4x4 homogeneous matrix.

    Args:
        matrix: (4, 4).
        where: what the matrix is and where it stands (file, line), for the error message.

    Raises:
        DataError: if the matrix is not 4x4, not finite, or its rotation part is not a rotation.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        raise DataError(f"{where}: expected a finite 4x4 matrix, got shape {matrix.shape}")
    R = matrix[:3, :3]
    defect = float(np.max(np.abs(R @ R.T - np.eye(3))))
    if defect > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise DataError(
            f"{where}: the upper left 3x3 block is not a rotation "
            f"(|R Rᵀ - I| = {defect:.2g}, det = {np.linalg.det(R):.3g})"
        )
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(R), matrix[:3, 3])
