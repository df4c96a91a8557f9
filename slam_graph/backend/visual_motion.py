# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The motion from frame to frame by the images alone, where no IMU predicts it.

That is without an IMU, and where samples of it are missing.

A body that turns to and fro at 150°/s is after one frame where constant velocity does not expect
it, and one Gauss-Newton step from there ends beside the minimum. So the new pose is first found by
PnP from points that are known already: features of the estimator, and those whose depth the last
frame has by a second camera or a depth sensor. It is the point at which the new state is
linearised, not a measurement: its images still come, and count once.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.triangulation import triangulate_frames
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig, RigCamera

ERROR_PX = 4.0
"""Largest error of a point that fits the motion."""
_SAME_NS = 5_000_000
"""The last frame is used if the time since it is that since the last state, to so much."""
_LEAST_SHARE = 0.5
"""Part of the known points that must fit it."""
_ROUNDS = 3
"""With a rolling shutter: its rows are undone with the rate that the round before has found."""


class VisualMotion:
    """Finds the motion of the body since the last frame.

    Args:
        rig: the cameras; the first one is looked through.
        min_points: fewer known points tell no motion.
    """

    def __init__(self, rig: Rig, min_points: int) -> None:
        self._rig = rig
        self._min_points = min_points
        self._last: FeatureFrame | None = None

    def note(self, frame: FeatureFrame) -> FeatureFrame | None:
        """Note the next frame, and return the one before it."""
        last, self._last = self._last, frame
        return last

    def corrected(
        self,
        before: NavState,
        predicted: NavState,
        frames: tuple[FeatureFrame | None, FeatureFrame],
        known: tuple[IntArray, FloatArray],
    ) -> NavState:
        """The predicted state with the pose, velocity and rate that the images show.

        Args:
            before: state at the last frame.
            predicted: state at the new one, by constant velocity, or by an IMU of which samples are
                missing.
            frames: features of the last frame, if there was one, and of the new one.
            known: ids (N,) and world positions (N, 3) of features that the estimator knows.
        """
        last, frame = frames
        since_ns = predicted.stamp_ns - before.stamp_ns
        if last is not None and abs(frame.stamp_ns - last.stamp_ns - since_ns) > _SAME_NS:
            last = None  # it is not that of the state before
        ids, points = self._known(before, last, known)
        found = predicted
        for _ in range(_ROUNDS if self._rig.rolling else 1):
            pose = self._pose(frame, ids, points, self._rate(found, before))
            if pose is None:
                return predicted
            found = moved_to(before, predicted, pose, self._rig.has_imu)
        return found

    def _rate(self, state: NavState, before: NavState | None = None) -> FloatArray:
        """Angular rate (3,) of the body, rad/s: without an IMU that is the bias, negative.

        With one it is the mean since the state before, or not known without that.
        """
        if not self._rig.has_imu:
            return -state.gyro_bias
        if before is None:
            return np.zeros(3)
        turn = before.world_T_body.rotation().between(state.world_T_body.rotation())
        return np.asarray(gtsam.Rot3.Logmap(turn)) / ((state.stamp_ns - before.stamp_ns) * 1e-9)

    def _known(
        self, before: NavState, last: FeatureFrame | None, known: tuple[IntArray, FloatArray]
    ) -> tuple[IntArray, FloatArray]:
        """Known features, ascending ids, and those of the last frame with a depth."""
        ids, points = known
        if last is not None:
            seen, local = depths_within(last, self._rig, self._rate(before))
            others = ~np.isin(seen, ids)
            world = np.asarray(before.world_T_body.transformFrom(local[others].T)).T
            ids = np.concatenate([ids, seen[others]])
            points = np.concatenate([points, world.reshape(-1, 3)])
        order = np.argsort(ids)
        return ids[order], points[order]

    def _pose(
        self, frame: FeatureFrame, ids: IntArray, points: FloatArray, rate: FloatArray
    ) -> gtsam.Pose3 | None:
        """world_T_body by known points (ascending ids); None if they do not tell it."""
        seen, mounted = frame.cameras[0], self._rig.cameras[0]
        rows = is_in(seen.ids, ids)
        if np.count_nonzero(rows) < self._min_points:
            return None
        world = points[np.searchsorted(ids, seen.ids[rows])]
        rays = _unrolled(seen.normalized[rows], seen.pixels[rows, 1], mounted, rate)
        rays = rays[:, :2] / rays[:, 2:]
        solved = mounted.body_pose(world, rays, ERROR_PX, tightened=True)
        if solved is None or np.mean(solved[1]) < _LEAST_SHARE:
            return None
        return solved[0]


def _unrolled(
    normalized: FloatArray, rows: FloatArray, mounted: RigCamera, rate: FloatArray
) -> FloatArray:
    """Rays (N, 3) of a rolling shutter as the middle row would see them.

    Args:
        normalized: (N, 2) on the plane z = 1.
        rows: (N,) rows in pixels.
        mounted: the camera.
        rate: (3,) angular rate of the body, rad/s.
    """
    rays = np.column_stack([normalized, np.ones(len(normalized))])
    if mounted.readout_s == 0.0:
        return rays
    seconds = mounted.row_times_s(rows) - mounted.middle_s
    turn = mounted.body_T_camera.rotation().unrotate(rate)
    return np.asarray(Rotation.from_rotvec(seconds[:, None] * turn).apply(rays))


def depths_within(
    frame: FeatureFrame, rig: Rig, rate: FloatArray | None = None
) -> tuple[IntArray, FloatArray]:
    """Ids (N,) and positions (N, 3) in the body frame of features with a depth in one frame.

    Args:
        frame: the frame.
        rig: its cameras.
        rate: (3,) angular rate of the body, rad/s, by which rows of a rolling shutter differ; None
            for none.
    """
    ids = frame.cameras[0].ids
    if len(rig.cameras) < 2 or len(ids) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    found = triangulate_frames(ids, [frame], np.eye(3)[None], np.zeros((1, 3)), rig)
    ids, points, mounted = ids[found.good], found.points[found.good], rig.cameras[0]
    if rate is not None and mounted.readout_s != 0.0:
        rows = frame.cameras[0].pixels[found.good, 1]
        seconds = mounted.row_times_s(rows) - mounted.middle_s
        points = Rotation.from_rotvec(seconds[:, None] * rate).apply(points)
    return ids, points


def moved_to(
    before: NavState, predicted: NavState, pose: gtsam.Pose3, with_imu: bool = False
) -> NavState:
    """A predicted state at another pose, with the change of velocity and rate that leads there.

    By constant velocity these are the mean ones then. With an IMU the bias says nothing of the
    rate, and stays.

    White noise would let both change by half as much again; but with a rolling shutter the rate
    moves the rows, and so the pose that PnP finds: the two then overshoot in turn.
    """
    seconds = (predicted.stamp_ns - before.stamp_ns) * 1e-9
    was = predicted.world_T_body
    turn = gtsam.Rot3.Logmap(was.rotation().between(pose.rotation()))
    shift = pose.translation() - was.translation()
    velocity = predicted.velocity + shift / seconds
    moved = replace(predicted, world_T_body=pose, velocity=velocity)
    return moved if with_imu else replace(moved, gyro_bias=moved.gyro_bias - turn / seconds)
