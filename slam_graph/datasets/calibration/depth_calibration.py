# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The calibration of a depth sensor in a YAML file, in and out.

`read_depth_sensor` has the keys. All of them may be left out: depth images are then of 16 bits in
mm and registered to camera 0.
"""

from __future__ import annotations

from typing import Any

import gtsam

from slam_graph.datasets.calibration.calibration_yaml import YamlValue
from slam_graph.datasets.calibration.euroc_calibration import camera_entry, read_camera
from slam_graph.errors import DataError
from slam_graph.sensors import DepthSensor

_LARGEST = 1e9
"""Depth in m, its noise, and units to a metre are no larger."""


def read_depth_sensor(entry: YamlValue, cameras: int) -> DepthSensor:
    """A depth sensor from a mapping.

    Args:
        entry: may have `camera` (number of the camera that the depth is registered to, 0), `scale`
            (units to a metre, 1000), `range_m` (least and largest depth, 0.3 and 10), `noise`
            (constant part in m, and factor of the squared depth in 1/m; those of a small stereo
            camera), and, of a depth camera of its own whose images are not registered,
            `T_cam_depth` (its pose in the frame of the camera), `camera_model` and the other keys
            of a camera.
        cameras: number of cameras of the rig.

    Raises:
        DataError: naming file and line of a value that makes no sense.
    """
    default = DepthSensor()
    number, scale = entry.get("camera"), entry.get("scale")
    camera = default.camera if number is None else int(number.number())
    if number is not None and not (camera == number.number() and 0 <= camera < cameras):
        raise DataError(f"{number.where}: expected the number of a camera, 0 to {cameras - 1}")
    units = default.scale if scale is None else scale.positive()
    if scale is not None and not 1.0 / _LARGEST <= units <= _LARGEST:
        raise DataError(f"{scale.where}: {units:g} units to a metre are those of no sensor")
    limits, noise = entry.get("range_m"), entry.get("noise")
    least, most = (default.min_m, default.max_m) if limits is None else limits.numbers(2)
    if limits is not None and not 0.0 <= least < most <= _LARGEST:
        raise DataError(f"{limits.where}: expected the least and the largest depth in m")
    constant, square = default.noise_constant_m, default.noise_square_per_m
    if noise is not None:
        constant, square = noise.numbers(2)
        if min(constant, square) < 0.0 or not 0.0 < max(constant, square) <= _LARGEST:
            raise DataError(f"{noise.where}: expected the noise in m and its growth in 1/m")
    has_lens = entry.get("camera_model") is not None
    mounting = entry.get("T_cam_depth")
    return DepthSensor(
        camera,
        units,
        least,
        most,
        constant,
        square,
        read_camera(entry) if has_lens else None,
        gtsam.Pose3() if mounting is None else mounting.pose(),
    )


def depth_entry(sensor: DepthSensor) -> dict[str, Any]:
    """What a calibration file says of a depth sensor; `read_depth_sensor` reads it."""
    values: dict[str, Any] = {
        "camera": int(sensor.camera),
        "scale": float(sensor.scale),
        "range_m": [float(sensor.min_m), float(sensor.max_m)],
        "noise": [float(sensor.noise_constant_m), float(sensor.noise_square_per_m)],
    }
    if sensor.lens is None:
        return values
    entry = camera_entry(sensor.lens)
    return values | {
        "T_cam_depth": sensor.camera_T_depth.matrix().tolist(),
        "camera_model": entry.camera_model,
        "intrinsics": entry.intrinsics,
        "distortion_model": entry.kalibr_distortion,
        "distortion_coeffs": entry.coefficients,
        "resolution": [int(sensor.lens.width), int(sensor.lens.height)],
    }
