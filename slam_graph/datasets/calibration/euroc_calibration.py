# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The calibration of a rig in EuRoC's files (`sensor.yaml`), and what Kalibr's share with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.datasets.calibration.calibration_yaml import YamlValue, read_yaml
from slam_graph.errors import DataError
from slam_graph.sensors import CAMERA_MODELS, Camera, CameraModel, ImuNoise, Rig, RigCamera

MAX_READOUT_S = 0.1
"""Longest readout of a rolling shutter that a calibration may give."""

_LARGEST_SIZE = 65535
"""Width and height of images, pixels."""
_LARGEST_NUMBER, _SHORTEST_FOCAL_PX = 1e6, 1e-3
"""Bounds on focal lengths, principal points and coefficients of lenses; lenses keep far off."""

_SAME_AXES = 1e-9
"""Largest difference of the scales, axes and mounting of an IMU from those that change nothing."""
_NEUTRAL = {
    "accelerometers": {"M": np.eye(3)},
    "gyroscopes": {"M": np.eye(3), "A": np.zeros((3, 3)), "C_gyro_i": np.eye(3)},
}
"""Kalibr's matrices of an IMU by which no sample changes."""

_SAME_READOUT = 0.01
"""Largest relative difference of `readout_time` from `line_delay` times the height."""


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
    size = entry.require("resolution")
    width, height = size.numbers(2)
    check_size((width, height), size.where)
    count = len(model.coefficient_names) - model.leading
    others = [0.0] * count
    if distorted and count:
        values = entry.require("distortion_coefficients", "distortion_coeffs")
        others = values.numbers(count)
    coefficients = (*leading, *others)
    return lens(model, (fx, fy, cx, cy), coefficients, (int(width), int(height)), intrinsics.where)


def check_size(size: tuple[float, float], where: str) -> None:
    """Refuse what can be no width and height of an image, pixels.

    Raises:
        DataError: naming `where` they are from.
    """
    if not all(0 < value <= _LARGEST_SIZE and value == int(value) for value in size):
        raise DataError(f"{where}: expected width and height in pixels, two whole numbers")


def lens(
    model: CameraModel,
    intrinsics: tuple[float, float, float, float],
    coefficients: tuple[float, ...],
    size: tuple[int, int],
    where: str,
) -> Camera:
    """A camera with numbers that a lens may have.

    Args:
        model: of the distortion.
        intrinsics: fx, fy, cx, cy, pixels.
        coefficients: of the distortion.
        size: width and height, pixels.
        where: these are from, for messages.

    Raises:
        DataError: naming `where`.
    """
    numbers = (*intrinsics, *coefficients)
    sound = all(abs(value) <= _LARGEST_NUMBER for value in numbers)
    if not sound or 0.0 < min(intrinsics[:2]) < _SHORTEST_FOCAL_PX:
        raise DataError(f"{where}: no lens has numbers as large, or as small, as these")
    try:
        model.check(coefficients)
        return Camera(*intrinsics, model.name, coefficients, *size)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None


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


def with_shutter(mounted: RigCamera, entry: YamlValue) -> RigCamera:
    """A camera with the shutter that its calibration describes.

    A shutter rolls by `line_delay` (Kalibr's: seconds from row to row) or `readout_time` (ours:
    `line_delay` times the height), if these are not zero. `stamped_row` (`first`, `middle` or
    `last`) says of which row the stamps are; without it, of the first. Neither EuRoC nor Kalibr's
    camera chains have a key that only says that a shutter rolls; `rolling_shutter` (true),
    `shutter` and `shutter_type` (rolling) are taken as such.

    Raises:
        DataError: naming file and line of a value that makes no sense.
    """
    flag, kind = entry.get("rolling_shutter"), entry.get("shutter") or entry.get("shutter_type")
    readout_s = _readout_s(mounted.camera, entry)
    rolling = (
        (flag is not None and flag.text().lower() in ("true", "yes", "1"))
        or (kind is not None and "rolling" in kind.text().lower())
        or readout_s != 0.0
    )
    shutter = replace(mounted, rolling_shutter=rolling, readout_s=readout_s)
    row = entry.get("stamped_row")
    if row is None or row.text() == "first":
        return shutter
    if row.text() == "middle":
        return replace(shutter, stamped_row="middle")
    if row.text() == "last":
        return replace(shutter, stamped_row="last")
    raise DataError(f"{row.where}: '{row.text()}' is not first, middle or last")


