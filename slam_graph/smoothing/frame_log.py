# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run keeps for the bundle adjustment over the whole recording: all its frames, on disk.

In memory stay the times of the frames, the noise of the IMU, and which frames are keyframes: some
30 bytes a frame. Observations and IMU samples go into a track recording in a temporary folder, from
which any part is read back.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets.formats.track_recorder import TrackRecorder
from slam_graph.datasets.formats.track_recording import TrackRecordingSequence
from slam_graph.datasets.sequence import ReaderOptions
from slam_graph.diagnostics import Diagnostics
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData, Packet
from slam_graph.sensors.rig import Rig
from slam_graph.smoothing.smoothing_config import FinalBaConfig

MAX_BEYOND_NS = 100_000_000
"""Frames that the first or last IMU sample is farther from than this have no motion."""
JITTER = 0.95
"""A keyframe may come this much earlier than the spacing says: stamps jitter."""


class _Silent(Diagnostics):
    """Faults of the data have been counted when they were read for the first time."""

    def warn(self, kind: str, message: str) -> None:
        """Say nothing."""


class FrameLog:
    """Keeps the frames of a run, and chooses keyframes while it goes on.

    A frame is a keyframe if it is the first or last one, if the last keyframe is as long ago as
    the spacing says, or if few of its features are left.

    Attributes:
        rig: by which the frames were undistorted.
    """

    def __init__(self, rig: Rig, config: FinalBaConfig, folder: Path) -> None:
        self.rig = rig
        self._config = config
        self._path = folder / "frames"
        self._recorder = TrackRecorder(self._path, rig)
        self._frames = array("q")
        self._keyframes = array("q")  # numbers of frames
        self._noise = array("d")
        self._imu: list[ImuData] = []
        self._imu_ns: tuple[int, int] | None = None
        self._last_ids = np.zeros(0, np.int64)

    @classmethod
    @contextmanager
    def recording(cls, rig: Rig, config: FinalBaConfig, folder: Path) -> Iterator[FrameLog]:
        """A log to which frames can be added inside of the block, and which can be read behind it.

        Args:
            rig: the cameras that frames have observations of.
            config: which frames are keyframes.
            folder: for the files.
        """
        log = cls(rig, config, folder)
        with log._recorder:
            yield log

    def add(self, imu: ImuData, frame: FeatureFrame, noise: tuple[float, float]) -> None:
        """Take a frame; one that does not follow those before is left out.

        Args:
            imu: the samples since the frame before.
            frame: what all cameras saw.
            noise: factors on the white noise of gyroscope and accelerometer around this time.
        """
        if len(imu):
            self._imu.append(imu)
            first, last = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
            self._imu_ns = (first if self._imu_ns is None else self._imu_ns[0], last)
        if not self._follows(frame.stamp_ns):
            return
        missing = len(self.rig.cameras) - len(frame.cameras)
        cameras = frame.cameras + (FeatureObservations.empty(),) * missing
        frame = FeatureFrame(frame.stamp_ns, cameras)
        self._recorder.write(ImuData.concatenate(self._imu), frame)
        self._imu = []
        if self._is_keyframe(frame):
            self._keyframes.append(len(self._frames))
            self._last_ids = cameras[0].ids
        self._frames.append(frame.stamp_ns)
        self._noise.extend(noise)

    @property
    def frames_ns(self) -> IntArray:
        """(N,) times of all frames on the clock of the cameras."""
        return np.array(self._frames, dtype=np.int64)

    @property
    def keyframes(self) -> IntArray:
        """(K,) numbers of the frames that are keyframes, the first and the last among them."""
        numbers = np.array(self._keyframes, dtype=np.int64)
        return np.union1d(numbers, [len(self._frames) - 1]) if self._frames else numbers

    @property
    def noise(self) -> FloatArray:
        """(N, 2) factors on the noise of gyroscope and accelerometer at the frames."""
        return np.array(self._noise, dtype=np.float64).reshape(-1, 2)

    def packets(self, first: int, stop: int) -> Iterator[Packet]:
        """Frames `first` to `stop - 1`, each with the samples since the one before."""
        sequence = TrackRecordingSequence(self._path, ReaderOptions(diagnostics=_Silent()))
        yield from sequence.packets(self._frames[first], self._frames[stop - 1])

    def _follows(self, frame_ns: int) -> bool:
        """Whether a frame follows those before, at a time of which the IMU tells."""
        if self._imu_ns is None or (len(self._frames) and frame_ns <= self._frames[-1]):
            return False
        stamp_ns = frame_ns + round(self.rig.cameras[0].time_offset_s * 1e9)
        first_ns, last_ns = self._imu_ns
        return first_ns - MAX_BEYOND_NS <= stamp_ns <= last_ns + MAX_BEYOND_NS

    def _is_keyframe(self, frame: FeatureFrame) -> bool:
        if not self._keyframes:
            return True
        since_s = (frame.stamp_ns - self._frames[self._keyframes[-1]]) * 1e-9
        if since_s >= JITTER * self._config.keyframe_spacing_s:
            return True
        common = np.isin(self._last_ids, frame.cameras[0].ids)
        return len(common) > 0 and bool(common.mean() < self._config.min_common_features)
