# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The calibration of a rig in EuRoC's files (`sensor.yaml`), and what Kalibr's share with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import gtsam

from slam_graph.datasets.calibration.calibration_yaml import YamlValue, read_yaml
from slam_graph.errors import DataError
from slam_graph.sensors import CAMERA_MODELS, Camera, CameraModel, ImuNoise, Rig, RigCamera


def read_camera(entry: YamlValue) -> Camera:
    """Intrinsics from a mapping with the keys that EuRoC and Kalibr share.

    Args:
        entry: has `camera_model`, `intrinsics` (the leading coefficients of the model, and then fx,
            fy, cx, cy), `distortion_model`, `distortion_coefficients` or `distortion_coeffs`, and
            `resolution` (width, height).

    Raises:
        DataError: naming file and line of what is missing or unknown.
    """
    model, distorted = _read_model(entry)
    intrinsics = entry.require("intrinsics")
    *leading, fx, fy, cx, cy = intrinsics.numbers(4 + model.leading)
    width, height = entry.require("resolution").numbers(2)
    count = len(model.coefficient_names) - model.leading
    others = [0.0] * count
    if distorted and count:
        values = entry.require("distortion_coefficients", "distortion_coeffs")
        others = values.numbers(count)
    coefficients = (*leading, *others)
    try:
        model.check(coefficients)
        return Camera(fx, fy, cx, cy, model.name, coefficients, int(width), int(height))
    except DataError as error:
        raise DataError(f"{intrinsics.where}: {error}") from None


def _read_model(entry: YamlValue) -> tuple[CameraModel, bool]:
    """The camera model of an entry, and whether it has a distortion.

    A model with leading coefficients, such as Kalibr's omni, goes with the distortion `none` too.
    """
    camera = entry.require("camera_model", "model")
    known = [part() for _, part in CAMERA_MODELS.working()]
    models = [model for model in known if model.kalibr_camera == camera.text()]
    if not models:
        cameras = ", ".join(dict.fromkeys(model.kalibr_camera for model in known))
        raise DataError(f"{camera.where}: unknown camera model '{camera.text()}'; known: {cameras}")
    distortion = entry.require("distortion_model", "distortion")
    for model in models:
        if distortion.text() in _distortion_names(model):
            return model, True
    if distortion.text() == "none" and models[0].leading:
        return models[0], False
    if distortion.text() in CAMERA_MODELS:
        CAMERA_MODELS[distortion.text()]  # raises the error of a plugin that does not work
    names = [name for model in known for name in _distortion_names(model)]
    if distortion.text() not in names:
        raise DataError(
            f"{distortion.where}: unknown distortion model '{distortion.text()}'; "
            f"known: {', '.join(dict.fromkeys(names))}"
        )
    fitting = [_distortion_names(model)[0] for model in models]
    fitting += ["none"] if models[0].leading else []
    raise DataError(
        f"{distortion.where}: distortion '{distortion.text()}' does not go with camera model "
        f"'{camera.text()}'; it goes with {', '.join(dict.fromkeys(fitting))}"
    )


def _distortion_names(model: CameraModel) -> tuple[str, ...]:
    return model.distortion_names or (model.name,)


@dataclass(frozen=True, slots=True)
class CameraEntry:
    """How calibration files describe a camera; `read_camera` reads it.

    Attributes:
        camera_model: Kalibr's name.
        intrinsics: the leading coefficients of the model, then fx, fy, cx, cy.
        kalibr_distortion: Kalibr's name of the distortion.
        euroc_distortion: EuRoC's name of it.
        coefficients: the other coefficients.
    """

    camera_model: str
    intrinsics: list[float]
    kalibr_distortion: str
    euroc_distortion: str
    coefficients: list[float]


def camera_entry(camera: Camera) -> CameraEntry:
    """The values of a camera in a calibration file."""
    model, names = camera.model, _distortion_names(camera.model)
    values = [float(value) for value in camera.coefficients]
    intrinsics = [*values[: model.leading], *camera.intrinsics.tolist()]
    rest = values[model.leading :]
    return CameraEntry(model.kalibr_camera, intrinsics, names[0], names[-1], rest)


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


def read_body_T_sensor(path: str | Path) -> gtsam.Pose3:
    """`T_BS` of an EuRoC ``sensor.yaml``: the pose of the sensor on the platform.

    A file without this key describes a sensor that defines the platform's frame.
    """
    value = read_yaml(path).get("T_BS")
    return gtsam.Pose3() if value is None else value.pose()


def read_euroc_rig(mav0: str | Path, cameras: Iterable[str], imu: str = "imu0") -> Rig:
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
    mav0, platform_T_imu, noise = Path(mav0), gtsam.Pose3(), ImuNoise()
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
