# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visual-inertial alignment: gyroscope bias, velocity, gravity and scale of a short window.

Gyroscope bias from epipolar geometry: rotations for which the epipolar planes share one line. For a
pair of frames with relative rotation R, the normals n = f₁ × R f₂ of the epipolar planes are all
orthogonal to the translation, so the smallest eigenvalue of Σ n nᵀ vanishes (Kneip & Lynen 2013).
With R integrated from the gyroscope this is a cost in its bias only: no depth, velocity or gravity
is needed (He, Xu, Ouyang & Li 2023).

Noise increases that eigenvalue, but hardly for a translation along the optical axis. So the plain
smallest eigenvalue is biased towards rotations under which the camera seems to move straight ahead.
The eigenvalue relative to the part that noise adds is not (Kanatani 1996, renormalization).

With rotations R_k and the doubly integrated specific force α_k of a gyroscope of known bias, the
body is at p_k = v₀ t_k + ½ g t_k² + α_k in the frame of the first body. Every observation m of a
feature f then gives two equations that are linear in (f, v₀, g),

    (I₂ | -m) (R_camᵀ (R_kᵀ (f - p_k) - p_cam)) = 0,

(Dong-Si & Mourikis 2012). The features are eliminated one by one, and the six remaining unknowns
are solved for under the constraint that gravity has its known length.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_factors import eliminate_points
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.solve.square_root import triangularize
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData

_MIN_COMMON = 8
"""Pairs of frames with fewer common features than this are left out."""
_STEP_RAD_S = 1e-4
"""Step of the numerical derivative by the bias."""
_ROBUST_WIDTH = 0.02
"""Width of the robust loss on the whitened residual of a pair."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of frames with their common features.

    Attributes:
        pair: (N,) which pair each feature belongs to, ascending.
        starts: (P,) first feature of each pair.
        first, second: (N, 3) bearings in the orientation of the body.
        R: (P, 3, 3) rotation from the second body to the first.
        by_bias: (P, 3, 3) its derivative by the bias.
        whitening: (P, 3, 3) makes the noise of Σ n nᵀ the same in all directions.
    """

    pair: NDArray[np.intp]
    starts: NDArray[np.intp]
    first: FloatArray
    second: FloatArray
    R: FloatArray
    by_bias: FloatArray
    whitening: FloatArray


def estimate_gyro_bias(
    frames: list[FeatureFrame],
    imu: list[ImuData],
    rig: RigProjection,
    params: gtsam.PreintegrationCombinedParams,
) -> FloatArray | None:
    """The constant gyroscope bias (3,) rad/s over some frames, None without enough features.

    Args:
        frames: in the order of time.
        imu: samples between each frame and the next.
        rig: mounting of the cameras.
        params: of the preintegration.
    """
    bias = np.zeros(3)
    for _ in range(2):  # the rotation is linearised in the bias: once more at the solution
        pairs = _pairs(frames, imu, rig, params, bias)
        if pairs is None:
            return None
        result = least_squares(
            _residuals, np.zeros(3), args=(pairs,), loss="huber", f_scale=_ROBUST_WIDTH
        )
        bias = bias + result.x
    return bias


def _residuals(change: FloatArray, pairs: _Pairs) -> FloatArray:
    """Distance (P,) of each pair's normals from the plane that fits them best."""
    R = pairs.R @ Rotation.from_rotvec(pairs.by_bias @ change).as_matrix()
    normals = np.cross(pairs.first, np.einsum("nij,nj->ni", R[pairs.pair], pairs.second))
    scatter = np.add.reduceat(normals[:, :, None] * normals[:, None, :], pairs.starts)
    white = pairs.whitening @ scatter @ pairs.whitening.transpose(0, 2, 1)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(white)[:, 0], 0.0)))


def _pairs(
    frames: list[FeatureFrame],
    imu: list[ImuData],
    rig: RigProjection,
    params: gtsam.PreintegrationCombinedParams,
    bias: FloatArray,
) -> _Pairs | None:
    first, second, rotations, derivatives = [], [], [], []
    turns = [rig.row_turns(k, frame) for k, frame in enumerate(frames)]
    for k, samples in enumerate(imu):
        before, after = frames[k], frames[k + 1]
        R, by_bias = _rotation_by_bias(samples, bias, params)
        for camera, (one, two) in enumerate(zip(before.cameras, after.cameras, strict=True)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            if len(i) >= _MIN_COMMON:
                mounting = rig.body_R_camera[camera]
                first.append(_bearings(one, i, mounting, turns[k][camera]))
                second.append(_bearings(two, j, mounting, turns[k + 1][camera]))
                rotations.append(R)
                derivatives.append(by_bias)
    if not first:
        return None
    counts = np.array([len(bearings) for bearings in first])
    return _Pairs(
        np.repeat(np.arange(len(counts)), counts),
        np.cumsum(counts) - counts,
        np.concatenate(first),
        np.concatenate(second),
        np.array(rotations),
        np.array(derivatives),
        np.array([_whitening(*pair) for pair in zip(first, second, rotations, strict=True)]),
    )


def _whitening(first: FloatArray, second: FloatArray, R: FloatArray) -> FloatArray:
    """The matrix (3, 3) that whitens the noise of the normals of a pair, on average.

    Noise σ perpendicular to the bearings adds σ² Σ (I - f₁ f₁ᵀ) + (I - R f₂ (R f₂)ᵀ) to Σ n nᵀ, the
    normals being n = f₁ × R f₂.

    Args:
        first: (N, 3) bearings.
        second: (N, 3) those of the same features in the second frame.
        R: (3, 3) rotation from the second body to the first.
    """
    turned = second @ R.T
    noise = 2.0 * np.eye(3) - (first.T @ first + turned.T @ turned) / len(first)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(noise)))


