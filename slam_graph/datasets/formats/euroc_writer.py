# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""EuRoC (ASL) folders: written frame by frame, or converted from any recording of images.

A folder appears when it is complete; an interrupted one leaves nothing behind.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import cv2
import gtsam
import numpy as np
import yaml
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets.calibration.depth_calibration import depth_entry
from slam_graph.datasets.calibration.euroc_calibration import camera_entry, shutter_entry
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.formats.euroc import DEPTH_FOLDER
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.datasets.streams.aiding_files import aiding_texts
from slam_graph.datasets.streams.mask_images import MASKS
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import Trajectory
from slam_graph.sensors import AidingData, CameraFrame, ImuData, ImuNoise, Rig, RigCamera

CALIBRATION = "calibration.yaml"
"""The calibration in Kalibr's format, beside ``mav0``."""

IMU_COLUMNS = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_CAMERA_COLUMNS = "#timestamp [ns],filename"
_TRUTH_COLUMNS = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
    "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],"
    "b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],b_w_RS_S_z [rad s^-1],"
    "b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)
_TRUTH_FOLDER = "state_groundtruth_estimate0"


Progress = Callable[[int], None]
"""Called with the time of every frame that was written."""


class EurocWriter:
    """Writes a recording to a new folder, which appears when the block ends without an error.

    Args:
        path: the new folder.
        rig: calibration of the sensors.
        truth: ground truth, where there is one.
        comment: for the ``sensor.yaml`` files.
        rate_hz: of the cameras.
        force: replace an existing EuRoC folder, which is kept until the new one is complete.
        with_imu: whether there will be samples of an IMU.
        notes: texts to store with it, by the names of their files.

    Raises:
        DataError: if the folder exists already, or cannot be written.
    """

    def __init__(
        self,
        path: Path,
        rig: Rig,
        truth: Trajectory | None,
        comment: str,
        rate_hz: float,
        force: bool = False,
        with_imu: bool = True,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        self.refuse_existing(path, force)
        self._with_imu = with_imu
        self._path, self._rig, self._truth = path, rig, truth
        self._comment, self._rate_hz = comment, rate_hz
        self._notes = dict(notes or {})
        self._depth_ns: int | None = None
        self._files = ExitStack()

    @staticmethod
    def refuse_existing(path: Path, force: bool = False) -> None:
        """Refuse a folder that exists already, before any work is done.

        Args:
            path: where to write.
            force: let a folder with ``mav0`` in it be replaced; nothing else ever is.
        """
        if force and (path / "mav0").is_dir():
            return
        if path.exists():
            what = "is not an EuRoC folder and is not replaced" if force else "exists already"
            raise DataError(f"{path}: {what}; remove it or write to another folder")

    def __enter__(self) -> Self:
        self._folder = Files.partial_folder(self._path)
        try:
            with Files.writing(self._path):
                self._begin()
        except BaseException as error:
            self.__exit__(type(error), error, None)
            raise
        return self

    def _begin(self) -> None:
        """Write what is known before the first measurement."""
        mav0 = self._folder / "mav0"
        self._indices = [
            self._open(mav0 / f"cam{k}", _CAMERA_COLUMNS, _camera_values(mounted, self._rate_hz))
            for k, mounted in enumerate(self._rig.cameras)
        ]
        self._images = [mav0 / f"cam{k}" / "data" for k in range(len(self._indices))]
        for folder in self._images:
            folder.mkdir()
        if self._rig.depth is not None:
            values = depth_entry(replace(self._rig.depth, lens=None))
            self._depths = self._open(mav0 / DEPTH_FOLDER, _CAMERA_COLUMNS, values)
            (mav0 / DEPTH_FOLDER / "data").mkdir()
        if self._with_imu:
            self._imu = self._open(mav0 / "imu0", IMU_COLUMNS, _imu_values(self._rig.imu))
        if self._truth is not None:
            rows = _truth_rows(self._truth)
            columns = ",".join(_TRUTH_COLUMNS.split(",")[: rows.shape[1] + 1])
            file = self._open(mav0 / _TRUTH_FOLDER, columns, {})
            _write_rows(file, self._truth.stamps_ns, rows)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            with Files.writing(self._path):  # what is buffered is written when a file is closed
                self._files.close()
                if kind is None:
                    registered = self._rig.depth and replace(self._rig.depth, lens=None)
                    rig = replace(self._rig, has_imu=self._with_imu, depth=registered)
                    write_kalibr(rig, self._folder / CALIBRATION)
                    for name, text in self._notes.items():
                        (self._folder / name).write_text(text, encoding="utf-8")
                    self._folder.chmod(0o755)
                    self._appear()
        except DataError:
            if kind is None:  # else the first error is the one to tell
                raise
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def write_aiding(self, data: AidingData) -> None:
        """Position fixes and odometry of the whole recording."""
        self._notes |= aiding_texts(data)

    def write_imu(self, imu: ImuData) -> None:
        """The next samples."""
        if len(imu) == 0:
            return
        with Files.writing(self._path):
            _write_rows(self._imu, imu.stamps_ns, np.column_stack([imu.gyro, imu.accel]))

    def write_frame(self, frame: CameraFrame) -> None:
        """The next frame; a camera without an image is left out of it."""
        for index, folder, image in zip(self._indices, self._images, frame.images, strict=True):
            if image is not None:
                self._write_image(index, folder, image, frame.stamp_ns)
        sensor, stamp_ns = self._rig.depth, frame.depth_ns
        stamp_ns = frame.stamp_ns if stamp_ns is None else stamp_ns
        # at a low rate one depth image may be the nearest to two frames
        if sensor is None or frame.depth is None or stamp_ns == self._depth_ns:
            return
        self._depth_ns = stamp_ns
        folder = self._folder / "mav0" / DEPTH_FOLDER / "data"
        self._write_image(self._depths, folder, sensor.raw(frame.depth), stamp_ns)

    def write_mask(self, stamp_ns: int, labels: NDArray[np.uint16]) -> None:
        """The label image (height, width) of the first camera in a frame."""
        Files.make_folder(self._folder / MASKS)
        good, data = cv2.imencode(".png", labels)
        assert good
        with Files.writing(self._path):
            (self._folder / MASKS / f"{stamp_ns}.png").write_bytes(data.tobytes())

    def write_classes(self, files: Mapping[str, str]) -> None:
        """Texts that belong to the label images, by the names of their files; none without any."""
        if (self._folder / MASKS).is_dir():
            self._notes |= {f"{MASKS}/{name}": text for name, text in files.items()}

    def _write_image(self, index: TextIO, folder: Path, image: NDArray[Any], stamp_ns: int) -> None:
        name = f"{stamp_ns}.png"
        good, data = cv2.imencode(".png", image)
        if not good:
            raise DataError(f"{self._path}: the image at {stamp_ns} cannot be encoded")
        with Files.writing(self._path):  # `imwrite` does not say if the disk is full
            (folder / name).write_bytes(data.tobytes())
            index.write(f"{stamp_ns},{name}\n")

    @staticmethod
    def convert(
        sequence: RecordedSequence,
        path: str | Path,
        force: bool = False,
        progress: Progress | None = None,
    ) -> None:
        """Write a recording to a new EuRoC folder, completely or not at all.

        Images become 8 bit grey PNG with the stamp of their frame. Unusable samples of the IMU are
        left out, and so are missing and damaged images; the sequence counts them. Masks become
        label images with the stamp of their frame.

        Args:
            sequence: any recording of images; without an IMU there is no ``imu0`` in the folder.
            path: the new folder.
            force: replace an existing EuRoC folder.
            progress: called with the time of every frame that was written.

        Raises:
            DataError: if the recording holds no images, or the folder exists already.
        """
        info = sequence.info()
        if info.content == "tracks":
            raise DataError(
                f"{info.name}: format '{info.format}' holds feature tracks, no images; copy it as "
                "it is, or write tracks with slam_graph.datasets.TrackRecorder"
            )
        seconds = max((info.end_ns - info.start_ns) * 1e-9, 1e-9)
        rate_hz = round((info.frames - 1) / seconds, 3)
        comment = f"converted from {info.format}"
        rig, truth, has_imu = sequence.rig, sequence.groundtruth(), sequence.has_imu
        notes = sequence.object_truth_file()
        new = EurocWriter(Path(path), rig, truth, comment, rate_hz, force, has_imu, notes)
        with new as writer:
            writer.write_aiding(sequence.aiding)
            for block in sequence.imu_blocks():
                writer.write_imu(block)
            for frame in sequence.frames():
                if not isinstance(frame, CameraFrame):
                    raise DataError(f"{info.name}: frame at {frame.stamp_ns} holds no images")
                writer.write_frame(frame)
                labels = sequence.label_image(frame.stamp_ns)
                if labels is not None:
                    writer.write_mask(frame.stamp_ns, labels)
                if progress is not None:
                    progress(frame.stamp_ns)
            writer.write_classes(sequence.classes_file())

    def _open(self, folder: Path, columns: str, calibration: dict[str, object]) -> TextIO:
        """The index of a new sensor, beside its calibration."""
        folder.mkdir(parents=True)
        kind = folder.name.rstrip("0123456789")
        content = {"sensor_type": _SENSOR_TYPES[kind], "comment": self._comment, **calibration}
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
        (folder / "sensor.yaml").write_text(text)
        file = (folder / "data.csv").open("w", encoding="ascii", newline="\n")
        self._files.enter_context(file)
        file.write(columns + "\n")
        return file

    def _appear(self) -> None:
        """Rename the folder to its path; one that it replaces is removed afterwards."""
        old = self._folder.with_name(f"{self._folder.name}.old")
        replaces = self._path.exists()
        if replaces:
            self._path.rename(old)
        self._folder.rename(self._path)
        if replaces:
            shutil.rmtree(old, ignore_errors=True)


_SENSOR_TYPES = {
    "depth": "depth",
    "cam": "camera",
    "imu": "imu",
    _TRUTH_FOLDER.rstrip("0"): "ground truth",
}


def _write_rows(file: TextIO, stamps_ns: IntArray, values: FloatArray) -> None:
    """Rows with numbers in the shortest form that gives the same double again."""
    for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        file.write(f"{stamp},{','.join(map(repr, row))}\n")


def _truth_rows(truth: Trajectory) -> FloatArray:
    """(N, 7, 10 or 16): position, quaternion w x y z, velocity, gyro and accelerometer bias."""
    columns = [truth.positions, truth.quaternions[:, [3, 0, 1, 2]]]
    if truth.velocities is not None:
        columns.append(truth.velocities)
        if truth.gyro_biases is not None and truth.accel_biases is not None:
            columns += [truth.gyro_biases, truth.accel_biases]
    return np.column_stack(columns)


def _camera_values(mounted: RigCamera, rate_hz: float) -> dict[str, object]:
    """What EuRoC's ``sensor.yaml`` holds, and keys for what else is known of the camera, or not."""
    camera, entry = mounted.camera, camera_entry(mounted.camera)
    values: dict[str, object] = {
        "T_BS": _matrix(mounted.body_T_camera),
        "rate_hz": float(rate_hz),
        "resolution": [camera.width, camera.height],
        "camera_model": entry.camera_model,
        "intrinsics": entry.intrinsics,
        "distortion_model": entry.euroc_distortion,
        "distortion_coefficients": entry.coefficients,
    }
    if not mounted.rotation_known:
        values["rotation_known"] = False
    if mounted.time_offset_s:
        values["timeshift_cam_imu"] = float(mounted.time_offset_s)
    return values | shutter_entry(mounted)


def _imu_values(noise: ImuNoise) -> dict[str, object]:
    return {
        "T_BS": _matrix(gtsam.Pose3()),
        "rate_hz": float(noise.rate_hz),
        "gyroscope_noise_density": float(noise.gyro_noise_density),
        "gyroscope_random_walk": float(noise.gyro_random_walk),
        "accelerometer_noise_density": float(noise.accel_noise_density),
        "accelerometer_random_walk": float(noise.accel_random_walk),
    }


def _matrix(pose: gtsam.Pose3) -> dict[str, object]:
    return {"cols": 4, "rows": 4, "data": [float(v) for v in pose.matrix().ravel()]}
