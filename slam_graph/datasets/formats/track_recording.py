# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded feature tracks: replayed, so that every algorithm gets the same features.

`TrackRecorder` writes recordings; `track_format` describes the files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.formats import track_format as layout
from slam_graph.datasets.sequence import (
    Extent,
    FrameStream,
    ReaderOptions,
    RecordedSequence,
    within,
)
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.errors import DataError
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData, read_kalibr, read_yaml

SAMPLES_PER_BLOCK = 4096
"""IMU samples that are read at a time."""


def _where(name: str, first: int, index: int) -> str:
    return f"{name}: sample {first + index}"


def is_recording(path: Path) -> bool:
    """Whether a folder is one that `TrackRecorder` wrote."""
    meta = path / layout.META
    return meta.is_file() and layout.FORMAT_NAME in meta.read_text(errors="replace")[:200]


class TrackRecordingSequence(RecordedSequence):
    """Replays what a `TrackRecorder` wrote.

    Args:
        path: the folder.
        options: what else is asked for. With another calibration the normalised coordinates are
            computed anew from the pixels.

    Raises:
        DataError: if a file is missing or cut, or the recording is of another version.
    """

    format: ClassVar[str] = "recording"
    content: ClassVar[Literal["images", "tracks"]] = "tracks"

    def __init__(self, path: Path, options: ReaderOptions | None = None) -> None:
        options = options or ReaderOptions()
        self.path = path
        meta = read_yaml(path / layout.META)
        version = meta.require("version")
        if version.text() != str(layout.FORMAT_VERSION):
            raise DataError(
                f"{version.where}: recording of version {version.text()}, this program reads "
                f"version {layout.FORMAT_VERSION}; record it again"
            )
        recorded = read_kalibr(path / layout.CALIBRATION)
        chain = options.calibration
        self._recalibrated = chain is not None
        rig = options.select(recorded if chain is None else read_kalibr(chain))
        truth = path / layout.GROUNDTRUTH
        own = partial(layout.load_trajectory, truth) if truth.is_file() else None
        super().__init__(meta.require("name").text(), rig, options, own)
        counts = {
            name: int(meta.require(name).number()) for name in ("frames", "imu_samples", "features")
        }
        self._samples = counts["imu_samples"]
        self._cameras = int(meta.require("cameras").number())
        if len(rig.cameras) > self._cameras:
            raise DataError(f"{path}: has {self._cameras} cameras, fewer than the calibration")
        width = meta.get("descriptor_bytes")
        self._descriptor_bytes = 0 if width is None else int(width.number())
        self._record = layout.frame_record(self._cameras)
        self._check_sizes(counts)
        self._index = np.fromfile(path / layout.FRAMES, self._record)
        self._check_descriptors()

    def measure(self) -> Extent:
        """How much was recorded."""
        stamps = self._index["stamp"]
        ends = (int(stamps[0]), int(stamps[-1])) if len(stamps) else (0, 0)
        return Extent(len(stamps), *ends, self._samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The IMU stream from `after_ns` on."""
        return clean_blocks(self._samples_in_blocks(), self.diagnostics, after_ns)

    def _samples_in_blocks(self) -> Iterator[tuple[Callable[[int], str], ImuData]]:
        with (self.path / layout.IMU).open("rb") as file:
            first = 0
            while len(rows := np.fromfile(file, layout.IMU_RECORD, SAMPLES_PER_BLOCK)):
                data = ImuData(*(np.ascontiguousarray(rows[n]) for n in ("stamp", "gyro", "accel")))
                yield partial(_where, file.name, first), data
                first += len(rows)

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """The recorded frames, read one by one."""
        wanted = np.flatnonzero(within(self._index["stamp"], start_ns, end_ns))
        if len(wanted) == 0:
            return
        size, before = layout.FEATURE_RECORD.itemsize, self._index["counts"][: wanted[0]]
        with ExitStack() as files:
            file = files.enter_context((self.path / layout.FEATURES).open("rb"))
            file.seek(int(before.sum()) * size)
            descriptors_file = self._open_descriptors(files, int(before[:, 0].sum()))
            for row in self._index[wanted[0] : wanted[-1] + 1]:
                counts = row["counts"].tolist()
                features = np.frombuffer(file.read(sum(counts) * size), layout.FEATURE_RECORD)
                ends = np.cumsum([0, *counts]).tolist()
                observed = [
                    self._unpack(features[ends[c] : ends[c + 1]], c)
                    for c in range(len(self.rig.cameras))
                ]
                if descriptors_file is not None:
                    rows = np.frombuffer(
                        descriptors_file.read(counts[0] * self._descriptor_bytes), np.uint8
                    )
                    descriptors = rows.reshape(counts[0], self._descriptor_bytes)
                    observed[0] = replace(observed[0], descriptors=descriptors)
                yield FeatureFrame(int(row["stamp"]), tuple(observed))

    def initial_state(self) -> NavState | None:
        """The state at the start, if one was recorded."""
        file = self.path / layout.INITIAL_STATE
        return layout.load_state(file) if file.is_file() else None

    def _unpack(self, rows: NDArray[np.void], camera: int) -> FeatureObservations:
        ids, pixels = (np.ascontiguousarray(rows[name]) for name in ("id", "pixel"))
        if self._recalibrated:
            normalized = self.rig.cameras[camera].camera.undistort(pixels)
        else:
            normalized = np.ascontiguousarray(rows["normalized"])
        return FeatureObservations(ids, pixels, normalized)

    def _open_descriptors(self, files: ExitStack, first: int) -> BinaryIO | None:
        """The file of descriptors, positioned at feature `first`; None where there are none."""
        if self._descriptor_bytes == 0:
            return None
        file = files.enter_context((self.path / layout.DESCRIPTORS).open("rb"))
        file.seek(first * self._descriptor_bytes)
        return file

    def _check_descriptors(self) -> None:
        if self._descriptor_bytes:
            features = int(self._index["counts"][:, 0].sum())
            self._check_size(layout.DESCRIPTORS, features * self._descriptor_bytes)

    def _check_sizes(self, counts: dict[str, int]) -> None:
        """Refuse files that are not as long as the recorder left them."""
        sizes = {
            layout.FRAMES: counts["frames"] * self._record.itemsize,
            layout.IMU: counts["imu_samples"] * layout.IMU_RECORD.itemsize,
            layout.FEATURES: counts["features"] * layout.FEATURE_RECORD.itemsize,
        }
        for name, expected in sizes.items():
            self._check_size(name, expected)

    def _check_size(self, name: str, expected: int) -> None:
        file = self.path / name
        size = file.stat().st_size if file.is_file() else -1
        if size != expected:
            found = "missing" if size < 0 else f"{size} bytes long"
            raise DataError(
                f"{file}: {found}, {layout.META} says {expected} bytes; record it again"
            )
