# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Kalibr's YAML, in and out: ``camchain-imucam`` files with the cameras, and the IMU's noise.

Kalibr writes `T_cam_imu`, the pose of the IMU in the camera frame, which is the inverse of our
`body_T_camera`; `T_cn_cnm1` is the pose of the previous camera in the frame of this one. The first
camera may say `T_cam_imu: unknown`; its mounting is then estimated, and the other cameras are
mounted on it by their `T_cn_cnm1`, as nothing connects it with their `T_cam_imu`. The IMU's noise
stands in a file of its own (flat, or under the key ``imu0``); `write_kalibr` puts it into the same
file under ``imu0``, so that one file describes the rig.

Kalibr does not know of depth. A key ``depth0`` beside the cameras describes what measures it
(`depth_calibration`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeGuard

import gtsam
import yaml

from slam_graph.datasets.calibration.calibration_yaml import YamlValue, parse_yaml, read_yaml
from slam_graph.datasets.calibration.depth_calibration import depth_entry, read_depth_sensor
from slam_graph.datasets.calibration.euroc_calibration import (
    camera_entry,
    read_camera,
    read_imu_noise,
    shutter_entry,
    with_shutter,
)
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.sensors import DepthSensor, ImuNoise, Rig, RigCamera

_IMU_KEY = "imu0"
_DEPTH_KEY = "depth0"
_NONE = "none"
"""Stands for the IMU of a rig without one."""
_UNKNOWN = "unknown"
"""Stands for `T_cam_imu` where nobody has measured how the camera is mounted."""


def read_kalibr(
    path: str | Path,
    imu_path: str | Path | None = None,
    fallback: ImuNoise | None = None,
    needs_imu: bool = True,
    diagnostics: Diagnostics | None = None,
) -> Rig:
    """Read a rig from a Kalibr camera chain.

    Args:
        path: the ``camchain-imucam`` file.
        imu_path: Kalibr's ``imu.yaml``. Without it the noise is taken from the key ``imu0`` of the
            camera chain, else from a file ``imu.yaml`` beside it, else from `fallback`.
        fallback: noise to take if no file has any; default that of EuRoC's IMU.
        needs_imu: whether the cameras must be calibrated to the IMU; otherwise a chain that does
            not say where it is has the body frame of its first camera.
        diagnostics: counts `imu_noise_assumed` if the IMU is needed, and neither a file nor
            `fallback` has its noise.

    Raises:
        DataError: if a file or key is missing, or a value makes no sense; names file and line.
    """
    chain = read_yaml(path)
    no_imu = _says_none(chain)
    cameras = _chain_cameras(chain, needs_imu and not no_imu)
    noise = ImuNoise() if no_imu else _read_imu(chain, imu_path) or fallback
    if noise is None:
        noise = ImuNoise()
        if needs_imu and diagnostics is not None:
            warn_noise_assumed(path, diagnostics)
    return Rig(cameras, noise, not no_imu, _read_depth(chain, len(cameras)))


def warn_noise_assumed(path: str | Path, diagnostics: Diagnostics) -> None:
    """Count that the noise of an IMU is that of EuRoC's, as nothing at `path` has any."""
    what = "no noise densities of the IMU are given; those of EuRoC's are assumed"
    diagnostics.warn("imu_noise_assumed", f"{path}: {what}")


def rig_from_kalibr(text: str, path: str | Path) -> Rig:
    """The rig of a text like that of `kalibr_text`, which has the noise of the IMU too.

    Args:
        text: YAML, or JSON, which is YAML.
        path: of the file that it stands in, for messages.

    Raises:
        DataError: if it is not YAML, a key is missing, or a value makes no sense.
    """
    table = parse_yaml(text, path)
    cameras, imu = _chain_cameras(table, not _says_none(table)), table.require(_IMU_KEY)
    depth = _read_depth(table, len(cameras))
    if _says_none(table):
        return Rig(cameras, has_imu=False, depth=depth)
    return Rig(cameras, read_imu_noise(imu), depth=depth)


def _chain_cameras(chain: YamlValue, needs_imu: bool = True) -> tuple[RigCamera, ...]:
    """The cameras of a camera chain (see `read_kalibr`).

    Raises:
        DataError: if a key is missing, or a value makes no sense.
    """
    entries = {
        int(found[1]): value
        for name, value in chain.items()
        if (found := re.fullmatch(r"cam(\d{1,9})", name))
    }
    if not entries:
        raise DataError(
            f"{chain.path}: no camera (key 'cam0') in this file; is it a Kalibr camera chain?"
        )
    cameras: dict[int, RigCamera] = {}
    in_body = _is_given(entries[min(entries)].get("T_cam_imu"))
    for index in sorted(entries):
        entry = entries[index]
        if not cameras:
            pose, known = _first_pose(entry, needs_imu), not _is_unknown(entry)
        elif in_body and _is_given(direct := entry.get("T_cam_imu")):
            pose, known = direct.pose().inverse(), True
        else:
            pose, known = _linked_pose(entry, cameras.get(index - 1), in_body)
        cameras[index] = _read_camera(entry, pose, known)
    return tuple(cameras.values())


def _read_camera(entry: YamlValue, body_T_camera: gtsam.Pose3, rotation_known: bool) -> RigCamera:
    shift, name = entry.get("timeshift_cam_imu"), entry.get("name")
    mounted = RigCamera(
        read_camera(entry),
        body_T_camera,
        0.0 if shift is None else shift.seconds(),
        entry.key if name is None else name.text(),
        rotation_known=rotation_known,
    )
    return with_shutter(mounted, entry)


def _is_unknown(entry: YamlValue) -> bool:
    """Whether a camera says that its mounting is not known."""
    direct = entry.get("T_cam_imu")
    return direct is not None and not _is_given(direct)


def _is_given(direct: YamlValue | None) -> TypeGuard[YamlValue]:
    """Whether a `T_cam_imu` is there, and is not said to be unknown."""
    if direct is None:
        return False
    return not isinstance(direct.node, yaml.ScalarNode) or direct.text() != _UNKNOWN


def _says_none(chain: YamlValue) -> bool:
    """Whether a camera chain says that there is no IMU."""
    imu = chain.get(_IMU_KEY)
    return imu is not None and isinstance(imu.node, yaml.ScalarNode) and imu.text() == _NONE


def _first_pose(entry: YamlValue, needs_imu: bool) -> gtsam.Pose3:
    """body_T_camera of the first camera; its own frame is the body frame if it is not known."""
    direct = entry.get("T_cam_imu")
    if _is_given(direct):
        return direct.pose().inverse()
    if direct is None and needs_imu:
        raise DataError(
            f"{entry.where}: missing key 'T_cam_imu'; use the camchain-imucam file of Kalibr, "
            f"from calibrating cameras and IMU together, or 'T_cam_imu: {_UNKNOWN}' to estimate it"
        )
    return gtsam.Pose3()


def _linked_pose(
    entry: YamlValue, previous: RigCamera | None, in_body: bool
) -> tuple[gtsam.Pose3, bool]:
    """body_T_camera of a camera that is mounted on the previous one, and whether it is known.

    Args:
        entry: of the camera.
        previous: the camera whose number is one less; None if there is none.
        in_body: whether the first camera says where the IMU is.
    """
    link = entry.get("T_cn_cnm1")
    if link is None:
        first = "" if in_body else ", as the first camera does not say where the IMU is"
        either = "'T_cam_imu' or " if in_body else ""
        raise DataError(
            f"{entry.where}: missing key {either}'T_cn_cnm1', the pose of the previous camera in "
            f"the frame of this one{first}; it is in the camchain files of Kalibr"
        )
    if previous is None:
        raise DataError(
            f"{link.where}: is from the camera before, and there is no camera of that number in "
            "this file; add it, number the cameras cam0, cam1, … without gaps, or give T_cam_imu"
        )
    return previous.body_T_camera.compose(link.pose().inverse()), previous.rotation_known


def _read_depth(chain: YamlValue, cameras: int) -> DepthSensor | None:
    entry = chain.get(_DEPTH_KEY)
    return None if entry is None else read_depth_sensor(entry, cameras)


def _read_imu(chain: YamlValue, imu_path: str | Path | None) -> ImuNoise | None:
    """The noise of the IMU; None if no file has it."""
    beside = chain.path.parent / "imu.yaml"
    entry = chain.get(_IMU_KEY) if imu_path is None else None
    if entry is None and imu_path is None and beside.is_file():
        imu_path = beside
    if imu_path is not None:
        whole = read_yaml(imu_path)
        entry = whole.get(_IMU_KEY) or whole
    return None if entry is None else read_imu_noise(entry)


def write_kalibr(rig: Rig, path: str | Path) -> None:
    """Write a rig so that `read_kalibr` gives it back to 1e-12; whole or not at all.

    Raises:
        DataError: if it cannot be written.
    """
    Files.write_text(Path(path), [kalibr_text(rig)])


def kalibr_text(rig: Rig) -> str:
    """The content of a Kalibr file with cameras, depth and IMU, which loses no digit."""
    content: dict[str, Any] = {
        f"cam{index}": _camera_entry(mounted) | _mounting(rig, index)
        for index, mounted in enumerate(rig.cameras)
    }
    if rig.depth is not None:
        content[_DEPTH_KEY] = depth_entry(rig.depth)
    content[_IMU_KEY] = _imu_entry(rig.imu) if rig.has_imu else _NONE
    comment = "T_cam_imu is camera_T_body, t_imu = t_cam + timeshift_cam_imu"
    table = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    return f"# Kalibr camera chain: {comment}\n{table}"


def _imu_entry(noise: ImuNoise) -> dict[str, float]:
    return {
        "gyroscope_noise_density": float(noise.gyro_noise_density),
        "gyroscope_random_walk": float(noise.gyro_random_walk),
        "accelerometer_noise_density": float(noise.accel_noise_density),
        "accelerometer_random_walk": float(noise.accel_random_walk),
        "update_rate": float(noise.rate_hz),
    }


def _mounting(rig: Rig, index: int) -> dict[str, Any]:
    """Where a camera is: on the body, or beside the one before if the body does not know."""
    mounted = rig.cameras[index]
    if mounted.rotation_known and (index == 0 or rig.cameras[0].rotation_known):
        return {"T_cam_imu": mounted.body_T_camera.inverse().matrix().tolist()}
    if index == 0:
        return {"T_cam_imu": _UNKNOWN}
    before = rig.cameras[index - 1].body_T_camera
    return {"T_cn_cnm1": mounted.body_T_camera.between(before).matrix().tolist()}


def _camera_entry(mounted: RigCamera) -> dict[str, Any]:
    camera, entry = mounted.camera, camera_entry(mounted.camera)
    return shutter_entry(mounted) | {
        "name": mounted.name,
        "camera_model": entry.camera_model,
        "intrinsics": entry.intrinsics,
        "distortion_model": entry.kalibr_distortion,
        "distortion_coeffs": entry.coefficients,
        "resolution": [int(camera.width), int(camera.height)],
        "timeshift_cam_imu": float(mounted.time_offset_s),
    }
