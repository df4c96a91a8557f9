# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visual-inertial alignment: velocity, gravity and scale of a short window.

With rotations R_k and the doubly integrated specific force α_k of a gyroscope of known bias, the
body is at p_k = v₀ t_k + ½ g t_k² + α_k in the frame of the first body. Every observation m of a
feature f then gives two equations that are linear in (f, v₀, g),

    (I₂ | -m) (R_camᵀ (R_kᵀ (f - p_k) - p_cam)) = 0,

(Dong-Si & Mourikis 2012). The features are eliminated one by one, and the six remaining unknowns
are solved for under the constraint that gravity has its known length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.cost.feature_factors import eliminate_points
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.initialization.inertial_motion import Motion
from slam_graph.backend.solve.square_root import triangularize
from slam_graph.kernels.secular import secular_roots

_REWEIGHTINGS = 2
"""How often the equations are weighted again by the inverse depths of their solution."""
MIN_DEPTH_M = 0.1
"""Depths are at least this, so that weights stay finite."""
NEWTON_STEPS = 12
"""Most steps to the Lagrange multiplier; each doubles its digits, and the first ones are good."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Velocity and gravity, in the frame of the first body.

    Attributes:
        velocity: (3,) of the body at the first frame.
        gravity: (3,) m/s².
    """

    velocity: FloatArray
    gravity: FloatArray

    def positions(self, motion: Motion) -> FloatArray:
        """Positions (K, 3) of the body."""
        t = motion.times_s[:, None]
        return self.velocity * t + 0.5 * self.gravity * t**2 + motion.displacements

    def velocities(self, motion: Motion) -> FloatArray:
        """Velocities (K, 3) of the body."""
        return self.velocity + self.gravity * motion.times_s[:, None] + motion.velocities


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentEquations:
    """The equations of N observations for their features and one motion of the body.

    Attributes:
        obs: the observations.
        rig: mounting of the cameras.
        motion: inertial motion between the frames.
        times_s: (N,) of the observed rows since the first frame.
        by_point: (N, 2, 3) coefficients of the position of the feature.
        b: (N, 2) right-hand sides.
    """

    obs: Observations
    rig: RigProjection
    motion: Motion
    times_s: FloatArray
    by_point: FloatArray
    b: FloatArray

    def subset(self, keep: BoolArray) -> AlignmentEquations:
        """Those of the features where `keep` (J,) holds."""
        if keep.all():
            return self
        rows = keep[self.obs.feature].nonzero()[0]
        times_s, by_point, b = self.times_s[rows], self.by_point[rows], self.b[rows]
        obs = self.obs.subset(keep)
        return AlignmentEquations(obs, self.rig, self.motion, times_s, by_point, b)

    def without_points(self, weights: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """The weighted equations, triangular in the positions of the features.

        Args:
            weights: (N,) of the observations; all 1 if not given.

        Returns:
            The coefficients (J, 3, 3) of the positions, and those (J, 2 M, 7) of velocity, gravity
            and the right-hand side; from the fourth row on they do not contain the feature.
        """
        by_point, b, t = self.by_point, self.b, self.times_s[:, None, None]
        if weights is not None:
            by_point, b = by_point * weights[:, None, None], b * weights[:, None]
        others = np.empty((len(b), 2, 7))
        np.multiply(by_point, -t, out=others[:, :, :3])
        np.multiply(by_point, -0.5 * t**2, out=others[:, :, 3:6])
        others[:, :, 6] = b
        return eliminate_points(self.obs, by_point, others)


class Sightings:
    """What observations say of directions in the body: the same for every motion.

    Attributes:
        obs: the observations.
        rig: mounting of the cameras.
    """

    def __init__(self, obs: Observations, rig: RigProjection) -> None:
        """Turn the rows (I₂ | -m) of all observations into the body."""
        self.obs, self.rig = obs, rig
        body_R_camera, body_p_camera = rig.mounts(obs)
        rows = np.zeros((len(obs), 2, 3))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, :, 2] = -obs.normalized
        if rig.wide:
            rows = rig.pixel_slopes(obs) @ rows
        self._rows = rows @ body_R_camera.transpose(0, 2, 1)
        self._of_cameras = (self._rows @ body_p_camera[:, :, None])[..., 0]
        self._late_s = rig.row_times_s(obs)  # of the rows of a rolling shutter

    def equations(self, motion: Motion) -> AlignmentEquations:
        """The equations for one motion."""
        frame = self.obs.frame
        by_point = self._rows @ motion.rotations.transpose(0, 2, 1)[frame]
        displacements = motion.displacements[frame]
        if self.rig.rolling:
            displacements = displacements + motion.velocities[frame] * self._late_s[:, None]
        b = (by_point @ displacements[:, :, None])[..., 0] + self._of_cameras
        times_s = motion.times_s[frame] + self._late_s
        return AlignmentEquations(self.obs, self.rig, motion, times_s, by_point, b)


