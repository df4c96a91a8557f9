# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Records feature tracks for replay; `track_recording` describes the files."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
import yaml
from numpy.typing import NDArray

from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.formats import track_recording as layout
from slam_graph.datasets.formats.recorded_files import packed
from slam_graph.datasets.formats.recorded_objects import ObjectColumns, unknown_labels
from slam_graph.datasets.formats.recorded_states import save_state, save_trajectory
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.datasets.streams.aiding_files import aiding_texts
from slam_graph.datasets.streams.mask_images import LARGEST_LABEL
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import AidingData, FeatureFrame, FeatureObservations, ImuData, Rig


class TrackRecorder:
    """Writes the packets of a front end to a folder; a context manager.

    Everything is written beside the folder and moved there at the end: an exception inside the
    ``with`` block leaves nothing behind.

    Args:
        path: of the new folder; it must not exist.
        rig: calibration of the cameras and the IMU.
        name: of the recording; that of the folder if None.
        groundtruth: true trajectory to store with it.
        initial_state: known state at the start to store with it.
        notes: texts to store with it, by the names of their files.

    Raises:
        DataError: if the folder exists already, or cannot be written (a full disk, no permission).
    """

    def __init__(
        self,
        path: str | Path,
        rig: Rig,
        name: str | None = None,
        groundtruth: Trajectory | None = None,
        initial_state: NavState | None = None,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        path = Path(path)
        if path.exists():
            raise DataError(f"{path}: exists already; remove it or record to another folder")
        self.path = path
        self.rig = rig
        self.name = name if name is not None else path.name
        self._groundtruth = groundtruth
        self._initial_state = initial_state
        self._notes = dict(notes or {})
        self._counts = {"frames": 0, "imu_samples": 0, "features": 0}
        self._aiding: list[AidingData] = []
        self._latest_ns: int | None = None
        self._recorded: layout.TrackRecordingSequence | None = None
        self._descriptor_bytes: int | None = None
        self._depth_camera = None if rig.depth is None else rig.depth.camera
        self._record = layout.frame_record(len(rig.cameras))

    def __enter__(self) -> Self:
        self._folder = Files.partial_folder(self.path)
        self._files = ExitStack()
        self._objects = ObjectColumns(self._open)
        try:
            with Files.writing(self.path):
                self._frames = self._open(layout.FRAMES)
                self._features = self._open(layout.FEATURES)
                self._imu = self._open(layout.IMU)
                if self._depth_camera is not None:
                    self._depths = self._open(layout.DEPTHS)
        except BaseException as error:
            self.__exit__(type(error), error, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            with Files.writing(self.path):  # what is buffered is written when a file is closed
                try:
                    of_objects = self._objects.finish() if kind is None else {}
                finally:
                    self._files.close()
                if kind is None:
                    self._finish(of_objects)
        except DataError:
            if kind is None:  # else the first error is the one to tell
                raise
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def recorded(self, diagnostics: Diagnostics) -> layout.TrackRecordingSequence:
        """What was recorded, once the recorder is closed. It is opened once.

        Args:
            diagnostics: where faults are counted as it is read.

        Raises:
            DataError: if a file is missing or cut.
        """
        if self._recorded is None:
            options = ReaderOptions(diagnostics=diagnostics)
            self._recorded = layout.TrackRecordingSequence(self.path, options)
        return self._recorded

    def write(self, imu: ImuData, frame: FeatureFrame, aiding: AidingData | None = None) -> None:
        """Append a packet.

        Args:
            imu: the samples since the packet before, as in `Packet`.
            frame: the features found at a time later than that of the frame before; their labels
                in the first camera, and those that move by themselves, are recorded too.
            aiding: fixes and odometry since the packet before.

        Raises:
            DataError: if the frame is not later, has another number of cameras than the rig, has a
                feature twice in a camera or a label that is not 0 to 65535, or cannot be written.
        """
        self._check(frame)
        if aiding is not None:
            self._aiding.append(aiding)
        with Files.writing(self.path):
            self._append(imu, frame)

    def _check(self, frame: FeatureFrame) -> None:
        """Refuse a frame that could not be read again."""
        if len(frame.cameras) != len(self.rig.cameras):
            raise DataError(
                f"{self.path}: a frame with {len(frame.cameras)} cameras cannot be recorded for a "
                f"rig with {len(self.rig.cameras)}"
            )
        if len(frame.moving) not in (0, len(self.rig.cameras)):
            raise DataError(
                f"{self.path}: a frame with features that move in {len(frame.moving)} cameras "
                f"cannot be recorded for a rig with {len(self.rig.cameras)}"
            )
        if self._latest_ns is not None and frame.stamp_ns <= self._latest_ns:
            raise DataError(
                f"{self.path}: a frame at {frame.stamp_ns} cannot be recorded after one at "
                f"{self._latest_ns}"
            )
        for seen in (*frame.cameras, *frame.moving):
            if len(set(seen.ids.tolist())) < len(seen):
                raise DataError(
                    f"{self.path}: the frame at {frame.stamp_ns} cannot be recorded, as a feature "
                    "is in it twice"
                )
        for seen in (frame.cameras[0], *frame.moving):
            wrong = unknown_labels(seen.labels)
            if wrong.size:
                raise DataError(
                    f"{self.path}: a feature with the label {wrong[0]} cannot be recorded, labels "
                    f"are 0 to {LARGEST_LABEL}"
                )

    def _append(self, imu: ImuData, frame: FeatureFrame) -> None:
        self._write_descriptors(frame.cameras[0])
        self._latest_ns = frame.stamp_ns
        samples = np.empty(len(imu), layout.IMU_RECORD)
        samples["stamp"], samples["gyro"], samples["accel"] = imu.stamps_ns, imu.gyro, imu.accel
        self._imu.write(samples.tobytes())
        row = np.empty(1, self._record)
        row["stamp"], row["counts"] = frame.stamp_ns, [len(seen) for seen in frame.cameras]
        self._frames.write(row.tobytes())
        for seen in frame.cameras:
            self._features.write(packed(seen, layout.FEATURE_RECORD).tobytes())
        if self._depth_camera is not None:
            self._depths.write(_pack_depth(frame.cameras[self._depth_camera]).tobytes())
        self._objects.write(frame)
        self._counts["frames"] += 1
        self._counts["imu_samples"] += len(imu)
        self._counts["features"] += sum(len(seen) for seen in frame.cameras)

    def _write_descriptors(self, seen: FeatureObservations) -> None:
        """Append the descriptors of the first camera; all have the length of the first ones."""
        if len(seen) == 0:
            return
        descriptors = seen.descriptors
        width = 0 if descriptors is None else descriptors.shape[1]
        if self._descriptor_bytes is None:
            self._descriptor_bytes = width
            if width:
                self._descriptors = self._open(layout.DESCRIPTORS)
        if width != self._descriptor_bytes:
            raise DataError(
                f"{self.path}: descriptors of {width} bytes cannot be recorded after some of "
                f"{self._descriptor_bytes}"
            )
        if descriptors is not None:
            self._descriptors.write(np.ascontiguousarray(descriptors, np.uint8).tobytes())

    def _open(self, name: str) -> BinaryIO:
        return self._files.enter_context((self._folder / name).open("wb"))

    def _finish(self, of_objects: Mapping[str, Any]) -> None:
        """Write the small files, and move the folder to its place.

        Args:
            of_objects: what is said of labels and features that move.
        """
        meta: dict[str, Any] = {
            "format": layout.FORMAT_NAME,
            "version": layout.FORMAT_VERSION,
            "name": self.name,
            "cameras": len(self.rig.cameras),
            **self._counts,
            "descriptor_bytes": self._descriptor_bytes or 0,
        }
        if self._depth_camera is not None:
            meta["depth_camera"] = self._depth_camera
        meta |= of_objects
        write_kalibr(self.rig, self._folder / layout.CALIBRATION)
        if self._groundtruth is not None:
            save_trajectory(self._folder / layout.GROUNDTRUTH, self._groundtruth)
        if self._initial_state is not None:
            save_state(self._folder / layout.INITIAL_STATE, self._initial_state)
        (self._folder / layout.META).write_text(yaml.safe_dump(meta, sort_keys=False))
        texts = self._notes | aiding_texts(AidingData.concatenate(self._aiding))
        for name, text in texts.items():
            (self._folder / name).write_text(text, encoding="utf-8")
        self._folder.chmod(0o755)
        self._folder.rename(self.path)


def _pack_depth(seen: FeatureObservations) -> NDArray[np.void]:
    rows = np.full(len(seen), np.nan, layout.DEPTH_RECORD)
    if seen.depth_m is not None and seen.depth_sigma_m is not None:
        rows["depth"], rows["sigma"] = seen.depth_m, seen.depth_sigma_m
    return rows
