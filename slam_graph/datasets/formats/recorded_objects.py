# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a recording of tracks knows of objects: labels of masks, and features that move.

`track_recording` describes the files. Recordings without either have none of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.datasets.formats.recorded_files import AGAIN, check_length, packed
from slam_graph.datasets.streams.mask_images import LARGEST_LABEL
from slam_graph.errors import DataError
from slam_graph.sensors import FeatureFrame, FeatureObservations

LABELS, MOVING, MOVING_FRAMES = "labels.bin", "moving.bin", "moving_frames.bin"

LABEL_RECORD, COUNT_RECORD = np.dtype("<i4"), np.dtype("<i8")
MOVING_RECORD = np.dtype(
    [("id", "<i8"), ("pixel", "<f8", (2,)), ("normalized", "<f8", (2,)), ("label", "<i4")]
)
_NO_MASK = -1
"""Label of the features of a frame without a mask."""


class ObjectColumns:
    """Writes labels from the first frame on that has some, and likewise features that move.

    Args:
        open_file: opens a file of the recording by its name.
    """

    def __init__(self, open_file: Callable[[str], BinaryIO]) -> None:
        self._open_file = open_file
        self._labels: BinaryIO | None = None
        self._moving: BinaryIO | None = None
        self._moving_frames: BinaryIO | None = None
        self._features = 0  # of the first camera
        self._frames = self._moved = 0  # frames so far, and features that move in them

    def write(self, frame: FeatureFrame) -> None:
        """Append a frame."""
        seen = frame.cameras[0]
        if seen.labels is not None and self._labels is None:
            self._labels = self._open_file(LABELS)
            self._labels.write(_labels(None, self._features).tobytes())
        if self._labels is not None:
            self._labels.write(_labels(seen.labels, len(seen)).tobytes())
        self._features += len(seen)
        moving = frame.moving or (FeatureObservations.empty(),) * len(frame.cameras)
        counts = np.array([len(camera) for camera in moving], COUNT_RECORD)
        if self._moving is None and counts.any():
            self._moving = self._open_file(MOVING)
            self._moving_frames = self._open_file(MOVING_FRAMES)
            self._moving_frames.write(np.zeros(self._frames * len(moving), COUNT_RECORD).tobytes())
        if self._moving is not None and self._moving_frames is not None:
            self._moving_frames.write(counts.tobytes())
            for camera in moving:
                self._moving.write(_pack(camera).tobytes())
        self._frames += 1
        self._moved += int(counts.sum())

    def finish(self) -> dict[str, Any]:
        """What ``meta.yaml`` says of them."""
        meta: dict[str, Any] = {}
        if self._labels is not None:
            meta["labels"] = 1
        if self._moving is not None:
            meta["moving_features"] = self._moved
        return meta


class RecordedObjects:
    """Reads what `ObjectColumns` wrote.

    Args:
        folder: of the recording.
        counts: (F, C) features of each frame and camera in ``features.bin``.
        labels: whether features have labels.
        moving: how many features move; 0 without those files.

    Raises:
        DataError: if a file is missing, or not as long as it should be.
    """

    def __init__(self, folder: Path, counts: NDArray[np.int64], labels: bool, moving: int) -> None:
        self._folder = folder
        self._first = np.concatenate([[0], np.cumsum(counts[:, 0])]).tolist()
        self._has_labels, self._has_moving = labels, moving > 0
        if labels:
            check_length(folder / LABELS, self._first[-1] * LABEL_RECORD.itemsize)
        if moving:
            check_length(folder / MOVING, moving * MOVING_RECORD.itemsize)
            check_length(folder / MOVING_FRAMES, counts.size * COUNT_RECORD.itemsize)
            found = np.fromfile(folder / MOVING_FRAMES, COUNT_RECORD)
            # each is checked before the sum, which cannot overflow then
            if np.any((found < 0) | (found > moving)) or int(found.sum()) != moving:
                raise DataError(
                    f"{folder / MOVING_FRAMES}: the numbers of features do not add up to the "
                    f"{moving} of meta.yaml; {AGAIN}"
                )
            ends = np.concatenate([[0], np.cumsum(found)])
            self._starts = ends[:-1].reshape(counts.shape)
            self._ends = ends[1:].reshape(counts.shape)

    def labelled(self, seen: FeatureObservations, row: int) -> FeatureObservations:
        """The features of the first camera in a frame, with their labels.

        Raises:
            DataError: if a label is none.
        """
        if not self._has_labels:
            return seen
        first, end = self._first[row : row + 2]
        labels = self._rows(LABELS, LABEL_RECORD, first, end).astype(np.int64)
        return replace(seen, labels=self._checked(labels, LABELS))

    def moving(self, row: int, cameras: int) -> list[tuple[NDArray[np.void], IntArray | None]]:
        """Features that move in a frame, for each of the first cameras: rows and labels.

        Returns:
            Nothing if the recording has none at all.

        Raises:
            DataError: if a label is none.
        """
        if not self._has_moving:
            return []
        found = []
        for camera in range(cameras):
            first, end = int(self._starts[row, camera]), int(self._ends[row, camera])
            rows, labels = self._rows(MOVING, MOVING_RECORD, first, end), None
            if camera == 0 and self._has_labels:
                labels = self._checked(rows["label"].astype(np.int64), MOVING)
            found.append((rows, labels))
        return found

    def _checked(self, labels: IntArray, name: str) -> IntArray | None:
        """Labels of one frame; None if it has no mask."""
        if len(labels) and np.all(labels == _NO_MASK):
            return None
        if unknown_labels(labels).size:
            raise DataError(f"{self._folder / name}: a label is not 0 to {LARGEST_LABEL}; {AGAIN}")
        return labels

    def _rows(self, name: str, record: np.dtype[Any], first: int, end: int) -> NDArray[Any]:
        """Some rows of a file."""
        offset = first * record.itemsize
        return np.fromfile(self._folder / name, record, end - first, offset=offset)


def unknown_labels(labels: IntArray | None) -> IntArray:
    """Those of the labels (N,) of a frame that no mask can have; none if it has no mask."""
    if labels is None:
        return np.zeros(0, np.int64)
    return np.asarray(labels[(labels < 0) | (labels > LARGEST_LABEL)])


def _labels(labels: IntArray | None, count: int) -> NDArray[np.int32]:
    """Labels as they are recorded."""
    return np.full(count, _NO_MASK, LABEL_RECORD) if labels is None else labels.astype(LABEL_RECORD)


def _pack(seen: FeatureObservations) -> NDArray[np.void]:
    rows = packed(seen, MOVING_RECORD)
    rows["label"] = _labels(seen.labels, len(seen))
    return rows
