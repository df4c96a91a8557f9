# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The log of all frames of a run, on disk, for the bundle adjustment over the whole recording.

Times, noise factors of the IMU and the keyframe flags stay in memory, about 30 bytes a frame.
Observations and IMU samples go into a track recording in a temporary folder, of which any part can
be read back.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.depth_camera import with_depth_camera, with_depth_observed
from slam_graph.backend.dynamics import motionless_samples
from slam_graph.backend.initialization.clock_change import ClockChanges
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.datasets import TrackRecorder
from slam_graph.diagnostics import Diagnostics
from slam_graph.sensors import (
    AidingData,
    FeatureFrame,
    FeatureObservations,
    ImuData,
    Rig,
)

_MAX_BEYOND_NS = 100_000_000
"""Frames farther outside of the IMU samples than this are left out."""
_SPACING_WITHOUT_IMU_S = 0.05
"""Longest time between keyframes without an IMU, which else tells the motion between them."""
_AROUND_NS = 200_000_000
"""Samples so much earlier are read where the clock of the IMU has become earlier."""
_HISTORY_NS = 1_000_000_000
"""Samples so much before the first frame are read."""
_JITTER = 0.95
"""Part of the keyframe spacing that is enough, because time stamps jitter."""


class _Silent(Diagnostics):
    """Counts nothing: faults of the data were counted when they were read for the first time."""

    def warn(self, kind: str, message: str) -> None:
        """Count nothing."""


