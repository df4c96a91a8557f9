# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded feature tracks: the folder format, and its replay.

A recording is replayed bit for bit, so that every algorithm gets the same features. `TrackRecorder`
writes recordings. All numbers are little-endian, and no file is a pickle:

- ``meta.yaml``: `format` (``slam_graph-tracks``), `version`, the `name` of what was recorded (the
  recording itself has the name of its folder), and the number of `cameras`, `frames`, `imu_samples`
  and `features`, by which a truncated file is recognised;
- ``calibration.yaml``: the rig, as `slam_graph.datasets.calibration.kalibr_calibration` writes it;
- ``frames.bin``: for each frame `stamp` (int64, ns) and `counts` (int64 for each camera), the
  number of features of each camera;
- ``features.bin``: for each feature `id` (int64), `pixel` and `normalized` (two float64 each),
  ordered by frame, then camera, then as in the `FeatureFrame`;
- ``depths.bin``, where the depth of features is measured (`depth_camera` of ``meta.yaml``): for
  each feature of that camera, in the same order, `depth` and `sigma` (float64 each, NaN for none);
- ``descriptors.bin``, where features have any: for each feature of the first camera, in the same
  order, `descriptor_bytes` of ``meta.yaml`` bytes (0 or missing if there are none);
- ``labels.bin``, where features have labels of masks (`labels` of ``meta.yaml`` is 1): for each
  feature of the first camera, in the same order, its label (int32; 0 for none, -1 for all features
  of a frame without a mask). Names of labels are in ``classes.csv`` (`label,name`);
- ``moving.bin`` and ``moving_frames.bin``, where features move by themselves and are kept apart
  from the others (`FeatureFrame.moving`): for each of them, ordered as in ``features.bin``, `id`,
  `pixel` and `normalized` as there and `label` (int32); and for each frame their number in each
  camera (int64). ``meta.yaml`` has their number, `moving_features`;
- ``imu.bin``: for each sample `stamp` (int64, ns), `gyro` and `accel` (three float64 each);
- ``groundtruth.npz`` and ``initial_state.npz``, where there are any: the arrays of `Trajectory` and
  `NavState` under their names (`world_T_body` as a 4x4 matrix).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import BinaryIO, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.datasets.calibration.calibration_yaml import YamlValue, read_yaml
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr
from slam_graph.datasets.formats.recorded_files import AGAIN, check_length
from slam_graph.datasets.formats.recorded_objects import MOVING, RecordedObjects
from slam_graph.datasets.formats.recorded_states import load_state, load_trajectory
from slam_graph.datasets.sequence import (
    FrameStream,
    ReaderOptions,
    RecordedSequence,
    SequenceInfo,
)
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.datasets.streams.mask_images import MASKS, MaskFolder, read_classes
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData

FORMAT_NAME = "slam_graph-tracks"
FORMAT_VERSION = 1

META, CALIBRATION = "meta.yaml", "calibration.yaml"
FRAMES, FEATURES, IMU = "frames.bin", "features.bin", "imu.bin"
DESCRIPTORS, DEPTHS = "descriptors.bin", "depths.bin"
GROUNDTRUTH, INITIAL_STATE = "groundtruth.npz", "initial_state.npz"

IMU_RECORD = np.dtype([("stamp", "<i8"), ("gyro", "<f8", (3,)), ("accel", "<f8", (3,))])
FEATURE_RECORD = np.dtype([("id", "<i8"), ("pixel", "<f8", (2,)), ("normalized", "<f8", (2,))])
DEPTH_RECORD = np.dtype([("depth", "<f8"), ("sigma", "<f8")])


_MAX_CAMERAS = 64


def frame_record(cameras: int) -> np.dtype[np.void]:
    """Type of a row of ``frames.bin`` for a number of cameras."""
    return np.dtype([("stamp", "<i8"), ("counts", "<i8", (cameras,))])


SAMPLES_PER_BLOCK = 4096
"""IMU samples that are read at a time."""


def _where(name: str, first: int, index: int) -> str:
    return f"{name}: sample {first + index}"


