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
