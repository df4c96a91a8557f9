# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras, IMU and rig: their models, and the measurements that sensors make.

- `camera`: `Camera`.
- `camera_model`: `CameraModel`, `CAMERA_MODELS` with the models by name, and how to add one.
- `rig`: `Rig`, `RigCamera`, `ImuNoise`, `CalibrationEstimate` (the result of online calibration).
- `measurements`: `ImuData`, `CameraFrame`, `FeatureObservations`, `FeatureFrame`, `Packet`.
- `aiding`: `AidingData`, position fixes and odometry.
- `depth`: `DepthSensor`.
- `imu_buffer`: `ImuBuffer`, the recent samples of the IMU.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "CAMERA_MODELS",
    "AidingData",
    "CalibrationEstimate",
    "Camera",
    "CameraFrame",
    "CameraModel",
    "DepthSensor",
    "FeatureFrame",
    "FeatureObservations",
    "ImuBuffer",
    "ImuData",
    "ImuNoise",
    "Packet",
    "Rig",
    "RigCamera",
]

if TYPE_CHECKING:
    from slam_graph.sensors.aiding import AidingData
    from slam_graph.sensors.camera import Camera
    from slam_graph.sensors.camera_model import CAMERA_MODELS, CameraModel
    from slam_graph.sensors.depth import DepthSensor
    from slam_graph.sensors.imu_buffer import ImuBuffer
    from slam_graph.sensors.measurements import (
        CameraFrame,
        FeatureFrame,
        FeatureObservations,
        ImuData,
        Packet,
    )
    from slam_graph.sensors.rig import CalibrationEstimate, ImuNoise, Rig, RigCamera
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "aiding": ("AidingData",),
            "camera": ("Camera",),
            "camera_model": ("CAMERA_MODELS", "CameraModel"),
            "depth": ("DepthSensor",),
            "imu_buffer": ("ImuBuffer",),
            "measurements": (
                "CameraFrame",
                "FeatureFrame",
                "FeatureObservations",
                "ImuData",
                "Packet",
            ),
            "rig": ("CalibrationEstimate", "ImuNoise", "Rig", "RigCamera"),
        },
    )
