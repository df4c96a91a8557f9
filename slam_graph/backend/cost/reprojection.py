# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The measurement model: reprojection residuals and Jacobians of many observations at once.

An observation z of the feature f by camera c at pose i has the residual z - π_c(p) with
p = (body_T_camera)⁻¹ (world_T_body_i)⁻¹ f, in pixels. Jacobians are with respect to the pose's
tangent (rotation, translation; body frame) and the world position of the feature; they agree with
GTSAM's `GenericProjectionFactor`, but come for all observations in one pass.

The parameters of the rig may be variables too (`calibrated_projection`).

The rows of a rolling shutter are exposed one after the other (Li, Kim and Mourikis 2013). The pose
X(i) is that at the middle row, and at the time of another row, s later, the body is at X(i) ⊕
m_i(s). So a row is a camera that is mounted elsewhere on the body, at m_i(s) body_T_camera. The
motion m_i is that of the gyroscope and of the estimated velocity around the frame. A velocity that
is wrong by 0.05 m/s moves the first and the last row by 0.1 px at 3 m, with a readout of 30 ms. So
m_i follows the estimates, and velocities that are variables have derivatives (`row_velocities`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Self

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.row_velocities import RowVelocities, follow_estimates
from slam_graph.backend.online_calibration import GRAVITY
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.stacked_values import stacked_poses
from slam_graph.backend.solve.state import FrameMotion, State
from slam_graph.kernels.projection import (
    chain_rule,
    distort_equidistant,
    distort_radtan,
    to_cameras,
)
from slam_graph.sensors import Camera, FeatureFrame, Rig

_STILL = FrameMotion(np.zeros(6), 0.0)
_FIRST_POSE = X(0)

MIN_DEPTH = 1e-3
"""Points nearer than this (m) are projected as if at this depth; depth checks reject them."""


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """Values of the variables that observations depend on.

    Attributes:
        rotations: (F, 3, 3) world_R_body of each frame.
        positions: (F, 3) of the body in the world.
        points: (J, 3) features in the world.
    """

    rotations: FloatArray
    positions: FloatArray
    points: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Where cameras see features, N observations of them.

    Attributes:
        in_body: (N, 3) the features in the body frame of the observing pose.
        in_camera: (N, 3) in the frame of the observing camera.
        normalized: (N, 2) on the plane z = 1.
        pixels: (N, 2).
        slopes: (N, 2, 2) derivatives of the pixels by the normalised points.
    """

    in_body: FloatArray
    in_camera: FloatArray
    normalized: FloatArray
    pixels: FloatArray
    slopes: FloatArray


class RigProjection:
    """Projects world points into the cameras of a rig.

    Attributes:
        body_R_camera: (C, 3, 3).
        body_p_camera: (C, 3).
        rolling: whether a shutter rolls; observations are then projected from where their rows were
            exposed, by the motions of their frames.
        has_imu: whether an IMU predicts the motion between frames.
        needs_two_views: whether a single camera sees how far things are, by its motion alone.
        wide: whether a lens sees so much to the side that errors on the plane z = 1 must be
            weighted (`pixel_slopes`).
        calibration_keys: of the parameters of the rig that are variables.
        velocities: of frames, that are variables on which rows of rolling shutters depend.
    """

    calibration_keys: tuple[int, ...] = ()
    velocities = RowVelocities()

    def __init__(
        self,
        rig: Rig,
        motions: Mapping[int, FrameMotion] | None = None,
        taken_by: Rig | None = None,
    ) -> None:
        """Take the calibration of a rig.

        Args:
            rig: the cameras.
            motions: of frames, for rolling shutters; in frames without one the body stands still.
            taken_by: the cameras in whose images features were found, if `rig` has simpler ones in
                their place; pixels are then those of the simpler ones, and their rows are not those
                of the images.
        """
        self.cameras = [mounted.camera for mounted in rig.cameras]
        matrices = np.array([mounted.body_T_camera.matrix() for mounted in rig.cameras])
        self.body_R_camera = matrices[:, :3, :3]
        self.body_p_camera = matrices[:, :3, 3]
        self.rolling = rig.rolling
        self.has_imu, self.needs_two_views = rig.has_imu, rig.needs_two_views
        self.wide = any(camera.model.sees_sideways for camera in self.cameras)
        self._distort, self._lenses = _lens_kernel(self.cameras)
        self._rig = rig
        self._motions = motions or {}
        self._mounts: tuple[Observations, tuple[FloatArray, FloatArray]] | None = None  # the last
        self._taken_by = taken_by or rig

    # --- overridden where the calibration is estimated (see `calibrated_projection`) --------------

    def turn_sigma_rad(self, prior: SquareRootInformation) -> float:
        """Largest standard deviation of the rotation from the first camera to another one, rad.

        Args:
            prior: on the variables of the window.
        """
        return 0.0

    def at(self, state: State) -> RigProjection:
        """The projection with the calibration of a state, and the motions of its frames."""
        return self.moving(state.motions).with_velocities(state, self.velocities.first)

    def moving(self, motions: Mapping[int, FrameMotion]) -> RigProjection:
        """The projection with the motions of frames, which count for rolling shutters only."""
        return RigProjection(self._rig, motions, self._taken_by) if self.rolling else self

    def keys_of(self, obs: Observations) -> list[int]:
        """Keys of all variables beside the features that observations depend on."""
        return [*(_FIRST_POSE + i for i in obs.frames), *self.common_keys]

    def poses(self, values: gtsam.Values, frames: Iterable[int]) -> tuple[FloatArray, FloatArray]:
        """Rotations (F, 3, 3) and positions (F, 3) of the body when some frames were taken."""
        frames = list(frames)
        return self.when_taken(frames, *stacked_poses(values, frames))

    def when_taken(
        self, frames: Sequence[int], rotations: FloatArray, positions: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The same from the poses of the frames, which may be those of other times."""
        return rotations, positions

    def renormalized(self, obs: Observations) -> Observations:
        """The observations with normalised coordinates by the calibration."""
        return obs

    def all_jacobians(
        self, obs: Observations, at: Geometry
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of π by pose (N, 2, 6), point (N, 2, 3) and common variables (N, 2, C)."""
        by_pose, by_point = self.jacobians(obs, at)
        by_pose, by_velocity = self.by_velocities(obs, at, by_pose)
        return by_pose, by_point, by_velocity

    # --- rolling shutters -------------------------------------------------------------------------

    @property
    def common_keys(self) -> tuple[int, ...]:
        """Of the variables that have columns in all observations: calibration and velocities."""
        return (*self.calibration_keys, *self.velocities.keys)

    def with_velocities(self, state: State, frames: Iterable[int]) -> Self:
        """The projection as a function of velocities too, of those frames that have one in a state.

        With global shutters there are none.
        """
        if not self.rolling:
            return self
        projection = copy(self)
        projection.velocities = RowVelocities.of(state, frames)
        return projection

    def follow(self, state: State, before: gtsam.Values) -> None:
        """Renew the motions of a state whose estimates have moved, if velocities are variables."""
        if self.velocities.first:
            gravity = GRAVITY if self._rig.has_imu else np.zeros(3)
            follow_estimates(state, before, gravity)

    def by_velocities(
        self, obs: Observations, at: Geometry, by_pose: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives by poses (N, 2, 6) and velocities (N, 2, 3 V), see `row_velocities`."""
        if not self.velocities.first:
            return by_pose, np.zeros((len(obs), 2, 0))
        return self.velocities.derivatives(obs, at.rotations, self.row_times_s(obs), by_pose)

    def mounts(self, obs: Observations) -> tuple[FloatArray, FloatArray]:
        """Rotations (N, 3, 3) and positions (N, 3) of cameras in the body, where they observed.

        For a rolling shutter this is where the camera was at the time of the observed row, in the
        frame of the body at the pose.
        """
        if self._mounts is not None and self._mounts[0] is obs:
            return self._mounts[1]
        mounts = R, p = self.body_R_camera[obs.camera], self.body_p_camera[obs.camera]
        if self.rolling and len(obs):
            turn, move = self._row_motions(obs).after(self.row_times_s(obs))
            mounts = turn @ R, move + np.einsum("nij,nj->ni", turn, p)
        self._mounts = obs, mounts
        return mounts

    def mount_poses(self, obs: Observations) -> list[gtsam.Pose3]:
        """`mounts` as poses, as GTSAM's projection factors take them."""
        return [gtsam.Pose3(gtsam.Rot3(R), p) for R, p in zip(*self.mounts(obs), strict=True)]

    def row_times_s(self, obs: Observations) -> FloatArray:
        """Times (N,) from the poses of frames to the exposures of the observed rows."""
        if not self.rolling:
            return np.zeros(len(obs))
        readouts = np.array([mounted.readout_s for mounted in self._rig.cameras])
        seconds: FloatArray = self.row_parts(obs) * readouts[obs.camera]
        leads = [
            self._motions[i].time_offset_s if i in self._motions else self._rig.pose_offset_s
            for i in obs.frames
        ]
        seconds += self._rig.cameras[0].time_offset_s - np.array(leads)[obs.frame]
        return seconds

    def row_parts(self, obs: Observations) -> FloatArray:
        """Derivatives (N,) of the times of the observed rows by the readout time: from -1 to 1."""
        parts = np.zeros(len(obs))
        for c, mounted in enumerate(self._rig.cameras):
            rows, lens = obs.camera == c, self._taken_by.cameras[c].camera
            pixels = obs.pixels[rows]
            if lens is not mounted.camera and self._taken_by is not self._rig:
                pixels = lens.distort(obs.normalized[rows])[0]
            parts[rows] = mounted.row_parts(pixels[:, 1])
        return parts

    def row_turns(self, index: int, frame: FeatureFrame) -> list[FloatArray | None]:
        """Rotations (N, 3, 3) of the body from the pose to the rows of the features of each camera.

        Args:
            index: of the frame in the motions.
            frame: its features.

        Returns:
            One for each camera; None for global shutters.
        """
        if not self.rolling:
            return [None] * len(frame.cameras)
        turns: list[FloatArray | None] = []
        for c, seen in enumerate(frame.cameras):
            none = np.zeros(len(seen), np.int64)
            camera = np.full(len(seen), c)
            obs = Observations(seen.ids, (index,), none, none, camera, seen.pixels, seen.normalized)
            turns.append(self._row_motions(obs).after(self.row_times_s(obs))[0])
        return turns

    def _row_motions(self, obs: Observations) -> FrameMotion:
        """Motion of the body at the pose of each observation, N of them in one."""
        motions = [self._motions.get(i, _STILL) for i in obs.frames]
        rate = np.array([motion.rate for motion in motions])[obs.frame]
        change = np.array([motion.change for motion in motions])[obs.frame]
        return FrameMotion(rate, 0.0, change)

    # --- geometry ---------------------------------------------------------------------------------

    def views(self, obs: Observations, at: Geometry) -> Views:
        """Where the cameras see the observed features."""
        mount_R, mount_p, mount = self._mount_table(obs)
        count = len(obs)
        in_body, in_camera, normalized = (
            np.empty((count, 3)),
            np.empty((count, 3)),
            np.empty((count, 2)),
        )
        to_cameras(
            at.rotations,
            at.positions,
            at.points,
            mount_R,
            mount_p,
            obs.frame,
            obs.feature,
            mount,
            MIN_DEPTH,
            in_body,
            in_camera,
            normalized,
        )
        return Views(in_body, in_camera, normalized, *self._distorted(obs, normalized))

    def _mount_table(self, obs: Observations) -> tuple[FloatArray, FloatArray, IntArray]:
        """Rotations (M, 3, 3) and positions (M, 3) of cameras in the body, and whose are whose."""
        if self.rolling:
            return *self.mounts(obs), np.arange(len(obs))
        return self.body_R_camera, self.body_p_camera, obs.camera

    def _distorted(
        self, obs: Observations, normalized: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (N, 2) of normalised points, and d pixel / d normalised (N, 2, 2)."""
        pixels, slopes = np.empty((len(obs), 2)), np.empty((len(obs), 2, 2))
        if self._distort is not None:
            self._distort(normalized, obs.camera, self._lenses, pixels, slopes)
            return pixels, slopes
        for number, camera in enumerate(self.cameras):
            rows = np.flatnonzero(obs.camera == number)
            pixels[rows], slopes[rows] = camera.distort(normalized[rows])
        return pixels, slopes

    def residuals(self, obs: Observations, at: Geometry) -> tuple[FloatArray, FloatArray]:
        """Residuals z - π(f) (N, 2) in pixels, and depths (N,) in metres.

        With a wide lens near points have small depths at the edge of the image. There a depth is
        the distance from the camera, negative behind it.
        """
        views = self.views(obs, at)
        return obs.pixels - views.pixels, self.depths(views)

    def depths(self, views: Views) -> FloatArray:
        """Depths (N,) as `residuals` gives them."""
        depths = views.in_camera[:, 2]
        if self.wide:
            depths = np.copysign(np.linalg.norm(views.in_camera, axis=1), depths)
        return depths

    def pixel_slopes(self, obs: Observations) -> FloatArray:
        """Derivatives (N, 2, 2) of the observed pixels by their normalised coordinates.

        In units of the first camera's focal length. They weigh errors on the plane z = 1 as the
        pixels do, whose noise is the same everywhere: on that plane it grows with 1 / cos² of the
        angle to the axis.
        """
        return self._distorted(obs, obs.normalized)[1] / self.cameras[0].fx

    def jacobians(self, obs: Observations, at: Geometry) -> tuple[FloatArray, FloatArray]:
        """Derivatives of π, not of the residual.

        Returns:
            by_pose: (N, 2, 6).
            by_point: (N, 2, 3).
        """
        return self.derivatives(obs, at, self.views(obs, at))[:2]

    def derivatives(
        self, obs: Observations, at: Geometry, views: Views
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives by pose (N, 2, 6), point (N, 2, 3) and point in the camera (N, 2, 3)."""
        mount_R, _, mount = self._mount_table(obs)
        count = len(obs)
        by_pose = np.empty((count, 2, 6))
        by_point, by_camera_point = np.empty((count, 2, 3)), np.empty((count, 2, 3))
        chain_rule(
            views.in_body,
            views.in_camera,
            views.slopes,
            at.rotations,
            mount_R,
            obs.frame,
            mount,
            MIN_DEPTH,
            by_camera_point,
            by_pose,
            by_point,
        )
        return by_pose, by_point, by_camera_point


def _lens_kernel(cameras: Sequence[Camera]) -> tuple[Callable[..., None] | None, FloatArray]:
    """The kernel of the model of some cameras, and their intrinsics and coefficients (C, 8).

    No distortion is Brown's model without any. There is no kernel for other and for mixed models.
    """
    models, straight = {camera.distortion for camera in cameras}, (0.0, 0.0, 0.0, 0.0)
    rows = [[*camera.intrinsics, *(camera.coefficients or straight)] for camera in cameras]
    if models <= {"radtan", "none"}:
        return distort_radtan, np.array(rows, np.float64)
    if models == {"equidistant"}:
        return distort_equidistant, np.array(rows, np.float64)
    return None, np.zeros((0, 8))
