# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Prediction: the motion of the body by the IMU, and where features will be in the next image.

Motion of the body by the IMU, from the last state of the back end on.

Prediction: where the features of a camera will be in its next image.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import Feedback
from slam_graph.frontend.keypoints import Pixels, Tracks
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuBuffer, ImuData, ImuNoise, RigCamera

_HISTORY_NS = 2_000_000_000
"""How long samples are kept; frames and states of the back end are never that far behind."""

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

    def add(self, imu: ImuData) -> None:
        """Add samples that follow those already given; others are left out."""
        self._imu.add(imu)
        self._imu.forget_before(self._imu.newest_ns() - _HISTORY_NS)

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
"""Largest normalised coordinate for which a camera model is evaluated: 70° off the axis."""

_NEIGHBOURS = 3
"""The median motion of this many neighbours predicts that of a new feature."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where features will be.

    Attributes:
        points: (N, 2) float32 pixels.
        trusted: (N,) whether the prediction is good to a few pixels: the rotation was measured and
            the residual flow is known, or the feature is in the map.
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
        self.mount(mounted)
        self._motion = motion
        self._mode = config.prediction
        self.camera_R: FloatArray = np.eye(3)
        self.rotation_known = False

    def mount(self, mounted: RigCamera) -> None:
        """Take the place and the clock of the camera as they are calibrated now."""
        self._mounted = mounted.rotation_known
        self._body_T_camera = mounted.body_T_camera
        self._offset_ns = round(mounted.time_offset_s * 1e9)

    def advance(self, start_ns: int, end_ns: int) -> None:
        """Integrate the rotation between two frames (times of the camera)."""
        start_R_end = self._motion.rotation(start_ns + self._offset_ns, end_ns + self._offset_ns)
        if not self._mounted:  # the gyroscope says nothing of a camera that may be turned anyhow
            start_R_end = None
        self.rotation_known = start_R_end is not None and self._mode != "flow"
        self.camera_R = np.eye(3)
        if start_R_end is not None:
            body_R_camera = self._body_T_camera.rotation().matrix()
            self.camera_R = body_R_camera.T @ start_R_end.matrix().T @ body_R_camera

    def predict(self, before: Tracks, stamp_ns: int, feedback: Feedback) -> Prediction:
        """Where to look for the features of the image before.

        Args:
            before: features of the image from which `advance` started.
            stamp_ns: time of the new image.
            feedback: the map of the back end, used by `state`.
        """
        if self._mode == "none" or len(before) == 0:
            return Prediction(before.pixels, np.zeros(len(before), np.bool_))
        trusted: BoolArray = np.isfinite(before.residual_flow[:, 0]) & self.rotation_known
        m = self._rotated(before.normalized)
        m = m + np.nan_to_num(before.residual_flow) * ((stamp_ns - before.stamp_ns) * 1e-9)
        if self._mode == "state":
            known, by_map = self._by_map(before.ids, stamp_ns, feedback)
            m[known], trusted[known] = by_map[known], True
        sane = np.all(np.abs(m) < MAX_TANGENT, axis=1)
        pixels = before.pixels.copy()
        pixels[sane] = self._camera.distort(m[sane])[0]
        size = np.array([self._camera.width - 1, self._camera.height - 1])
        outside = np.any((pixels < 0) | (pixels > size), axis=1)
        pixels[outside] = before.pixels[outside]
        return Prediction(pixels, trusted & sane & ~outside)

    def body_pose(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """world_T_body at a time of the camera; None where it is not known."""
        return self._motion.pose(stamp_ns + self._offset_ns)

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
        rays = np.column_stack([normalized, np.ones(len(normalized))]) @ self.camera_R.T
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
    _, nearest = cKDTree(start).query(at, k=_NEIGHBOURS)
    return np.asarray(np.median((end - start)[nearest], axis=1), np.float32)
