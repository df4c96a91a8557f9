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

from slam_graph.arrays import FloatArray
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
_NEWTON_STEPS = 12
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


def align(
    obs: Observations, motion: Motion, rig: RigProjection, gravity: float
) -> Alignment | None:
    """Solve for velocity and gravity.

    Args:
        obs: features seen from at least two of the K frames.
        motion: inertial motion between the frames.
        rig: mounting of the cameras.
        gravity: its magnitude, m/s².

    Returns:
        None if the equations do not determine a solution.
    """
    weights = np.ones(len(obs))
    for rounds_left in reversed(range(1 + _REWEIGHTINGS)):
        by_point, by_motion, b = alignment_equations(obs, motion, rig, weights)
        others = np.concatenate([by_motion, b[:, :, None]], axis=2)
        R, eliminated = eliminate_points(obs, by_point, others)
        rest = eliminated[:, 3:].reshape(-1, 7)
        try:
            alignment = constrained_solution(rest[:, :6], rest[:, 6], gravity)
        except (np.linalg.LinAlgError, ValueError):
            return None
        if not rounds_left:
            break
        weights = 1.0 / _depths(obs, motion, rig, alignment, (R, eliminated[:, :3]))
    return alignment


def alignment_equations(
    obs: Observations, motion: Motion, rig: RigProjection, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coefficients of f (N, 2, 3) and of (v₀, g) (N, 2, 6), and right-hand sides (N, 2)."""
    body_R_camera, body_p_camera = rig.mounts(obs)
    camera_R_body = body_R_camera.transpose(0, 2, 1)
    rows = np.zeros((len(obs), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[:, :, 2] = -obs.normalized
    if rig.wide:
        rows = rig.pixel_slopes(obs) @ rows
    in_body = rows @ camera_R_body * weights[:, None, None]
    by_point = in_body @ motion.rotations[obs.frame].transpose(0, 2, 1)
    late_s = rig.row_times_s(obs)  # of the rows of a rolling shutter
    t = (motion.times_s[obs.frame] + late_s)[:, None, None]
    by_motion = np.concatenate([-by_point * t, -0.5 * by_point * t**2], axis=2)
    displacements = motion.displacements[obs.frame]
    if rig.rolling:
        displacements = displacements + motion.velocities[obs.frame] * late_s[:, None]
    b = np.einsum("nij,nj->ni", by_point, displacements)
    b += np.einsum("nij,nj->ni", in_body, body_p_camera)
    return by_point, by_motion, b


def _depths(
    obs: Observations,
    motion: Motion,
    rig: RigProjection,
    found: Alignment,
    of_points: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Depths (N,) of the features in their cameras under an alignment.

    Args:
        obs: N observations of J features.
        motion: inertial motion between the frames.
        rig: mounting of the cameras.
        found: velocity and gravity.
        of_points: the equations for the features: their triangular coefficients (J, 3, 3), and
            those of velocity and gravity with the right-hand side (J, 3, 7).
    """
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
    secular_roots(values, projected, gravity, _NEWTON_STEPS, multipliers)
    return np.asarray(multipliers[:, None])
