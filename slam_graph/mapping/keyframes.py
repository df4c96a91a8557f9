# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframes of a piece of a recording: their times, observations and IMU samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_graph.backend.imu import ImuBuffer
from slam_graph.backend.tracks import Observations
from slam_graph.backend.zero_velocity import StandstillDetector
from slam_graph.mapping.keyframe_log import KeyframeLog
from slam_graph.sensors.rig import Rig

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Keyframes:
    """Consecutive keyframes, numbered from 0.

    Attributes:
        stamps_ns: (K,) on the clock of the IMU.
        noise: (K, 2) factors on the white noise of gyroscope and accelerometer.
        still: (K,) whether nothing has moved since the keyframe before.
        imu: all samples.
        seen: all observations; frame f is keyframe f.
    """

    stamps_ns: IntArray
    noise: FloatArray
    still: BoolArray
    imu: ImuBuffer
    seen: Observations

    def __len__(self) -> int:
        return len(self.stamps_ns)


def read_keyframes(
    log: KeyframeLog, first: int, stop: int, rig: Rig, standstill: StandstillDetector
) -> Keyframes:
    """Read keyframes `first` to `stop - 1`.

    Args:
        log: of a run.
        first: number of the first one.
        stop: number behind the last one.
        rig: may be calibrated better than it was during the run.
        standstill: tells whether the platform stands still.
    """
    offset_ns = round(rig.cameras[0].time_offset_s * 1e9)
    imu = ImuBuffer()
    stamps, still = [], []
    columns: list[tuple[IntArray, ...]] = []
    pixels: list[FloatArray] = []
    for number, packet in enumerate(log.packets(first, stop)):
        frame = packet.frame
        imu.add(packet.imu)
        stamps.append(frame.stamp_ns + offset_ns)
        still.append(standstill.is_still(imu, stamps[-1], frame))
        for c, seen in enumerate(frame.cameras):
            count = len(seen)
            columns.append((seen.ids, np.full(count, number), np.full(count, c)))
            pixels.append(seen.pixels)
    ids, frames, cameras = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Keyframes(
        np.array(stamps),
        log.noise[first:stop],
        np.array(still),
        imu,
        _table(ids, frames, cameras, np.concatenate(pixels), rig, stop - first),
    )


def _table(
    ids: IntArray, frames: IntArray, cameras: IntArray, pixels: FloatArray, rig: Rig, count: int
) -> Observations:
    """Observations sorted by feature, then frame, then camera."""
    order = np.lexsort((cameras, frames, ids))
    ids, frames, cameras, pixels = ids[order], frames[order], cameras[order], pixels[order]
    normalized = np.empty_like(pixels)
    for c, mounted in enumerate(rig.cameras):
        rows = cameras == c
        normalized[rows] = mounted.camera.undistort(pixels[rows])
    features, feature = np.unique(ids, return_inverse=True)
    return Observations(
        features, tuple(range(count)), feature, frames, cameras, pixels, normalized
    )


def longest_tracks(seen: Observations, per_keyframe: int, least: int) -> BoolArray:
    """Which features (J,) to use: the longest, until every keyframe has enough.

    Args:
        seen: all observations.
        per_keyframe: how many features each keyframe is given, if it has as many.
        least: how many keyframes a feature must be seen in.
    """
    new_frame = np.ones(len(seen), np.bool_)
    new_frame[1:] = (np.diff(seen.feature) != 0) | (np.diff(seen.frame) != 0)
    feature, frame = seen.feature[new_frame], seen.frame[new_frame]
    lengths = np.bincount(feature, minlength=len(seen.ids))
    starts = np.cumsum(lengths) - lengths
    given = np.zeros(len(seen.frames), np.int64)
    chosen = np.zeros(len(seen.ids), np.bool_)
    for j in np.argsort(-lengths, kind="stable"):
        if lengths[j] < least:
            break
        frames = frame[starts[j] : starts[j] + lengths[j]]
        if given[frames].min() < per_keyframe:
            chosen[j] = True
            given[frames] += 1
    return chosen