class FrameLog:
    """Records the frames of a run and selects keyframes.

    A frame is a keyframe if it is the first or the last one, if the keyframe spacing has passed
    since the last keyframe, or if few features of the last keyframe are still tracked.

    Attributes:
        rig: the calibration with which the frames were undistorted.
        observations: number of all of them.
        clock_changes: of the IMU, which are corrected where samples are read.
        georeferenced: whether the causal estimate is in the world of the position fixes.
        fix_offset_s: added to the times of the fixes, beyond the given offset.
        fix_calibration: lever arm and clock of the fixes, where they are variables.
        left_out: ids (N,) of features that are not read back: those of moving objects, which are
            known only after some frames.
    """

    def __init__(
        self, rig: Rig, config: FinalBaConfig, folder: Path, motion_known: bool = False
    ) -> None:
        self._motion_known = rig.has_imu or motion_known
        self._real_rig, self.rig = rig, with_depth_camera(rig)
        # the depth sensor is a camera in it, and the samples of the dynamics are those of an IMU
        recorded = replace(self.rig, depth=None, has_imu=True)
        self._config = config
        self._recorder = TrackRecorder(folder / "frames", recorded)
        self._frames = array("q")
        self._keyframes = array("q")  # numbers of frames
        self._noise = array("d")
        self._lead_ns = round(rig.end_offset_s * 1e9)
        self._imu: list[ImuData] = []
        self._imu_ns: tuple[int, int] | None = None
        self._last_ids = np.zeros(0, np.int64)
        self._aiding: list[AidingData] = []
        self.observations = 0
        self.clock_changes = ClockChanges()
        self.georeferenced, self.fix_offset_s = False, 0.0
        self.fix_calibration: AidingData.Calibration | None = None
        self.left_out: IntArray = np.zeros(0, np.int64)

    @classmethod
    @contextmanager
    def recording(
        cls, rig: Rig, config: FinalBaConfig, folder: Path, motion_known: bool = False
    ) -> Iterator[FrameLog]:
        """A log that takes frames inside of the block and can be read after it.

        Args:
            rig: the cameras that frames have observations of.
            config: which frames are keyframes.
            folder: for the files.
            motion_known: whether samples are given although there is no IMU: of the known part of
                the motion, as `Estimator.add_motion` takes them.
        """
        log = cls(rig, config, folder, motion_known)
        with log._recorder:
            yield log

    def add(
        self,
        imu: ImuData,
        frame: FeatureFrame,
        noise: tuple[float, float],
        aiding: AidingData | None = None,
    ) -> None:
        """Add a frame; one out of order, or without IMU samples around it, is left out.

        Args:
            imu: the samples since the last frame.
            frame: the observations of all cameras.
            noise: factors on the white noise of gyroscope and accelerometer around this time.
            aiding: position fixes and odometry since the last frame.
        """
        if aiding is not None:
            self._aiding.append(aiding)
        if not self._motion_known:
            newest_ns = None if self._imu_ns is None else self._imu_ns[1]
            imu = motionless_samples(newest_ns, frame.stamp_ns + self._lead_ns)
        if len(imu):
            self._imu.append(imu)
            first, last = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
            self._imu_ns = (first if self._imu_ns is None else self._imu_ns[0], last)
        if not self._follows(frame.stamp_ns):
            return
        frame = with_depth_observed(frame, self._real_rig)
        missing = len(self.rig.cameras) - len(frame.cameras)
        cameras = frame.cameras + (FeatureObservations.empty(),) * missing
        frame = FeatureFrame(frame.stamp_ns, cameras)
        self._recorder.write(ImuData.concatenate(self._imu), frame)
        self._imu = []
        self.observations += sum(map(len, cameras))
        if self._is_keyframe(frame):
            self._keyframes.append(len(self._frames))
            self._last_ids = cameras[0].ids
        self._frames.append(frame.stamp_ns)
        self._noise.extend(noise)

    def part(self, begin_ns: int | None, end_ns: int | None, of_fixes: bool = True) -> FrameLog:
        """The log of the frames from one time to another, on the clock of the cameras.

        Args:
            begin_ns: of the first frame; None for the beginning.
            end_ns: of the last frame; None for the end.
            of_fixes: whether the estimate is in the world of fixes there, if it is anywhere.
        """
        stamps = self.frames_ns
        first = 0 if begin_ns is None else int(np.searchsorted(stamps, begin_ns))
        stop = len(stamps) if end_ns is None else int(np.searchsorted(stamps, end_ns, "right"))
        part = copy(self)
        part.georeferenced = of_fixes
        part.__dict__.pop("aiding", None)  # that of the whole
        part._frames = self._frames[first:stop]
        part._noise = self._noise[2 * first : 2 * stop]
        inside = [k - first for k in self._keyframes if first <= k < stop]
        part._keyframes = array("q", inside if inside[:1] == [0] or stop <= first else [0, *inside])
        return part

    @cached_property
    def aiding(self) -> AidingData:
        """Odometry of the whole run, and fixes and poses if the estimate is in their world."""
        data = AidingData.concatenate(self._aiding).shifted(round(self.fix_offset_s * 1e9))
        return data if self.georeferenced else data.without_fixes().without_poses()

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

    def samples(self, first: int, stop: int, rig: Rig) -> ImuData:
        """The samples of the IMU from 1 s before the frame `first` to the frame `stop - 1`.

        The last one is the first at or after the exposure of the last row of that frame.
        """
        clocks = self.clock_changes
        # a sample of a clock that became later belongs to an earlier frame than its stamp says, and
        # one of a clock that became earlier to a later frame
        ahead_s = replace(rig.shifted(clocks.latest_s), has_imu=True).end_offset_s
        begin_ns = self._frames[first] + min(0, round(rig.pose_offset_s * 1e9)) - _HISTORY_NS
        if clocks.earliest_s < 0.0:
            begin_ns += round(clocks.earliest_s * 1e9) - _AROUND_NS
        end_ns = self._frames[stop - 1] + max(0, round(ahead_s * 1e9))
        blocks: list[ImuData] = []
        for block in self._recorder.recorded(_Silent()).imu_blocks(begin_ns):
            count = int(np.searchsorted(block.stamps_ns, end_ns)) + 1
            blocks.append(block[:count])
            if count <= len(block):
                break
        return clocks.corrected(ImuData.concatenate(blocks))

    def features(self, first: int, stop: int) -> tuple[IntArray, NDArray[np.void]]:
        """Features of the frames `first` to `stop - 1`, as `TrackRecordingSequence.features`.

        Those that are left out are not among them.
        """
        counts, rows = self._recorder.recorded(_Silent()).features(
            self._frames[first], self._frames[stop - 1]
        )
        if len(self.left_out) == 0:
            return counts, rows
        kept = ~np.isin(rows["id"], self.left_out)
        image = np.repeat(np.arange(counts.size), counts.ravel())
        left = np.bincount(image[kept], minlength=counts.size)
        return left.reshape(counts.shape).astype(counts.dtype), rows[kept]

    def without(self, ids: IntArray) -> FrameLog:
        """The log without some features (N,), beside those that are left out already."""
        log = copy(self)
        log.left_out = np.union1d(self.left_out, ids)
        return log

    def _follows(self, frame_ns: int) -> bool:
        """Whether a frame is later than the others and within the IMU samples."""
        if self._imu_ns is None or (len(self._frames) and frame_ns <= self._frames[-1]):
            return False
        stamp_ns = frame_ns + round(self.rig.pose_offset_s * 1e9)
        first_ns, last_ns = self._imu_ns
        return first_ns - _MAX_BEYOND_NS <= stamp_ns <= last_ns + _MAX_BEYOND_NS

    def _is_keyframe(self, frame: FeatureFrame) -> bool:
        if not self._keyframes:
            return True
        since_s = (frame.stamp_ns - self._frames[self._keyframes[-1]]) * 1e-9
        spacing_s = self._config.keyframe_spacing_s
        if not self.rig.has_imu:
            spacing_s = min(spacing_s, _SPACING_WITHOUT_IMU_S)
        if since_s >= _JITTER * spacing_s:
            return True
        common = np.isin(self._last_ids, frame.cameras[0].ids)
        return len(common) > 0 and bool(common.mean() < self._config.min_common_features)
