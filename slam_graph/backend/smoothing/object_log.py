# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The tracks of moving objects, on disk, for the adjustment of each object as a whole.

A track is known to be of an object only after some frames, so frames wait for a while before they
are written, with the tracks that have been of any object by then. Of which object a track is, is
decided at the end: of the one that it was of in most frames.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.datasets import TrackRecorder, open_dataset
from slam_graph.sensors import FeatureFrame, ImuData, Rig

_NONE = 0
"""Stands for the number of an object where a track is of none."""


class ObjectLog:
    """Records the tracks of moving objects.

    Args:
        recorder: of the tracks.
        delay_s: how long a frame waits.
    """

    def __init__(self, recorder: TrackRecorder, delay_s: float) -> None:
        self._recorder = recorder
        self._delay_ns = round(delay_s * 1e9)
        self._waiting: deque[FeatureFrame] = deque()
        self._frames_of: dict[int, Counter[int]] = {}  # by track: frames by number of the object

    @classmethod
    @contextmanager
    def recording(cls, rig: Rig, delay_s: float, folder: Path) -> Iterator[ObjectLog]:
        """A log that takes frames inside of the block and can be read after it.

        Args:
            rig: the cameras.
            delay_s: how long a frame waits.
            folder: for the files.
        """
        with TrackRecorder(folder / "objects", rig.without_imu()) as recorder:
            log = cls(recorder, delay_s)
            yield log
            log._write(len(log._waiting))

    def add(self, frame: FeatureFrame, members: Mapping[int, int]) -> None:
        """Take a frame, later than the one before.

        Args:
            frame: all features.
            members: number of the object by feature, of those that are of one.
        """
        for feature, number in members.items():
            self._frames_of.setdefault(feature, Counter())[number] += 1
        for feature in frame.cameras[0].ids.tolist():
            if feature in self._frames_of and feature not in members:
                self._frames_of[feature][_NONE] += 1
        self._waiting.append(frame)
        old = [f for f in self._waiting if f.stamp_ns < frame.stamp_ns - self._delay_ns]
        self._write(len(old))

    def _write(self, count: int) -> None:
        for _ in range(count):
            frame = self._waiting.popleft()
            self._recorder.write(ImuData.empty(), frame.only(self._known))

    @property
    def _known(self) -> IntArray:
        return np.fromiter(self._frames_of, np.int64, len(self._frames_of))

    def tracks(self) -> dict[int, IntArray]:
        """Ids (N,) of the tracks of each object, by its number."""
        found: dict[int, list[int]] = {}
        for feature, frames in self._frames_of.items():
            number, _ = max(frames.items(), key=lambda item: (item[1], -item[0]))
            if number != _NONE:
                found.setdefault(number, []).append(feature)
        return {number: np.unique(ids) for number, ids in found.items()}

    def frames(self, ids: IntArray) -> Iterator[FeatureFrame]:
        """The frames that see some tracks, with these only."""
        for packet in open_dataset(self._recorder.path, "recording").packets():
            assert isinstance(packet.frame, FeatureFrame)
            frame = packet.frame.only(ids)
            if any(len(seen) for seen in frame.cameras):
                yield frame
