# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Prediction: the motion of the body by the IMU, and where features will be in the next image."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import Feedback
from slam_graph.frontend.keypoints import Pixels, Tracks
from slam_graph.geometry import NavState
from slam_graph.kernels.near_pairs import median_motions
from slam_graph.sensors import ImuBuffer, ImuData, ImuNoise, RigCamera

_HISTORY_NS = 2_000_000_000
"""How long samples are kept; states of the back end are never that far behind."""

_LONGEST_NS = 10_000_000_000
"""The same for a camera that is without images for longer, and has its features from before then.
"""

_MAX_GAP_NS = 30_000_000
"""Samples must begin and end no further than this from the times asked for: some samples of a slow
IMU may be missing, but not a frame's worth."""


class ImuMotion:
    """Integrates the IMU over short times.

    Attributes:
        state: the last one that the back end estimated, whose biases are used; None before.
    """

    def __init__(self, noise: ImuNoise, gravity: float) -> None:
        """Start without samples.

        Args:
            noise: of the IMU.
            gravity: magnitude in m/s².
        """
        self.state: NavState | None = None
        self._imu = ImuBuffer()
        self._params = noise.preintegration_params(gravity)

    def add(self, imu: ImuData, since_ns: int | None = None) -> None:
        """Add samples that follow those already given; others are left out.

        Args:
            imu: the samples.
            since_ns: stamp of the oldest image whose features are still looked for; None for the
                newest sample. An offset of its clock is below what is kept in any case.
        """
        self._imu.add(imu)
        newest_ns = self._imu.newest_ns()
        oldest_ns = newest_ns if since_ns is None else min(since_ns, newest_ns)
        self._imu.forget_before(max(oldest_ns - _HISTORY_NS, newest_ns - _LONGEST_NS))

    def rotation(self, start_ns: int, end_ns: int) -> gtsam.Rot3 | None:
        """start_R_end of the body, or None where samples are missing.

        Without a state the bias counts as zero.
        """
        if not self._covers(start_ns, end_ns):
            return None
        bias = np.zeros(3) if self.state is None else self.state.gyro_bias
        return self._imu.between(start_ns, end_ns).rotation(bias)

    def pose(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """world_T_body, predicted from the last state; None without a state or samples."""
        state = self.state
        if state is None:
            return None
        if stamp_ns <= state.stamp_ns:
            return state.world_T_body if stamp_ns == state.stamp_ns else None
        if not self._covers(state.stamp_ns, stamp_ns):
            return None
        bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
        pim = self._imu.between(state.stamp_ns, stamp_ns).preintegrated(bias, self._params)
        return state.predicted(pim, stamp_ns).world_T_body

    def trend(self, stamp_ns: int, around_ns: int) -> tuple[FloatArray, FloatArray]:
        """Angular rate (3,) of the body at a time and its derivative; zero without samples."""
        if not self._covers(stamp_ns - around_ns, stamp_ns + around_ns):
            return np.zeros(3), np.zeros(3)
        bias = np.zeros(3) if self.state is None else self.state.gyro_bias
        gyro, slope, _ = self._imu.trend(stamp_ns, around_ns)
        return gyro - bias, slope

    def _covers(self, start_ns: int, end_ns: int) -> bool:
        """Whether there are samples over a whole interval, which must not be empty."""
        stamps = self._imu.data.stamps_ns
        return (
            len(stamps) > 0
            and end_ns > start_ns
            and bool(stamps[0] <= start_ns + _MAX_GAP_NS)
            and bool(stamps[-1] >= end_ns - _MAX_GAP_NS)
        )


_NEAREST_DEPTH_M = 0.1
"""Points of the map nearer than this, or behind the camera, are not used for prediction."""

MAX_TANGENT = 2.75
"""Largest normalised coordinate for which the model of a narrow lens is evaluated: 70° off the
axis. A wide lens has its own limit."""

_ROW_ITERATIONS = 3
"""Iterations for the row at which a rolling shutter will see a point."""

_SHORTEST_SPAN_S = 0.02
"""The motion at an image of a rolling shutter is that of at least so much time."""

_NEIGHBOURS = 3
"""The median motion of this many neighbours, an odd number, predicts that of a new feature."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where features will be.

    Attributes:
        points: (N, 2) float32 pixels.
        trusted: (N,) whether the prediction is good to a few pixels: the rotation was measured, by
            a gyroscope or by images, and the residual flow is known, or the feature is in the map.
    """

    points: Pixels
    trusted: BoolArray


class PointPredictor:
    """Predicts the features of one camera.

    Args:
        mounted: the camera.
        motion: of the body, by the IMU.
        config: `prediction` chooses how.

    Attributes:
        camera_R: end_R_start of the camera over the last prediction; the identity where unknown.
        rotation_known: whether the gyroscope measured it.
    """

    def __init__(self, mounted: RigCamera, motion: ImuMotion, config: FrontendConfig) -> None:
        self._camera = mounted.camera
        self._trends: dict[int, tuple[FloatArray, FloatArray]] = {}  # at the last two images
        self.mount(mounted)
        self._motion = motion
        self._mode = config.prediction
        self.camera_R: FloatArray = np.eye(3)
        self.rotation_known = False
        self._turn_known = False  # by images

    def mount(self, mounted: RigCamera) -> None:
        """Take the place and the clock of the camera as they are calibrated now."""
        self._mounted = mounted
        self._body_T_camera = mounted.body_T_camera
        self._body_R_camera: FloatArray = mounted.body_T_camera.rotation().matrix()
        self._offset_ns = round(mounted.clock_offset_s * 1e9)
        self._turns_rows = mounted.readout_s != 0.0 and mounted.rotation_known
        self._trends.clear()  # they are of the former offset

    def advance(self, start_ns: int, end_ns: int) -> None:
        """Integrate the rotation between two frames (times of the camera)."""
        start_R_end = self._motion.rotation(start_ns + self._offset_ns, end_ns + self._offset_ns)
        if not self._mounted.rotation_known:  # the gyroscope tells nothing of the camera
            start_R_end = None
        self.rotation_known = start_R_end is not None and self._mode != "flow"
        self._turn_known = False
        if start_R_end is None:
            self.camera_R = np.eye(3)
        else:
            body_R_camera = self._body_R_camera
            self.camera_R = body_R_camera.T @ start_R_end.matrix().T @ body_R_camera

    def turn(self, end_R_start: FloatArray, close: bool) -> None:
        """Take a rotation (3, 3) of the camera over two frames that the gyroscope did not give.

        If it is `close`, to a few pixels, features are looked for near where it puts them; to test
        their tracks by it that is not enough.
        """
        self.camera_R, self._turn_known = end_R_start, close

    def predict(self, before: Tracks, stamp_ns: int, feedback: Feedback) -> Prediction:
        """Where to look for the features of the image before.

        Args:
            before: features of the image from which `advance` started.
            stamp_ns: time of the new image.
            feedback: the map of the back end, used by `state`.
        """
        if self._mode == "none" or len(before) == 0:
            return Prediction(before.pixels, np.zeros(len(before), np.bool_))
        flow, seconds = before.residual_flow, (stamp_ns - before.stamp_ns) * 1e-9
        known_flow = np.isfinite(flow[:, 0])
        trusted: BoolArray = known_flow & (self.rotation_known | self._turn_known)
        moved = flow * seconds
        moved[(~known_flow).nonzero()[0]] = 0.0
        m = self._rotated(self.unrolled(before.pixels, before.normalized, before.stamp_ns)) + moved
        if self._mode == "state":
            known, by_map = self._by_map(before.ids, stamp_ns, feedback)
            m[known], trusted[known] = by_map[known], True
        sane = self._camera.within_reach(m, MAX_TANGENT)
        m[(~sane).nonzero()[0]] = 0.0
        pixels = self._rolled(m, stamp_ns).astype(np.float32)
        (u, v), last_u, last_v = pixels.T, self._camera.width - 1, self._camera.height - 1
        sane &= ~((u < 0) | (v < 0) | (u > last_u) | (v > last_v))
        stays = (~sane).nonzero()[0]
        pixels[stays] = before.pixels[stays]
        return Prediction(pixels, trusted & sane)

    def body_pose(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """world_T_body at a time of the camera; None where it is not known."""
        return self._motion.pose(stamp_ns + self._offset_ns)

    def unrolled(self, pixels: FloatArray | Pixels, m: FloatArray, stamp_ns: int) -> FloatArray:
        """Where a rolling shutter would see points at the time of its middle row, by the gyroscope.

        Without it a rotation that changes what is in which row looks like a motion that is not
        rigid: by 4 px where 50 rows are crossed at 3 rad/s and with a readout of 30 ms.

        Args:
            pixels: (N, 2) where they are seen.
            m: (N, 2) the same, normalised.
            stamp_ns: of one of the last two images.
        """
        if not self._turns_rows or len(m) == 0:
            return m
        return self._turned(m, np.asarray(pixels, np.float64)[:, 1], stamp_ns, 1.0)

    def _rolled(self, m: FloatArray, stamp_ns: int) -> FloatArray:
        """Pixels (N, 2) of points whose coordinates are those at the time of the middle row."""
        pixels = self._camera.pixels(m)
        if not self._turns_rows or len(m) == 0:
            return pixels
        for _ in range(_ROW_ITERATIONS):
            pixels = self._camera.pixels(self._turned(m, pixels[:, 1], stamp_ns, -1.0))
        return pixels

    def _turned(self, m: FloatArray, rows: FloatArray, stamp_ns: int, sign: float) -> FloatArray:
        """Normalised points (N, 2), turned from the middle row's time to other rows', or back."""
        seconds = self._mounted.row_times_s(rows) - self._mounted.middle_s
        rate, slope = self._trend(stamp_ns)
        turn = rate * seconds[:, None] + 0.5 * slope * seconds[:, None] ** 2
        in_camera = self._body_R_camera.T @ turn.T
        rays = np.column_stack([m, np.ones(len(m))])
        rays = Rotation.from_rotvec(sign * in_camera.T).apply(rays)
        turned: FloatArray = rays[:, :2] / np.maximum(rays[:, 2:], 1e-3)
        return turned

    def _trend(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """The motion of the body at an image (time of the camera)."""
        if stamp_ns not in self._trends:
            around_ns = round(0.5e9 * max(abs(self._mounted.readout_s), _SHORTEST_SPAN_S))
            now = self._motion.trend(stamp_ns + self._offset_ns, around_ns)
            latest = sorted(self._trends)[-1:]
            self._trends = {t: self._trends[t] for t in latest} | {stamp_ns: now}
        return self._trends[stamp_ns]

    def residual_flow(self, start: FloatArray, end: FloatArray, seconds: float) -> FloatArray:
        """Velocity (N, 2) of normalised points in 1/s that the rotation does not explain.

        Args:
            start: (N, 2) where they were.
            end: (N, 2) where they are.
            seconds: between the two.
        """
        if seconds <= 0:
            return np.zeros_like(end)
        moved: FloatArray = (end - self._rotated(start)) / seconds
        return moved

    def _rotated(self, normalized: FloatArray) -> FloatArray:
        """Normalised points (N, 2) after the rotation of the camera; `flow` leaves it out."""
        if self._mode == "flow":
            return normalized.copy()
        rays = np.empty((len(normalized), 3))
        rays[:, :2], rays[:, 2] = normalized, 1.0
        rays = rays @ self.camera_R.T
        turned: FloatArray = rays[:, :2] / np.maximum(rays[:, 2:], 1e-3)
        return turned

    def _by_map(
        self, ids: IntArray, stamp_ns: int, feedback: Feedback
    ) -> tuple[BoolArray, FloatArray]:
        """Which features (N,) are in the map, and where (N, 2) the predicted pose sees them."""
        m = np.zeros((len(ids), 2))
        known = np.isin(ids, feedback.ids)
        world_T_body = self.body_pose(stamp_ns)
        if world_T_body is None or not known.any():
            return np.zeros(len(ids), np.bool_), m
        points = feedback.points[np.searchsorted(feedback.ids, ids[known])]
        camera_T_world: gtsam.Pose3 = (world_T_body * self._body_T_camera).inverse()
        seen = np.asarray(camera_T_world.transformFrom(points.T)).T
        m[known] = seen[:, :2] / np.maximum(seen[:, 2:], _NEAREST_DEPTH_M)
        known[known] = seen[:, 2] > _NEAREST_DEPTH_M
        return known, m


def neighbour_flow(start: Pixels, end: Pixels, at: Pixels) -> Pixels:
    """The motion (M, 2) at other places, as the median of the nearest of N features.

    Args:
        start: (N, 2) pixels of features in one image.
        end: (N, 2) the same features in another.
        at: (M, 2) pixels in the first one.
    """
    if len(start) < _NEIGHBOURS:
        return np.zeros_like(at)
    places = np.ascontiguousarray(start), np.ascontiguousarray(end), np.ascontiguousarray(at)
    return median_motions(*places, _NEIGHBOURS)