def _rotation_by_bias(
    samples: ImuData, bias: FloatArray, params: gtsam.PreintegrationCombinedParams
) -> tuple[FloatArray, FloatArray]:
    """The rotation (3, 3) over some samples and its derivative (3, 3) by the gyroscope bias."""
    R = _rotation(samples, bias, params)
    moved = np.array([_rotation(samples, bias + step, params) for step in _STEP_RAD_S * np.eye(3)])
    return R, Rotation.from_matrix(R.T @ moved).as_rotvec().T / _STEP_RAD_S


def _rotation(
    samples: ImuData, gyro_bias: FloatArray, params: gtsam.PreintegrationCombinedParams
) -> FloatArray:
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias)
    return np.asarray(samples.preintegrated(bias, params).deltaRij().matrix())


def _bearings(
    obs: FeatureObservations, rows: NDArray[np.intp], R: FloatArray, turns: FloatArray | None
) -> FloatArray:
    bearings = np.concatenate([obs.normalized[rows], np.ones((len(rows), 1))], axis=1)
    unit: FloatArray = (bearings / np.linalg.norm(bearings, axis=1, keepdims=True)) @ R.T
    return unit if turns is None else np.einsum("nij,nj->ni", turns[rows], unit)


_REWEIGHTINGS = 2
"""How often the equations are weighted again by the inverse depths of their solution."""
MIN_DEPTH_M = 0.1
"""Depths are at least this, so that weights stay finite."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The inertial motion of the body relative to its first frame, up to velocity and gravity.

    Attributes:
        times_s: (K,) since the first frame.
        rotations: (K, 3, 3) first_R_body.
        displacements: (K, 3) α, the double integral of the rotated specific force.
        velocities: (K, 3) its single integral.
    """

    times_s: FloatArray
    rotations: FloatArray
    displacements: FloatArray
    velocities: FloatArray


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
    alignment = None
    for _ in range(1 + _REWEIGHTINGS):
        A, b = _reduced_equations(obs, motion, rig, weights)
        try:
            alignment = constrained_solution(A, b, gravity)
        except (np.linalg.LinAlgError, ValueError):
            return None
        weights = 1.0 / _depths(obs, motion, rig, alignment, weights)
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


def _reduced_equations(
    obs: Observations, motion: Motion, rig: RigProjection, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The equations (rows, 6) and right-hand sides (rows,) that no longer contain the features."""
    by_point, by_motion, b = alignment_equations(obs, motion, rig, weights)
    _, eliminated = eliminate_points(obs, by_point, np.concatenate([by_motion, b[:, :, None]], 2))
    rest = eliminated[:, 3:].reshape(-1, 7)
    return rest[:, :6], rest[:, 6]


def _depths(
    obs: Observations, motion: Motion, rig: RigProjection, found: Alignment, weights: FloatArray
) -> FloatArray:
    """Depths (N,) of the features in their cameras under an alignment."""
    by_point, by_motion, b = alignment_equations(obs, motion, rig, weights)
    rest = b - by_motion @ np.concatenate([found.velocity, found.gravity])
    R, right = eliminate_points(obs, by_point, rest[:, :, None])
    points = np.linalg.solve(R + 1e-9 * np.eye(3), right[:, :3])[:, :, 0]
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

    def excess(multiplier: float) -> float:
        return float(np.sum((projected / (values + multiplier)) ** 2) - gravity**2)

    low = -values[0] + 1e-12 * max(values[-1], 1e-12)
    high = np.linalg.norm(projected) / gravity + values[-1]
    multiplier = brentq(excess, low, high) if excess(low) > 0 else low
    g = vectors @ (projected / (values + multiplier))
    length = np.linalg.norm(g)
    if length == 0.0:
        raise ValueError("the equations do not see gravity")
    g *= gravity / length
    v = np.linalg.solve(of_v, R[:3, 6] - R[:3, 3:6] @ g)
    return Alignment(v, g)
