# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features that do not fit the causal trajectory: most of what moves by itself is among them.

A bundle adjustment begins with everything that fits its start roughly, as the start may be wrong.
Where something moves before the cameras, its features may be many and agree with each other, and
the minimum follows them. At the poses of the causal trajectory, whose drift within a track is
small, they have no point, or one that fits badly.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.keyframe_states import states_at
from slam_graph.backend.smoothing.recording_segment import (
    read_segment,
    row_motions,
    views,
    with_gtsam_cameras,
)
from slam_graph.backend.smoothing.smoothing_task import SmoothingTask
from slam_graph.geometry import Trajectory

_LARGER = 3.0
"""A feature does not fit where its residuals are so many times those of the median feature."""
_TOGETHER = 150
"""Keyframes that are read at once; longer tracks are judged in parts."""


def causal_outliers(log: FrameLog, causal: Trajectory, task: SmoothingTask) -> IntArray:
    """Ids (N,) of features that do not fit the poses of the causal trajectory, ascending.

    Features that are seen in one keyframe alone, or at times that it does not cover, fit.

    Args:
        log: the frames.
        causal: the trajectory, with velocities and biases, on the clock of the IMU.
        task: calibration and settings.
    """
    keyframes = log.keyframes
    if not len(causal):
        return np.zeros(0, np.int64)
    stamps_ns = log.frames_ns[keyframes] + round(task.rig.pose_offset_s * 1e9)
    covered = (stamps_ns >= causal.stamps_ns[0]) & (stamps_ns <= causal.stamps_ns[-1])
    keyframes = keyframes[covered]
    parts = (keyframes[k : k + _TOGETHER + 1] for k in range(0, len(keyframes) - 1, _TOGETHER))
    found = [_outliers(log, part, causal, task) for part in parts]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *found]))


def _outliers(
    log: FrameLog, keyframes: IntArray, causal: Trajectory, task: SmoothingTask
) -> IntArray:
    """The same (N,) of some consecutive keyframes (K,)."""
    segment = read_segment(log, keyframes, task.rig, task.backend.zero_velocity)
    seen = segment.seen_by_keyframes()
    seen = seen.subset(np.bincount(views(seen)[0], minlength=len(seen.ids)) > 1)
    if len(seen.ids) == 0:
        return seen.ids
    states = states_at(causal, segment.keyframe_stamps_ns, segment.imu, task.preintegration)
    motions = row_motions(states, segment.imu, task.rig)
    matrices = np.array([state.world_T_body.matrix() for state in states])
    projection = RigProjection(with_gtsam_cameras(task.rig), motions, task.rig)
    poses = matrices[:, :3, :3], matrices[:, :3, 3]
    found = triangulate(seen, projection, *poses, task.backend.triangulation)
    if not found.good.any():
        return seen.ids
    limit_px = _LARGER * max(
        float(np.median(found.reprojection_px[found.good])), task.backend.noise.pixel_sigma
    )
    return seen.ids[~found.good | ~(found.reprojection_px < limit_px)]
