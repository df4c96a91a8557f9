# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras, IMU and rig: models, calibration files, and the measurements that sensors make.

- `camera`: `Camera`.
- `camera_model`: `CameraModel`, `CAMERA_MODELS` with the models by name, and how to add one.
- `rig`: `Rig`, `RigCamera`, `ImuNoise`.
- `measurements`: `ImuData`, `CameraFrame`, `FeatureObservations`, `FeatureFrame`, `Packet`.
- `imu_buffer`: `ImuBuffer`, and the integration of the IMU.
- `kalibr_calibration`, `euroc_calibration`: `read_kalibr`, `write_kalibr`, `read_euroc_rig`.
- `calibration_estimate`: `CalibrationEstimate`, the result of online calibration.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "CAMERA_MODELS",
    "STANDARD_GRAVITY",
    "CalibrationEstimate",
    "Camera",
    "CameraFrame",
    "CameraModel",
    "FeatureFrame",
    "FeatureObservations",
    "ImuBuffer",
    "ImuData",
    "ImuNoise",
    "Packet",
    "Rig",
    "RigCamera",
    "YamlValue",
    "camera_entry",
    "integrate_rotation",
    "kalibr_table",
    "parse_yaml",
    "pose_from_matrix",
    "predict",
    "preintegrate",
    "preintegration_params",
    "read_body_T_sensor",
    "read_camera",
    "read_euroc_rig",
    "read_imu_noise",
    "read_kalibr",
    "read_yaml",
    "rig_from_table",
    "write_kalibr",
]

if TYPE_CHECKING:
    from slam_graph.sensors.calibration_yaml import YamlValue, parse_yaml, read_yaml
    from slam_graph.sensors.camera import Camera
    from slam_graph.sensors.camera_model import CAMERA_MODELS, CameraModel
    from slam_graph.sensors.euroc_calibration import (
        camera_entry,
        read_body_T_sensor,
        read_camera,
        read_euroc_rig,
        read_imu_noise,
    )
    from slam_graph.sensors.imu_buffer import (
        STANDARD_GRAVITY,
        ImuBuffer,
        integrate_rotation,
        predict,
        preintegrate,
        preintegration_params,
    )
    from slam_graph.sensors.kalibr_calibration import (
        kalibr_table,
        read_kalibr,
        rig_from_table,
        write_kalibr,
    )
    from slam_graph.sensors.measurements import (
        CameraFrame,
        FeatureFrame,
        FeatureObservations,
        ImuData,
        Packet,
    )
    from slam_graph.sensors.rig import (
        CalibrationEstimate,
        ImuNoise,
        Rig,
        RigCamera,
        pose_from_matrix,
    )
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "calibration_yaml": ("YamlValue", "parse_yaml", "read_yaml"),
            "camera": ("Camera",),
            "camera_model": ("CAMERA_MODELS", "CameraModel"),
            "euroc_calibration": (
                "camera_entry",
                "read_body_T_sensor",
                "read_camera",
                "read_euroc_rig",
                "read_imu_noise",
            ),
            "imu_buffer": (
                "ImuBuffer",
                "STANDARD_GRAVITY",
                "integrate_rotation",
                "predict",
                "preintegrate",
                "preintegration_params",
            ),
            "kalibr_calibration": ("kalibr_table", "read_kalibr", "rig_from_table", "write_kalibr"),
            "measurements": (
                "CameraFrame",
                "FeatureFrame",
                "FeatureObservations",
                "ImuData",
                "Packet",
            ),
            "rig": ("CalibrationEstimate", "ImuNoise", "Rig", "RigCamera", "pose_from_matrix"),
        },
    )
