# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration of a rig from the files of EuRoC (`sensor.yaml`); Kalibr's are in `kalibr`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import gtsam

from slam_graph.errors import DataError
from slam_graph.sensors.calibration_yaml import YamlValue, read_yaml
from slam_graph.sensors.camera import COEFFICIENTS, Camera, Distortion
from slam_graph.sensors.rig import ImuNoise, Rig, RigCamera

DISTORTION_NAMES: dict[str, Distortion] = {
    "none": "none",
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "equidistant": "equidistant",
}
"""The names that calibration files give to distortion models."""


@dataclass(frozen=True, slots=True)
class _CameraModel:
    """A camera model of a calibration file.

    Attributes:
        name: under which `Camera` knows it together with its distortion; None if the distortion
            says all.
        parameters: how many intrinsics it has before fx, fy, cx, cy.
        distortions: what it goes with.
    """

    name: Distortion | None
    parameters: int
    distortions: tuple[Distortion, ...]


CAMERA_MODELS = {
    "pinhole": _CameraModel(None, 0, ("none", "radtan", "equidistant")),
    "omni": _CameraModel("mei", 1, ("radtan", "none")),
    "ds": _CameraModel("double_sphere", 2, ("none",)),
}
"""Kalibr's names."""


def read_camera(entry: YamlValue) -> Camera:
    """Intrinsics from a mapping with the keys that EuRoC and Kalibr share.

    Args:
        entry: has `camera_model`, `intrinsics` (those of the model in `CAMERA_MODELS`, and then fx,
            fy, cx, cy), `distortion_model`, `distortion_coefficients` or `distortion_coeffs`, and
            `resolution` (width, height).

    Raises:
        DataError: naming file and line of what is missing or unknown.
    """
    model = entry.require("camera_model", "model")
    if model.text() not in CAMERA_MODELS:
        known = ", ".join(CAMERA_MODELS)
        raise DataError(f"{model.where}: unknown camera model '{model.text()}'; known: {known}")
    shape = CAMERA_MODELS[model.text()]
    name = entry.require("distortion_model", "distortion")
    if name.text() not in DISTORTION_NAMES:
        raise DataError(
            f"{name.where}: unknown distortion model '{name.text()}'; "
            f"known: {', '.join(DISTORTION_NAMES)}"
        )
    distortion = DISTORTION_NAMES[name.text()]
    if distortion not in shape.distortions:
        raise DataError(
            f"{name.where}: distortion '{name.text()}' does not go with camera model "
            f"'{model.text()}'; it goes with {', '.join(shape.distortions)}"
        )
    intrinsics = entry.require("intrinsics")
    *extra, fx, fy, cx, cy = intrinsics.numbers(4 + shape.parameters)
    width, height = entry.require("resolution").numbers(2)
    coefficients: list[float] = []
    if distortion != "none":
        values = entry.require("distortion_coefficients", "distortion_coeffs")
        coefficients = values.numbers(COEFFICIENTS[distortion])
    try:
        size = (int(width), int(height))
        if shape.name is None:
            return Camera(fx, fy, cx, cy, distortion, tuple(coefficients), *size)
        if shape.name == "double_sphere" and not 0.0 <= extra[1] <= 1.0:
            raise DataError(f"alpha of a double sphere is in [0, 1], got {extra[1]}")
        bend = coefficients or [0.0] * (COEFFICIENTS[shape.name] - len(extra))
        return Camera(fx, fy, cx, cy, shape.name, (*extra, *bend), *size)
    except DataError as error:
        raise DataError(f"{intrinsics.where}: {error}") from None


def camera_entry(camera: Camera) -> tuple[str, list[float], Distortion, list[float]]:
    """What `read_camera` reads: camera model, intrinsics, distortion model and coefficients."""
    model, shape = next(
        (item for item in CAMERA_MODELS.items() if item[1].name == camera.distortion),
        ("pinhole", CAMERA_MODELS["pinhole"]),
    )
    values = [float(value) for value in camera.coefficients]
    extra, bend = values[: shape.parameters], values[shape.parameters :]
    intrinsics = [*extra, *map(float, (camera.fx, camera.fy, camera.cx, camera.cy))]
    distortion = camera.distortion if shape.name is None else shape.distortions[0]
    return model, intrinsics, distortion, bend


def has_rolling_shutter(entry: YamlValue) -> bool:
    """Whether the calibration of a camera says that its rows are exposed one after the other.

    Neither EuRoC nor Kalibr's camera chains have a key for it. Taken as such are `rolling_shutter`
    (true), `shutter` or `shutter_type` (rolling), and `line_delay` or `readout_time` if they are
    not zero.
    """
    flag, kind = entry.get("rolling_shutter"), entry.get("shutter") or entry.get("shutter_type")
    delays = [entry.get(key) for key in ("line_delay", "readout_time")]
    return (
        (flag is not None and flag.text().lower() in ("true", "yes", "1"))
        or (kind is not None and "rolling" in kind.text().lower())
        or any(delay is not None and delay.number() != 0.0 for delay in delays)
    )


def read_imu_noise(entry: YamlValue) -> ImuNoise:
    """IMU noise from a mapping with the keys that EuRoC and Kalibr share."""
    return ImuNoise(
        gyro_noise_density=entry.require("gyroscope_noise_density").number(),
        gyro_random_walk=entry.require("gyroscope_random_walk").number(),
        accel_noise_density=entry.require("accelerometer_noise_density").number(),
        accel_random_walk=entry.require("accelerometer_random_walk").number(),
        rate_hz=entry.require("rate_hz", "update_rate").number(),
    )


def read_body_T_sensor(path: Path) -> gtsam.Pose3:
    """`T_BS` of an EuRoC ``sensor.yaml``: the pose of the sensor on the platform.

    A file without this key describes a sensor that defines the platform's frame.
    """
    value = read_yaml(path).get("T_BS")
    return gtsam.Pose3() if value is None else value.pose()


def read_euroc_rig(mav0: Path, cameras: Iterable[str], imu: str = "imu0") -> Rig:
    """The rig of an EuRoC folder, from the ``sensor.yaml`` of each sensor.

    Args:
        mav0: folder that holds a folder for each sensor.
        cameras: names of the camera folders, in the order of the rig.
        imu: name of the folder of the IMU. Its frame is the body frame of the rig; where its
            `T_BS` is not the identity, the cameras are re-expressed in it. Without such a folder
            the body frame is that of the platform.

    Raises:
        DataError: if a file or key is missing, or a value makes no sense; names file and line.
    """
    platform_T_imu, noise = gtsam.Pose3(), ImuNoise()
    if (mav0 / imu).is_dir():
        noise = read_imu_noise(read_yaml(mav0 / imu / "sensor.yaml"))
        platform_T_imu = read_body_T_sensor(mav0 / imu / "sensor.yaml")
    mounted = []
    for name in cameras:
        entry = read_yaml(mav0 / name / "sensor.yaml")
        platform_T_camera = entry.require("T_BS").pose()
        shift = entry.get("timeshift_cam_imu")  # not EuRoC's; our writer adds it
        mounted.append(
            RigCamera(
                read_camera(entry),
                platform_T_imu.between(platform_T_camera),
                0.0 if shift is None else shift.number(),
                name,
                has_rolling_shutter(entry),
            )
        )
    return Rig(tuple(mounted), noise)
