# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How good feature tracks are: how long, how well spread, and how true to the real motion."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, skew
from slam_graph.geometry import Trajectory, interpolate
from slam_graph.kernels.epipolar import sampson_distances
from slam_graph.sensors import AidingData, FeatureFrame, FeatureObservations, ImuData, Rig

_GAP_FRAMES = 5
"""Features are compared with themselves so many frames before: over one frame the true motion is
as small as the noise of pixels, over many the error of the ground truth adds up."""

_OUTLIER_PX = 4.0
"""Features further than this from their epipolar line count as wrong."""

GRID = (8, 6)
"""Columns and rows of the cells whose share with a feature is the coverage."""


@dataclass(frozen=True)
class TrackSummary:
    """The quality of all tracks of a recording.

    Attributes:
        frames: number of frames.
        features: mean number of features in a frame, over all cameras each counted once.
        median_length, mean_length: number of frames in which a feature is seen.
        coverage: mean share of the cells of a grid over the first camera that hold a feature.
        epipolar_px: median distance from the epipolar line of the true motion over GAP_FRAMES
            frames; None without ground truth.
        wrong: share of features further than OUTLIER_PX from it; None without ground truth.
        stereo_px: median distance from the epipolar line of the rig between the first two cameras
            that share features; None if none do.
    """

    frames: int
    features: float
    median_length: float
    mean_length: float
    coverage: float
    epipolar_px: float | None
    wrong: float | None
    stereo_px: float | None


class TrackQuality:
    """Gathers statistics of feature frames as they come. It can be the recorder of a run.

    Args:
        rig: the cameras.
        truth: true trajectory of the body, or None.
    """

    def __init__(self, rig: Rig, truth: Trajectory | None) -> None:
        self._rig = rig
        self._truth = truth
        self._lengths: Counter[int] = Counter()
        self._coverage: list[float] = []
        self._epipolar_px: list[FloatArray] = []
        self._stereo_px: list[FloatArray] = []
        self._recent: deque[tuple[FeatureFrame, gtsam.Pose3 | None]] = deque(maxlen=_GAP_FRAMES)

    def write(self, imu: ImuData, frame: FeatureFrame, aiding: AidingData | None = None) -> None:
        """Take note of the next frame; the IMU is not looked at."""
        ids = np.unique(np.concatenate([seen.ids for seen in frame.cameras]))
        self._lengths.update(ids.tolist())
        self._coverage.append(self._covered(frame.cameras[0]))
        pose = self._true_pose(frame.stamp_ns)
        if len(self._recent) == _GAP_FRAMES:
            self._compare(*self._recent[0], frame, pose)
        self._recent.append((frame, pose))
        self._across(frame)

    def summary(self) -> TrackSummary:
        """The statistics of all frames so far."""
        lengths = np.array(list(self._lengths.values()) or [0])
        frames = len(self._coverage)
        error_px = np.concatenate([np.zeros(0), *self._epipolar_px])
        stereo_px = np.concatenate([np.zeros(0), *self._stereo_px])
        return TrackSummary(
            frames,
            float(lengths.sum()) / max(frames, 1),
            float(np.median(lengths)),
            float(np.mean(lengths)),
            float(np.mean(self._coverage or [0.0])),
            float(np.median(error_px)) if len(error_px) else None,
            float(np.mean(error_px > _OUTLIER_PX)) if len(error_px) else None,
            float(np.median(stereo_px)) if len(stereo_px) else None,
        )

    def _covered(self, seen: FeatureObservations) -> float:
        camera = self._rig.cameras[0].camera
        scale = np.array([GRID[0] / camera.width, GRID[1] / camera.height])
        column, row = np.floor(seen.pixels * scale).astype(int).T
        return len(np.unique(row * GRID[0] + column)) / (GRID[0] * GRID[1])

    def _true_pose(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """world_T_body at a frame, or None."""
        if self._truth is None:
            return None
        offset_ns = round(self._rig.pose_offset_s * 1e9)
        true, _ = interpolate(self._truth, np.array([stamp_ns + offset_ns]))
        return true.pose(0) if len(true) else None

    def _compare(
        self,
        before: FeatureFrame,
        world_T_before: gtsam.Pose3 | None,
        after: FeatureFrame,
        world_T_after: gtsam.Pose3 | None,
    ) -> None:
        """Note how far features are from their epipolar lines under the true motion."""
        if world_T_before is None or world_T_after is None:
            return
        for mounted, a, b in zip(self._rig.cameras, before.cameras, after.cameras, strict=True):
            world_T_a = world_T_before * mounted.body_T_camera
            world_T_b = world_T_after * mounted.body_T_camera
            error = _epipolar_error(world_T_b.between(world_T_a), a, b)
            self._epipolar_px.append(error * mounted.camera.fx)

    def _across(self, frame: FeatureFrame) -> None:
        """Note how far the second camera's features are from the epipolar lines of the first."""
        if len(frame.cameras) < 2:
            return
        first, second = self._rig.cameras[:2]
        second_T_first = second.body_T_camera.between(first.body_T_camera)
        error = _epipolar_error(second_T_first, *frame.cameras[:2])
        self._stereo_px.append(error * first.camera.fx)


def _epipolar_error(
    b_T_a: gtsam.Pose3, a: FeatureObservations, b: FeatureObservations
) -> FloatArray:
    """Sampson's distances (N,) of the features in both from their epipolar lines, normalised."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    essential = skew(b_T_a.translation()) @ b_T_a.rotation().matrix()
    return sampson_distances(essential, a.normalized[in_a], b.normalized[in_b])
