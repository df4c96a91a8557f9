# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The measurement model where the calibration is estimated: by a state, with more Jacobians.

The parameters of the rig do not depend on the origin and heading of the world. So the projection
may be linearised at the current calibration while poses and features stay at their first estimates:
the unobservable directions remain unobservable (see `state`).

The pose X(i) of a frame is that at the time t_i + τ_i, for the time offset τ_i that was known when
the frame came. Under another offset τ the body is, to first order, at X(i) ⊕ (τ - τ_i) (ω_i, v_i),
with its angular rate and velocity in the body frame then (Li and Mourikis 2014).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, K, T
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.online_calibration import CalibrationVariables
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import (
    FrameMotion,
    State,
    dims_of,
    distortion_key,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Shift:
    """Motion of the body from the poses of F frames to when the frames were taken.

    Attributes:
        turn: (F, 3, 3) rotation.
        move: (F, 3) translation.
        rate: (F, 6) its derivative by the time, in the body frame at the end.
    """

    turn: FloatArray
    move: FloatArray
    rate: FloatArray

    def by_pose(self) -> FloatArray:
        """Derivative (F, 6, 6) of the pose at the end by the pose at the start."""
        back = self.turn.transpose(0, 2, 1)
        derivative = np.zeros((len(back), 6, 6))
        derivative[:, :3, :3] = derivative[:, 3:, 3:] = back
        derivative[:, 3:, :3] = -back @ skew(self.move)
        return derivative


class CalibratedProjection(RigProjection):
    """Projects by the calibration that is in a state.

    Attributes:
        variables: which parameters are in the state.
    """

    def __init__(self, variables: CalibrationVariables, state: State | None = None) -> None:
        """Take the calibration of a state; the nominal one without a state."""
        rig = variables.nominal if state is None else variables.rig(state.frames)
        super().__init__(rig, None if state is None else state.motions)
        self.rolling = variables.rolling
        self.variables = variables
        self.calibration_keys = variables.keys
        self._state = state
        self._columns = Layout(dims_of(variables.keys)).columns

    def at(self, state: State) -> CalibratedProjection:
        """The projection with the calibration of a state, and the motions of its frames."""
        now = CalibratedProjection(self.variables, state)
        return now.with_velocities(state, self.velocities.first)

    def turn_sigma_rad(self, prior: SquareRootInformation) -> float:
        """See `RigProjection`."""
        keys = self.variables.extrinsics
        if self._rig.depth is not None:
            keys = keys[:-1]  # the last camera stands for the depth sensor
        if len(keys) < 2:
            return 0.0
        root = prior.columns_of_root(keys).reshape(-1, len(keys), 6)[:, :, :3]
        first = self.body_R_camera[0]
        turns = [
            root[:, c] - root[:, 0] @ first.T @ self.body_R_camera[c] for c in range(1, len(keys))
        ]
        return float(np.sqrt(max(np.sum(turn**2, axis=0).max() for turn in turns)))

    def moving(self, motions: Mapping[int, FrameMotion]) -> RigProjection:
        """The projection with the calibration as it is now, and the motions of frames."""
        return RigProjection(self._rig, motions) if self.rolling else self

    def when_taken(
        self, frames: Sequence[int], rotations: FloatArray, positions: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Rotations (F, 3, 3) and positions (F, 3) of the body when some frames were taken."""
        shift = self._shift(frames)
        if shift is None:
            return rotations, positions
        moved = positions + np.einsum("fij,fj->fi", rotations, shift.move)
        return rotations @ shift.turn, moved

    def renormalized(self, obs: Observations) -> Observations:
        """The observations with normalised coordinates by the calibration."""
        if not (self.variables.config.intrinsics or self.variables.config.distortion):
            return obs
        normalized = np.empty_like(obs.normalized)
        for c, camera in enumerate(self.cameras):
            rows = obs.camera == c
            normalized[rows] = camera.undistort(obs.pixels[rows], near=obs.normalized[rows])
        return replace(obs, normalized=normalized)

    def all_jacobians(
        self, obs: Observations, at: Geometry
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of π by pose (N, 2, 6), point (N, 2, 3) and common variables (N, 2, C).

        Args:
            obs: N observations.
            at: poses of the body when the frames were taken, as `poses` gives them.
        """
        views = self.views(obs, at)
        by_pose, by_point, by_camera_point = self.derivatives(obs, at, views)
        by_calibration = np.zeros((len(obs), 2, sum(dims_of(self.calibration_keys).values())))
        in_camera, normalized = views.in_camera, views.normalized
        for c, camera in enumerate(self.cameras):
            rows = obs.camera == c
            if E(c) in self._columns:
                by_camera = _by_camera_pose(by_camera_point[rows], in_camera[rows])
                by_calibration[rows, :, self._columns[E(c)]] = by_camera @ self._tangent(c)
            if K(c) in self._columns:
                by_intrinsics = camera.by_intrinsics(normalized[rows])
                by_calibration[rows, :, self._columns[K(c)]] = by_intrinsics
            distortion = distortion_key(c, len(camera.coefficients))
            if distortion in self._columns:
                by_coefficients = camera.by_coefficients(normalized[rows])
                by_calibration[rows, :, self._columns[distortion]] = by_coefficients
        if self.rolling and self._state is not None:
            by_time = self._by_time(obs, by_camera_point, in_camera)
            if self.variables.estimates_offset:
                by_calibration[:, :, self._columns[T(0)].start] = by_time
            if self.variables.estimates_readout:
                part = self.row_parts(obs)[:, None]
                by_calibration[:, :, self._columns[T(1)].start] = by_time * part
        shift = self._shift(obs.frames)
        if shift is not None:
            by_offset = np.einsum("nij,nj->ni", by_pose, shift.rate[obs.frame])
            by_calibration[:, :, self._columns[T(0)].start] = by_offset
            by_pose = by_pose @ shift.by_pose()[obs.frame]
        by_pose, by_velocity = self.by_velocities(obs, at, by_pose)
        return by_pose, by_point, np.concatenate([by_calibration, by_velocity], axis=2)

    def _by_time(
        self, obs: Observations, by_camera_point: FloatArray, in_camera: FloatArray
    ) -> FloatArray:
        """Derivatives (N, 2) of the pixels by the times at which their rows were exposed."""
        R, p = self.body_R_camera[obs.camera], self.body_p_camera[obs.camera]
        rates = self._row_motions(obs).rates_after(self.row_times_s(obs))
        in_body = np.einsum("nij,nj->ni", R, in_camera) + p  # of the body at the time of the row
        flow = -np.cross(rates[:, :3], in_body) - rates[:, 3:]
        by_time: FloatArray = np.einsum("nij,nkj,nk->ni", by_camera_point, R, flow)
        return by_time

    def _tangent(self, c: int) -> FloatArray:
        """Derivative (6, 6) of the pose of a camera by its offset from its first estimate."""
        if self._state is None:
            return np.eye(6)
        return np.asarray(gtsam.Pose3.ExpmapDerivative(self._state.offset_of(E(c))))

    def _shift(self, frames: Iterable[int]) -> _Shift | None:
        """From the poses of frames to when they were taken; None if no offset is estimated.

        For rolling shutters that is part of the motion to the observed rows.
        """
        if self._state is None or not self.variables.estimates_offset or self.rolling:
            return None
        offset_s = float(self._state.frames.atVector(T(0))[0])
        motions = [self._state.motions[i] for i in frames]
        rate = np.array([motion.rate for motion in motions]).reshape(-1, 6)
        late_s = np.array([offset_s - motion.time_offset_s for motion in motions])[:, None]
        turn = Rotation.from_rotvec(rate[:, :3] * late_s).as_matrix()
        velocity = np.einsum("fji,fj->fi", turn, rate[:, 3:])
        return _Shift(turn, rate[:, 3:] * late_s, np.hstack([rate[:, :3], velocity]))


def _by_camera_pose(by_camera_point: FloatArray, in_camera: FloatArray) -> FloatArray:
    """Derivatives (N, 2, 6) of pixels by the pose of the camera in the body, in its own tangent."""
    # turning the camera by θ moves the point by p × θ in the camera frame
    by_rotation = np.cross(by_camera_point, in_camera[:, None, :])
    return np.concatenate([by_rotation, -by_camera_point], axis=2)
