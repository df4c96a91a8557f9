# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The motion from frame to frame by the images alone, where no IMU predicts it.

That is without an IMU, and where samples of it are missing.

A body that turns to and fro at 150°/s is after one frame where constant velocity does not expect
it, and one Gauss-Newton step from there ends beside the minimum. So the new pose is first found by
PnP from points that are known already: features of the estimator, and those whose depth the last
frame has by a second camera or a depth sensor. It is the point at which the new state is
linearised, not a measurement: its images still come, and count once.

The motion that is found is that of most features. Features that are far away count as well,
although two cameras hardly tell their depth: while the motion is shorter than the baseline, it
moves them in the image by no more than the error of their disparity. Without them a moving object
that is near has half of the points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import seen_by_first_and_another, triangulate
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig, RigCamera

ERROR_PX = 4.0
"""Largest error of a point that fits the motion."""
_ERRORS_PX, _SHARES = (1.5, 2.5, ERROR_PX), (0.65, 0.65, 0.5)
"""Limits of the errors, which are tried in turn, and the part of the points that must fit: what
moves slowly, or is near, would fit a motion between its own and that of the platform."""
_ACCEPTED = TriangulationConfig()
"""Depths that `triangulate` accepts. A feature whose parallax is not positive is put at the
largest one."""
_SAME_NS = 5_000_000
"""The last frame is used if the time since it is that since the last state, to so much."""
_ROUNDS = 3
"""With a rolling shutter: its rows are undone with the rate that the round before has found."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoints:
    """Features and where they are.

    Attributes:
        ids: (N,).
        points: (N, 3) m, in the frame that is said where it is made.
        located: (N,) whether the depth is known well. Else it is that of too little parallax, or
            `max_depth_m` where the parallax is not positive.
    """

    ids: IntArray
    points: FloatArray
    located: BoolArray

    def subset(self, rows: BoolArray | IntArray) -> KnownPoints:
        """Some of them, by a mask or by indices."""
        return KnownPoints(self.ids[rows], self.points[rows], self.located[rows])

    def seen(self, ids: IntArray) -> tuple[BoolArray, KnownPoints]:
        """Which of some features (M,) are known, and these, in their order."""
        order = self.ids.argsort()
        ascending = self.ids.take(order)
        rows = is_in(ids, ascending)
        return rows, self.subset(order.take(ascending.searchsorted(ids[rows])))


@dataclass(frozen=True, slots=True, eq=False)
class PoseOfMost:
    """A pose that most points agree on.

    Attributes:
        world_T_body: the pose.
        fits: (N,) which points fit it.
        limit_px: the limit of the errors, in pixels, under which they fit.
    """

    world_T_body: gtsam.Pose3
    fits: BoolArray
    limit_px: float


class VisualMotion:
    """Finds the motion of the body since the last frame.

    Args:
        rig: the cameras; the first one is looked through.
        min_points: fewer known points tell no motion.
    """

    def __init__(self, rig: Rig, min_points: int) -> None:
        self._rig = rig
        self._projection = RigProjection(rig)
        self._min_points = min_points
        self._last: FeatureFrame | None = None
        self._limit_px = 0.0

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
        points = self._known(before, last, frame, known)
        # begin one limit below that of the last frame: each one that is tried may cost a RANSAC
        least_px = max((px for px in _ERRORS_PX if px < self._limit_px), default=0.0)
        found = predicted
        for _ in range(_ROUNDS if self._rig.rolling else 1):
            rate = self._rate(found, before)
            solved = self._pose(frame, points, rate, least_px, found.world_T_body)
            if solved is None:
                return predicted
            self._limit_px = solved.limit_px
            found = moved_to(before, predicted, solved.world_T_body, self._rig.has_imu)
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
        self,
        before: NavState,
        last: FeatureFrame | None,
        frame: FeatureFrame,
        known: tuple[IntArray, FloatArray],
    ) -> KnownPoints:
        """Known features in the world, and those of the last frame that the new one sees too."""
        ids, points = known
        located = np.ones(len(ids), np.bool_)
        if last is not None:
            before_ids, again = last.cameras[0].ids, frame.cameras[0].ids
            wanted = before_ids[is_in(before_ids, np.sort(again))]
            wanted = wanted[~is_in(wanted, np.sort(ids))]
            rate = self._rate(before)
            seen = depths_within(last, self._rig, rate, wanted, self._projection)
            pose = before.world_T_body
            world = seen.points @ pose.rotation().matrix().T + pose.translation()
            ids = np.concatenate([ids, seen.ids])
            points = np.concatenate([points, world])
            located = np.concatenate([located, seen.located])
        return KnownPoints(ids, points, located)

    def _pose(
        self,
        frame: FeatureFrame,
        known: KnownPoints,
        rate: FloatArray,
        least_px: float,
        guess: gtsam.Pose3,
    ) -> PoseOfMost | None:
        """The pose by known points in the world; None if they do not tell it."""
        seen, mounted = frame.cameras[0], self._rig.cameras[0]
        rows, found = known.seen(seen.ids)
        if np.count_nonzero(found.located) < self._min_points:
            return None
        rays = seen.normalized[rows]
        if mounted.readout_s != 0.0:
            turned = _unrolled(rays, seen.pixels[rows, 1], mounted, rate)
            rays = turned[:, :2] / turned[:, 2:]
        return pose_of_most(mounted, found.points, rays, least_px, guess)


def pose_of_most(
    mounted: RigCamera,
    points: FloatArray,
    rays: FloatArray,
    least_px: float = 0.0,
    guess: gtsam.Pose3 | None = None,
) -> PoseOfMost | None:
    """The pose that most points agree on; None if fewer than half do.

    Args:
        mounted: the camera.
        points: (N, 3) in the world, m.
        rays: (N, 2) where it sees them, on its plane z = 1.
        least_px: smaller limits of the errors are not tried.
        guess: a pose that may be near; samples of points are drawn where most do not agree on one
            that is found from it.
    """
    ways: tuple[gtsam.Pose3 | None, ...] = (None,) if guess is None else (guess, None)
    for error_px, share in zip(_ERRORS_PX, _SHARES, strict=True):
        if error_px < least_px:
            continue
        for way in ways:
            solved = mounted.body_pose(points, rays, error_px, tightened=True, guess=way)
            if solved is not None and np.mean(solved[1]) >= share:
                return PoseOfMost(*solved, error_px)
    return None


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
    seconds = mounted.row_times_s(rows) - mounted.middle_s
    turn = mounted.body_T_camera.rotation().unrotate(rate)
    return np.asarray(Rotation.from_rotvec(seconds[:, None] * turn).apply(_on_plane(normalized)))


def depths_within(
    frame: FeatureFrame,
    rig: Rig,
    rate: FloatArray | None = None,
    wanted: IntArray | None = None,
    projection: RigProjection | None = None,
) -> KnownPoints:
    """Positions in the body frame of features that two cameras see, or one and a depth sensor.

    Args:
        frame: the frame.
        rig: its cameras.
        rate: (3,) angular rate of the body, rad/s, by which rows of a rolling shutter differ; None
            for none.
        wanted: features (N,), all of which the first camera sees; None for all that it sees.
        projection: into the cameras, if there is one already.

    Returns:
        All of them, located or not, by ascending ids.
    """
    mounted = rig.cameras[0]
    ids = np.sort(frame.cameras[0].ids if wanted is None else wanted)
    if len(rig.cameras) < 2 or len(ids) == 0:
        return _no_points()
    obs = seen_by_first_and_another(ids, frame)
    if len(obs) == 0:
        return _no_points()
    projection = projection or RigProjection(rig)
    found = triangulate(obs, projection, np.eye(3)[None], np.zeros((1, 3)), _ACCEPTED)
    first = obs.starts[:-1]
    rays = _on_plane(obs.normalized.take(first, axis=0))
    R, p = projection.body_R_camera[0], projection.body_p_camera[0]
    depths = (found.points - p) @ R[:, 2]
    usable = found.good | ((depths > _ACCEPTED.min_depth_m) & (depths < _ACCEPTED.max_depth_m))
    far = _ACCEPTED.max_depth_m * rays @ R.T + p
    points = np.where(usable[:, None], found.points, far)
    if rate is not None and mounted.readout_s != 0.0:
        seconds = mounted.row_times_s(obs.pixels[first, 1]) - mounted.middle_s
        points = np.asarray(Rotation.from_rotvec(seconds[:, None] * rate).apply(points))
    known, finite = KnownPoints(obs.ids, points, found.good), np.isfinite(found.depth_error)
    return known if finite.all() else known.subset(finite)


def _no_points() -> KnownPoints:
    """No feature."""
    return KnownPoints(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.bool_))


def _on_plane(normalized: FloatArray) -> FloatArray:
    """Rays (N, 3) of points (N, 2) on the plane z = 1."""
    rays = np.ones((len(normalized), 3))
    rays[:, :2] = normalized
    return rays


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
