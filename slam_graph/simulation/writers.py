# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulations as files: a folder of recorded tracks, or an EuRoC (ASL) folder of images."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import mkdtemp
from typing import TextIO

import cv2
import gtsam
import numpy as np
import yaml

from slam_graph.datasets.recorder import TrackRecorder
from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.sensors.kalibr import write_kalibr
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, ImuData
from slam_graph.sensors.rig import ImuNoise, RigCamera
from slam_graph.simulation.motion import FloatArray, IntArray
from slam_graph.simulation.sequence import SimulatedImages, SimulatedSequence, SimulatedTracks

SETTINGS = "simulation.yaml"
CALIBRATION = "calibration.yaml"

IMU_COLUMNS = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
CAMERA_COLUMNS = "#timestamp [ns],filename"
TRUTH_COLUMNS = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
    "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],"
    "b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],b_w_RS_S_z [rad s^-1],"
    "b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)
DISTORTIONS = {"none": "none", "radtan": "radial-tangential", "equidistant": "equidistant"}
TRUTH_FOLDER = "state_groundtruth_estimate0"

Progress = Callable[[int], None]
"""Is told the time of every frame that was written."""


def write(sequence: SimulatedSequence, path: Path, progress: Progress | None = None) -> None:
    """Write a simulation to a new folder, whole or not at all, with its settings.

    Tracks become a recording (`datasets/recording_format.py`), images an EuRoC folder.

    Raises:
        DataError: if the folder exists already.
    """
    progress = progress if progress is not None else _ignore
    if isinstance(sequence, SimulatedTracks):
        write_tracks(sequence, path, progress)
    elif isinstance(sequence, SimulatedImages):
        write_euroc(sequence, path, progress)
    settings = sequence.config.model_dump(mode="json")
    (path / SETTINGS).write_text(yaml.safe_dump(settings, sort_keys=False))


def refuse_existing(path: Path) -> None:
    """Refuse a folder that is there already, before any work is done."""
    if path.exists():
        raise DataError(f"{path}: exists already; remove it or write to another folder")


def write_tracks(sequence: SimulatedTracks, path: Path, progress: Progress) -> None:
    """Write a recording with calibration, ground truth and start state."""
    recorder = TrackRecorder(
        path, sequence.rig, sequence.name, sequence.groundtruth(), sequence.initial_state()
    )
    with recorder:
        for packet in sequence.packets():
            assert isinstance(packet.frame, FeatureFrame)
            recorder.write(packet.imu, packet.frame)
            progress(packet.frame.stamp_ns)


def write_euroc(sequence: SimulatedImages, path: Path, progress: Progress) -> None:
    """Write an EuRoC folder with ground truth, and the calibration in Kalibr's format beside it.

    Only the latter holds a time offset between cameras and IMU.
    """
    refuse_existing(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        _write_mav0(sequence, folder / "mav0", progress)
        write_kalibr(sequence.rig, folder / CALIBRATION)
        folder.chmod(0o755)
        folder.rename(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write_mav0(sequence: SimulatedImages, mav0: Path, progress: Progress) -> None:
    rate_hz = sequence.config.rate_hz
    with ExitStack() as files:
        indices = []
        for number, mounted in enumerate(sequence.rig.cameras):
            folder = mav0 / f"cam{number}"
            (folder / "data").mkdir(parents=True)
            (folder / "sensor.yaml").write_text(_camera_yaml(mounted, rate_hz))
            indices.append(_csv(files, folder, CAMERA_COLUMNS))
        imu = _csv(files, mav0 / "imu0", IMU_COLUMNS)
        (mav0 / "imu0" / "sensor.yaml").write_text(_imu_yaml(sequence.rig.imu))
        truth = _csv(files, mav0 / TRUTH_FOLDER, TRUTH_COLUMNS)
        (mav0 / TRUTH_FOLDER / "sensor.yaml").write_text(_sensor_yaml("ground truth", {}))
        _write_rows(truth, *_truth_rows(sequence.groundtruth()))
        for packet in sequence.packets():
            assert isinstance(packet.frame, CameraFrame)
            _write_imu(imu, packet.imu)
            for number, image in enumerate(packet.frame.images):
                assert image is not None
                name = f"{packet.frame.stamp_ns}.png"
                indices[number].write(f"{packet.frame.stamp_ns},{name}\n")
                cv2.imwrite(str(mav0 / f"cam{number}" / "data" / name), image)
            progress(packet.frame.stamp_ns)


def _csv(files: ExitStack, folder: Path, columns: str) -> TextIO:
    folder.mkdir(parents=True, exist_ok=True)
    file = files.enter_context((folder / "data.csv").open("w", encoding="ascii", newline="\n"))
    file.write(columns + "\n")
    return file


def _write_imu(file: TextIO, imu: ImuData) -> None:
    _write_rows(file, imu.stamps_ns, np.column_stack([imu.gyro, imu.accel]))


def _write_rows(
    file: TextIO,
    stamps_ns: IntArray,
    values: FloatArray,
) -> None:
    """Rows with numbers in the shortest form that gives the same double again."""
    for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        file.write(f"{stamp},{','.join(map(repr, row))}\n")


def _truth_rows(
    truth: Trajectory,
) -> tuple[
    IntArray,
    FloatArray,
]:
    assert truth.velocities is not None
    assert truth.gyro_biases is not None
    assert truth.accel_biases is not None
    wxyz = truth.quaternions[:, [3, 0, 1, 2]]
    columns = [truth.positions, wxyz, truth.velocities, truth.gyro_biases, truth.accel_biases]
    return truth.stamps_ns, np.column_stack(columns)


def _camera_yaml(mounted: RigCamera, rate_hz: float) -> str:
    camera = mounted.camera
    values: dict[str, object] = {
        "T_BS": _matrix(mounted.body_T_camera),
        "rate_hz": rate_hz,
        "resolution": [camera.width, camera.height],
        "camera_model": "pinhole",
        "intrinsics": [float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy)],
        "distortion_model": DISTORTIONS[camera.distortion],
        "distortion_coefficients": [float(v) for v in camera.coefficients],
    }
    return _sensor_yaml("camera", values)


def _imu_yaml(noise: ImuNoise) -> str:
    values: dict[str, object] = {
        "T_BS": _matrix(gtsam.Pose3()),
        "rate_hz": float(noise.rate_hz),
        "gyroscope_noise_density": float(noise.gyro_noise_density),
        "gyroscope_random_walk": float(noise.gyro_random_walk),
        "accelerometer_noise_density": float(noise.accel_noise_density),
        "accelerometer_random_walk": float(noise.accel_random_walk),
    }
    return _sensor_yaml("imu", values)


def _sensor_yaml(kind: str, values: dict[str, object]) -> str:
    content = {"sensor_type": kind, "comment": "simulated", **values}
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _matrix(pose: gtsam.Pose3) -> dict[str, object]:
    return {"cols": 4, "rows": 4, "data": [float(v) for v in pose.matrix().ravel()]}


def _ignore(stamp_ns: int) -> None:
    """Tell nobody."""