def align(equations: AlignmentEquations, gravity: float) -> Alignment | None:
    """Solve for velocity and gravity.

    Args:
        equations: of features seen from at least two of the frames.
        gravity: its magnitude, m/s².

    Returns:
        None if the equations do not determine a solution.
    """
    weights = None
    for rounds_left in reversed(range(1 + _REWEIGHTINGS)):
        R, eliminated = equations.without_points(weights)
        rest = eliminated[:, 3:].reshape(-1, 7)
        try:
            alignment = constrained_solution(rest[:, :6], rest[:, 6], gravity)
        except (np.linalg.LinAlgError, ValueError):
            return None
        if not rounds_left:
            break
        weights = 1.0 / _depths(equations, alignment, (R, eliminated[:, :3]))
    return alignment


def _depths(
    equations: AlignmentEquations, found: Alignment, of_points: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Depths (N,) of the features in their cameras under an alignment.

    Args:
        equations: of N observations of J features.
        found: velocity and gravity.
        of_points: the equations for the features: their triangular coefficients (J, 3, 3), and
            those of velocity and gravity with the right-hand side (J, 3, 7).
    """
    obs, motion, rig = equations.obs, equations.motion, equations.rig
    R, others = of_points
    right = others @ np.concatenate([-found.velocity, -found.gravity, [1.0]])
    points = np.linalg.solve(R + 1e-9 * np.eye(3), right[:, :, None])[:, :, 0]
    p = found.positions(motion)[obs.frame]
    in_body = np.einsum("nji,nj->ni", motion.rotations[obs.frame], points[obs.feature] - p)
    body_R_camera, body_p_camera = rig.mounts(obs)
    depths = np.einsum("ni,ni->n", body_R_camera[:, :, 2], in_body - body_p_camera)
    return np.asarray(np.maximum(np.abs(depths), MIN_DEPTH_M), dtype=np.float64)


def constrained_solution(A: FloatArray, b: FloatArray, gravity: float) -> Alignment:
    """Least squares under |g| = gravity: a secular equation in the Lagrange multiplier.

    Args:
        A: (rows, 6), by velocity and gravity.
        b: (rows,).
        gravity: its magnitude, m/s².

    Raises:
        ValueError: if the equations do not depend on gravity.
    """
    R = triangularize(np.column_stack([A, b]))
    of_v, of_g, right = R[:3, :3], R[3:6, 3:6], R[3:6, 6]
    values, vectors = np.linalg.eigh(of_g.T @ of_g)
    projected = vectors.T @ (of_g.T @ right)
    multiplier = secular_multipliers(values[None], projected[None], gravity)[0]
    g = vectors @ (projected / (values + multiplier))
    length = np.linalg.norm(g)
    if length == 0.0:
        raise ValueError("the equations do not see gravity")
    g *= gravity / length
    v = np.linalg.solve(of_v, R[:3, 6] - R[:3, 3:6] @ g)
    return Alignment(v, g)


def secular_multipliers(values: FloatArray, projected: FloatArray, gravity: float) -> FloatArray:
    """Lagrange multipliers (S, 1) of the length of gravity, for many problems at once.

    They are the roots of ‖projected / (values + multiplier)‖ = gravity. Newton's method on the
    inverse length, which is nearly linear in the multiplier, finds them from the left without
    safeguards (Moré & Sorensen 1983).

    Args:
        values: (S, 3) eigenvalues of the information about gravity, ascending.
        projected: (S, 3) right-hand sides in the basis of its eigenvectors.
        gravity: its magnitude, m/s².
    """
    multipliers = -values[:, 0] + 1e-12 * np.maximum(values[:, 2], 1e-12)
    secular_roots(values, projected, gravity, NEWTON_STEPS, multipliers)
    return np.asarray(multipliers[:, None])