def _whole(value: YamlValue, least: int = 0, most: int = 2**53) -> int:
    """A whole number of ``meta.yaml`` within bounds."""
    number = value.number()
    if number != int(number) or not least <= number <= most:
        raise DataError(f"{value.where}: expected a whole number from {least} to {most}")
    return int(number)


def is_recording(path: Path) -> bool:
    """Whether a folder is one that `TrackRecorder` wrote, its ``meta.yaml`` readable or not."""
    meta = path / META
    if not meta.is_file():
        return False
    return (path / FEATURES).is_file() or FORMAT_NAME in meta.read_text(errors="replace")[:200]


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
        meta = read_yaml(path / META)
        kind = meta.require("format")
        if kind.text() != FORMAT_NAME:
            raise DataError(f"{kind.where}: expected {FORMAT_NAME}, got {kind.text()[:20]}")
        version = meta.require("version")
        if version.text() != str(FORMAT_VERSION):
            raise DataError(
                f"{version.where}: recording of version {version.text()[:20]}, this program reads "
                f"version {FORMAT_VERSION}; {AGAIN}"
            )
        recorded = read_kalibr(path / CALIBRATION)
        chain = options.calibration
        self._recalibrated = chain is not None
        rig = recorded
        if chain is not None:
            rig = read_kalibr(chain, fallback=recorded.imu, needs_imu=recorded.has_imu)
        rig = replace(options.select(rig), has_imu=recorded.has_imu)
        truth = path / GROUNDTRUTH
        own = partial(load_trajectory, truth) if truth.is_file() else None
        super().__init__(path.resolve().name, rig, options, own)
        counts = {
            name: _whole(meta.require(name)) for name in ("frames", "imu_samples", "features")
        }
        self._samples = counts["imu_samples"]
        self._cameras = _whole(meta.require("cameras"), 1, _MAX_CAMERAS)
        if len(rig.cameras) > self._cameras:
            raise DataError(f"{path}: has {self._cameras} cameras, fewer than the calibration")
        width = meta.get("descriptor_bytes")
        self._descriptor_bytes = 0 if width is None else _whole(width)
        depth_camera = meta.get("depth_camera")
        most = self._cameras - 1
        self._depth_camera = None if depth_camera is None else _whole(depth_camera, 0, most)
        if self._depth_camera is not None and chain is not None and rig.depth is None:
            what = f"{chain}: has no 'depth0', so the depth of {path} means nothing"
            self.diagnostics.warn("depth_left_out", what)
        self._record = frame_record(self._cameras)
        self._check_sizes(counts)
        self._index = np.fromfile(path / FRAMES, self._record)
        self._check_index(counts["features"])
        self._check_descriptors()
        if self._depth_camera is not None:
            features = int(self._index["counts"][:, self._depth_camera].sum())
            check_length(self.path / DEPTHS, features * DEPTH_RECORD.itemsize)
        labels, moving = meta.get("labels"), meta.get("moving_features")
        self._has_labels = labels is not None and _whole(labels, 0, 1) > 0
        moves = 0 if moving is None else _whole(moving)
        self._objects = RecordedObjects(path, self._index["counts"], self._has_labels, moves)

    @property
    def mask_classes(self) -> dict[int, str]:
        """Name of the class by label: of the masks, if some are used, or as it was recorded."""
        return read_classes(self.path) if self._mask_folder is None else super().mask_classes

    @cached_property
    def _mask_folder(self) -> MaskFolder | None:
        """Masks that were named; those beside the recording only if it has no labels."""
        if self._has_labels and MASKS not in self.named_aiding:
            return None
        return self._found_masks()

    def measure(self) -> SequenceInfo:
        """How much was recorded."""
        stamps = self._index["stamp"]
        ends = (int(stamps[0]), int(stamps[-1])) if len(stamps) else (0, 0)
        return self.holding(len(stamps), *ends, self._samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The IMU stream from `after_ns` on."""
        return clean_blocks(self._samples_in_blocks(after_ns), self.diagnostics, after_ns)

    def _samples_in_blocks(
        self, after_ns: int | None
    ) -> Iterator[tuple[Callable[[int], str], ImuData]]:
        with (self.path / IMU).open("rb") as file:
            first = 0 if after_ns is None else self._first_sample(file, after_ns)
            file.seek(first * IMU_RECORD.itemsize)
            while len(rows := np.fromfile(file, IMU_RECORD, SAMPLES_PER_BLOCK)):
                data = ImuData(*(np.ascontiguousarray(rows[n]) for n in ("stamp", "gyro", "accel")))
                yield partial(_where, file.name, first), data
                first += len(rows)

    def _first_sample(self, file: BinaryIO, after_ns: int) -> int:
        """The first sample of the first block that is needed from a time on.

        A block is not needed if its last stamp and the next one, of which one may be damaged, are
        before that time.
        """
        first = 0
        while first + SAMPLES_PER_BLOCK < self._samples:
            file.seek((first + SAMPLES_PER_BLOCK - 1) * IMU_RECORD.itemsize)
            if np.any(np.fromfile(file, IMU_RECORD, 2)["stamp"] >= after_ns):
                break
            first += SAMPLES_PER_BLOCK
        return first

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """The recorded frames, read one by one."""
        wanted = np.flatnonzero(self.within(self._index["stamp"], start_ns, end_ns))
        if len(wanted) == 0:
            return
        size, before = FEATURE_RECORD.itemsize, self._index["counts"][: wanted[0]]
        with ExitStack() as files:
            file = files.enter_context((self.path / FEATURES).open("rb"))
            file.seek(int(before.sum()) * size)
            descriptors_file = self._open_descriptors(files, int(before[:, 0].sum()))
            depths_file = self._open_depths(files, before)
            for number in range(int(wanted[0]), int(wanted[-1]) + 1):
                row = self._index[number]
                counts = row["counts"].tolist()
                features = np.frombuffer(file.read(sum(counts) * size), FEATURE_RECORD)
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
                if depths_file is not None and self._depth_camera is not None:
                    measured = depths_file.read(counts[self._depth_camera] * DEPTH_RECORD.itemsize)
                    if self._depth_camera < len(observed):
                        seen = observed[self._depth_camera]
                        observed[self._depth_camera] = self._with_depth(seen, measured)
                observed[0] = self._objects.labelled(observed[0], number)
                moving = tuple(
                    replace(self._unpack(rows, camera, MOVING), labels=labels)
                    for camera, (rows, labels) in enumerate(
                        self._objects.moving(number, len(observed))
                    )
                )
                yield FeatureFrame(
                    int(row["stamp"]),
                    self._seen_by_lenses(observed),
                    moving=self._seen_by_lenses(moving),
                )

    def features(self, first_ns: int, last_ns: int) -> tuple[IntArray, NDArray[np.void]]:
        """All features of some frames at once, as they were recorded.

        Those of all cameras, with the calibration of the recording, whatever it was opened with.

        Args:
            first_ns: time of the first of these frames.
            last_ns: time of the last one.

        Returns:
            The number (F, C) of features by frame and camera, and the features (N,), frame by frame
            and camera by camera, with `id`, `pixel` and `normalized`.

        Raises:
            DataError: if one is not finite.
        """
        stamps, counts = self._index["stamp"], self._index["counts"]
        first, stop = stamps.searchsorted(first_ns), stamps.searchsorted(last_ns, side="right")
        before, count = int(counts[:first].sum()), int(counts[first:stop].sum())
        offset = before * FEATURE_RECORD.itemsize
        rows = np.fromfile(self.path / FEATURES, FEATURE_RECORD, count, offset=offset)
        if not all(Files.are_measurable(rows[name]).all() for name in ("pixel", "normalized")):
            raise DataError(f"{self.path / FEATURES}: a feature is not finite, or too far; {AGAIN}")
        return counts[first:stop], rows

    def initial_state(self) -> NavState | None:
        """The state at the start, if one was recorded."""
        file = self.path / INITIAL_STATE
        return load_state(file) if file.is_file() else None

    def _unpack(
        self, rows: NDArray[np.void], camera: int, name: str = FEATURES
    ) -> FeatureObservations:
        ids, pixels = (np.ascontiguousarray(rows[name]) for name in ("id", "pixel"))
        if self._recalibrated:
            with np.errstate(all="ignore"):  # beyond the edge of the lens: left out later
                normalized = self.rig.cameras[camera].camera.undistort(pixels)
        else:
            normalized = np.ascontiguousarray(rows["normalized"])
        used = Files.are_measurable(pixels).all() and (
            self._recalibrated or Files.are_measurable(normalized).all()
        )
        if not used:
            raise DataError(f"{self.path / name}: a feature is not finite, or too far; {AGAIN}")
        if len(set(ids.tolist())) < len(ids):
            raise DataError(f"{self.path / name}: a feature is in a frame twice; {AGAIN}")
        return FeatureObservations(ids, pixels, normalized)

    def _seen_by_lenses(
        self, cameras: Sequence[FeatureObservations]
    ) -> tuple[FeatureObservations, ...]:
        """Without what is outside of the view of the lens by another calibration."""
        if not self._recalibrated:
            return tuple(cameras)
        seen = []
        for observed, mounted in zip(cameras, self.rig.cameras, strict=False):  # moving: or none
            inside = mounted.camera.visible(observed.pixels)[1]
            seen.append(observed if inside.all() else observed.select(inside))
        lost = sum(map(len, cameras)) - sum(map(len, seen))
        if lost:
            text = f"{lost} features of a frame are outside of the view of the lens"
            self.diagnostics.warn("feature_outside_lens", text)
        return tuple(seen)

    def _with_depth(self, seen: FeatureObservations, data: bytes) -> FeatureObservations:
        rows = np.frombuffer(data, DEPTH_RECORD)
        depth, sigma = (np.ascontiguousarray(rows[name]) for name in ("depth", "sigma"))
        known = ~np.isnan(depth)
        usable = (depth[known] > 0.0) & np.isfinite(depth[known]) & (sigma[known] > 0.0)
        if not (usable.all() and np.isfinite(sigma[known]).all()):
            raise DataError(f"{self.path / DEPTHS}: a depth or its sigma is not positive; {AGAIN}")
        return replace(seen, depth_m=depth, depth_sigma_m=sigma)

    def _open_depths(self, files: ExitStack, before: NDArray[np.int64]) -> BinaryIO | None:
        """The file of depths, positioned after frames with `before` (F, cameras) features."""
        if self._depth_camera is None:
            return None
        file = files.enter_context((self.path / DEPTHS).open("rb"))
        file.seek(int(before[:, self._depth_camera].sum()) * DEPTH_RECORD.itemsize)
        return file

    def _open_descriptors(self, files: ExitStack, first: int) -> BinaryIO | None:
        """The file of descriptors, positioned at feature `first`; None where there are none."""
        if self._descriptor_bytes == 0:
            return None
        file = files.enter_context((self.path / DESCRIPTORS).open("rb"))
        file.seek(first * self._descriptor_bytes)
        return file

    def _check_index(self, features: int) -> None:
        """Refuse counts that are not those of the features, and times out of order."""
        counts, stamps = self._index["counts"], self._index["stamp"]
        # each is checked before the sum, which cannot overflow then
        if np.any((counts < 0) | (counts > features)) or int(counts.sum()) != features:
            raise DataError(
                f"{self.path / FRAMES}: the numbers of features do not add up to the {features} of "
                f"{META}; {AGAIN}"
            )
        if np.any(stamps[1:] <= stamps[:-1]) or not Files.are_times(stamps).all():
            raise DataError(f"{self.path / FRAMES}: the times do not increase; {AGAIN}")

    def _check_descriptors(self) -> None:
        if self._descriptor_bytes:
            features = int(self._index["counts"][:, 0].sum())
            check_length(self.path / DESCRIPTORS, features * self._descriptor_bytes)

    def _check_sizes(self, counts: dict[str, int]) -> None:
        """Refuse files that are not as long as the recorder left them."""
        sizes = {
            FRAMES: counts["frames"] * self._record.itemsize,
            IMU: counts["imu_samples"] * IMU_RECORD.itemsize,
            FEATURES: counts["features"] * FEATURE_RECORD.itemsize,
        }
        for name, expected in sizes.items():
            check_length(self.path / name, expected)
