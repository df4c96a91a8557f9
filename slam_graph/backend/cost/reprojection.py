# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The measurement model: reprojection residuals of many observations at once, with Jacobians.

An observation z of the feature f by camera c at pose i has the residual z - π_c(p) with
p = (body_T_camera)⁻¹ (world_T_body_i)⁻¹ f, in pixels. Jacobians are with respect to the pose's
tangent (rotation, translation; body frame) and the world position of the feature; they agree with
GTSAM's `GenericProjectionFactor`, but come for all observations in one pass.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.solve.state import State, stacked_poses
from slam_graph.sensors import Rig

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


class RigProjection:
    """Projects world points into the cameras of a rig.

    Attributes:
        body_R_camera: (C, 3, 3).
        body_p_camera: (C, 3).
        calibration_keys: of the parameters of the rig that are variables.
    """

    calibration_keys: tuple[int, ...] = ()

    def __init__(self, rig: Rig) -> None:
        self.cameras = [mounted.camera for mounted in rig.cameras]
        matrices = np.array([mounted.body_T_camera.matrix() for mounted in rig.cameras])
        self.body_R_camera = matrices[:, :3, :3]
        self.body_p_camera = matrices[:, :3, 3]

    # --- overridden where the calibration is estimated (see `calibrated_projection`) --------------

    def at(self, state: State) -> RigProjection:
        """The projection with the calibration of a state."""
        return self

    def keys_of(self, obs: Observations) -> list[int]:
        """Keys of all variables beside the features that observations depend on."""
        return [*(X(i) for i in obs.frames), *self.calibration_keys]

    def poses(self, values: gtsam.Values, frames: Iterable[int]) -> tuple[FloatArray, FloatArray]:
        """Rotations (F, 3, 3) and positions (F, 3) of the body when some frames were taken."""
        return stacked_poses(values, frames)

    def renormalized(self, obs: Observations) -> Observations:
        """The observations with normalised coordinates by the calibration."""
        return obs

    def all_jacobians(
        self, obs: Observations, at: Geometry
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of π by pose (N, 2, 6), point (N, 2, 3) and calibration (N, 2, C)."""
        return (*self.jacobians(obs, at), np.zeros((len(obs), 2, 0)))

    # --- geometry ---------------------------------------------------------------------------------

    def in_body(self, obs: Observations, at: Geometry) -> FloatArray:
        """The observed features (N, 3) in the body frame of the observing pose."""
        difference = at.points[obs.feature] - at.positions[obs.frame]
        points: FloatArray = np.einsum("nji,nj->ni", at.rotations[obs.frame], difference)
        return points

    def in_camera(self, obs: Observations, in_body: FloatArray) -> FloatArray:
        """Points (N, 3) of the body frame in the frame of the observing camera."""
        difference = in_body - self.body_p_camera[obs.camera]
        points: FloatArray = np.einsum("nji,nj->ni", self.body_R_camera[obs.camera], difference)
        return points

    def pixels(self, obs: Observations, in_camera: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (N, 2) of points in the camera frame, and d pixel / d normalised (N, 2, 2)."""
        depth = np.maximum(in_camera[:, 2:3], MIN_DEPTH)
        normalized = in_camera[:, :2] / depth
        if len(self.cameras) == 1:
            return self.cameras[0].distort(normalized)
        pixels, slope = np.empty((len(obs), 2)), np.empty((len(obs), 2, 2))
        for number, camera in enumerate(self.cameras):
            rows = obs.camera == number
            pixels[rows], slope[rows] = camera.distort(normalized[rows])
        return pixels, slope

    def residuals(self, obs: Observations, at: Geometry) -> tuple[FloatArray, FloatArray]:
        """Residuals z - π(f) (N, 2) in pixels, and depths (N,) in metres."""
        in_camera = self.in_camera(obs, self.in_body(obs, at))
        return obs.pixels - self.pixels(obs, in_camera)[0], in_camera[:, 2]

    def jacobians(self, obs: Observations, at: Geometry) -> tuple[FloatArray, FloatArray]:
        """Derivatives of π, not of the residual.

        Returns:
            by_pose: (N, 2, 6).
            by_point: (N, 2, 3).
        """
        in_body = self.in_body(obs, at)
        by_camera_point = self.by_camera_point(obs, self.in_camera(obs, in_body))
        camera_R_body = np.ascontiguousarray(self.body_R_camera.transpose(0, 2, 1))
        by_body_point = by_camera_point @ camera_R_body[obs.camera]
        by_pose = np.empty((len(obs), 2, 6))
        # rotating the body by θ moves the point by p × θ in the body frame
        by_pose[:, :, :3] = np.cross(by_body_point, in_body[:, None, :])
        by_pose[:, :, 3:] = -by_body_point
        body_R_world = np.ascontiguousarray(at.rotations.transpose(0, 2, 1))
        by_point = by_body_point @ body_R_world[obs.frame]
        return by_pose, by_point

    def by_camera_point(self, obs: Observations, in_camera: FloatArray) -> FloatArray:
        """Derivatives (N, 2, 3) of the pixels of points (N, 3) by these, in the camera frame."""
        depth = np.maximum(in_camera[:, 2], MIN_DEPTH)
        _, slope = self.pixels(obs, in_camera)
        derivative = np.empty((len(obs), 2, 3))
        derivative[:, :, :2] = slope / depth[:, None, None]
        ratio = in_camera[:, :2] / depth[:, None] ** 2
        derivative[:, :, 2] = -np.einsum("nij,nj->ni", slope, ratio)
        return derivative