def _readout_s(camera: Camera, entry: YamlValue) -> float:
    """The readout time of a shutter; 0 where it is not given."""
    delay, readout = entry.get("line_delay"), entry.get("readout_time")
    values_s = [delay.number() * camera.height] if delay is not None else []
    values_s += [readout.number()] if readout is not None else []
    if not values_s:
        return 0.0
    where = (readout or delay or entry).where
    if abs(values_s[0] - values_s[-1]) > _SAME_READOUT * abs(values_s[-1]):
        raise DataError(f"{where}: does not fit line_delay, which says {values_s[0]:.6g} s")
    if abs(values_s[-1]) > MAX_READOUT_S:
        raise DataError(f"{where}: a readout of {values_s[-1]:g} s; at most {MAX_READOUT_S:g} s")
    return values_s[-1]


def shutter_entry(mounted: RigCamera) -> dict[str, Any]:
    """What a calibration file says of a rolling shutter; `with_shutter` reads it."""
    values: dict[str, Any] = {"rolling_shutter": True} if mounted.rolling_shutter else {}
    if mounted.readout_s:
        values["readout_time"] = float(mounted.readout_s)
        values["stamped_row"] = mounted.stamped_row
    return values


def read_imu_noise(entry: YamlValue) -> ImuNoise:
    """IMU noise from a mapping with the keys that EuRoC and Kalibr share.

    Raises:
        DataError: naming file and line of what is missing or not above 0, or of a model of the IMU
            by which its samples would have to be corrected (Kalibr's `scale-misalignment`).
    """
    _refuse_uncorrected(entry)
    return ImuNoise(
        gyro_noise_density=entry.require("gyroscope_noise_density").positive(),
        gyro_random_walk=entry.require("gyroscope_random_walk").positive(),
        accel_noise_density=entry.require("accelerometer_noise_density").positive(),
        accel_random_walk=entry.require("accelerometer_random_walk").positive(),
        rate_hz=entry.require("rate_hz", "update_rate").positive(),
    )


def _refuse_uncorrected(entry: YamlValue) -> None:
    """Refuse an IMU whose samples are not those of its calibrated axes, in the body frame.

    Kalibr estimates its scales, the misalignment of its axes, and of a further IMU its mounting and
    clock; no sample is corrected by them.
    """
    hint = "samples are not corrected by it; correct them before, or calibrate with 'calibrated'"
    model = entry.get("model")
    if model is not None and model.text() != "calibrated":
        raise DataError(f"{model.where}: IMU model '{model.text()[:40]}': {hint}")
    offset = entry.get("time_offset")
    if offset is not None and offset.number() != 0.0:
        raise DataError(f"{offset.where}: {offset.number():g} s: {hint}")
    mounting = entry.get("T_i_b")
    if mounting is not None and not mounting.pose().equals(gtsam.Pose3(), _SAME_AXES):
        raise DataError(f"{mounting.where}: not the identity: {hint}")
    for sensor, neutral in _NEUTRAL.items():
        group = entry.get(sensor)
        for key, expected in neutral.items():
            value = None if group is None else group.get(key)
            if value is not None and not _are_near(value, expected):
                raise DataError(f"{value.where} of {sensor}: not that of perfect axes: {hint}")


def _are_near(value: YamlValue, expected: FloatArray) -> bool:
    """Whether the rows of a matrix are those expected."""
    numbers = [number for row in value.elements() for number in row.numbers()]
    return len(numbers) == expected.size and bool(
        np.allclose(numbers, expected.ravel(), rtol=0.0, atol=_SAME_AXES)
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
        shift = entry.get("timeshift_cam_imu")  # not EuRoC's; our writer adds it, and this one
        known = entry.get("rotation_known")
        camera = RigCamera(
            read_camera(entry),
            platform_T_imu.between(platform_T_camera),
            0.0 if shift is None else shift.seconds(),
            name,
            rotation_known=known is None or known.text().lower() != "false",
        )
        mounted.append(with_shutter(camera, entry))
    return Rig(tuple(mounted), noise)
