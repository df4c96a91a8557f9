# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Triangulation of many features at once: linear, then Gauss-Newton, then checks.

The linear solution is the point nearest to all rays. It is refined in the inverse-depth
parametrisation (α, β, ρ) of the feature's first camera (Montiel, Civera & Davison 2006), in which
the reprojection error is nearly linear also for far points. Errors are those on the plane z = 1;
with wide lenses they are weighted by the derivative of the camera model, since the noise of a pixel
is not the same everywhere on that plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.sensors import FeatureFrame, Rig

STEPS = 5
"""Damped Gauss-Newton steps that refine the linear solution, at most."""
_REGULARISATION = 1e-9
"""Added to diagonals, so that features without parallax have a solution too (which is refused)."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangulation:
    """Positions of features and whether they are accepted.

    Attributes:
        points: (J, 3) in the world.
        good: (J,) whether all checks passed: in front of every camera that observed it, neither too
            near nor too far, and with enough parallax.
        reprojection_px: (J,) root mean square reprojection error.
        depth_error: (J,) relative standard deviation of the inverse depth, for known poses and a
            standard deviation of 1 of the observations in normalised coordinates, or of the first
            camera's focal length in pixels if a lens is wide.
    """

    points: FloatArray
    good: BoolArray
    reprojection_px: FloatArray
    depth_error: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Camera poses and bearings of all observations, relative to each feature's first camera."""

    anchor: IntArray  # (J,) row of the first observation of each feature
    world_R_camera: FloatArray  # (N, 3, 3)
    world_p_camera: FloatArray  # (N, 3)
    R: FloatArray  # (N, 3, 3) camera_R_anchor
    t: FloatArray  # (N, 3) position of the anchor in the camera
    weights: FloatArray | None  # (N, 2, 2) of errors on the plane z = 1; None for narrow lenses


def triangulate(
    obs: Observations,
    rig: RigProjection,
    rotations: FloatArray,
    positions: FloatArray,
    config: TriangulationConfig,
    min_parallax_rad: float = 0.0,
) -> Triangulation:
    """Triangulate every feature of `obs` from known poses.

    Args:
        obs: at least two observations of each feature.
        rig: mounting of the cameras.
        rotations: (F, 3, 3) world_R_body of the frames of `obs`.
        positions: (F, 3) of the body in the world.
        config: thresholds.
        min_parallax_rad: smallest accepted angle between two rays; the one in `config` if that is
            larger.
    """
    rays = _rays(obs, rig, rotations, positions)
    points = _nearest_to_rays(obs, rays)
    points, depth_error = _refine(obs, rays, points)
    residuals, depths = rig.residuals(obs, Geometry(rotations, positions, points))
    count = np.maximum(obs.counts, 1)
    squares = np.bincount(obs.feature, np.sum(residuals**2, axis=1), len(obs.ids))
    nearest = np.full(len(obs.ids), np.inf)
    np.minimum.at(nearest, obs.feature, depths)
    anchor_depth = depths[rays.anchor]
    parallax = _parallax(obs, rays, points)
    good = (
        np.all(np.isfinite(points), axis=1)
        & (nearest > config.min_depth_m)
        & (anchor_depth < config.max_depth_m)
        & (parallax > max(config.min_parallax_rad, min_parallax_rad))
    )
    return Triangulation(points, good, np.sqrt(squares / count), depth_error)


def triangulate_frames(
    ids: IntArray,
    frames: Sequence[FeatureFrame],
    rotations: FloatArray,
    positions: FloatArray,
    rig: Rig,
) -> Triangulation:
    """Triangulate features from frames at known poses, with the default thresholds.

    Args:
        ids: (J,) features, in any order, seen or not.
        frames: F of them, in the order of time.
        rotations: (F, 3, 3) world_R_body of the frames.
        positions: (F, 3) of the body in the world.
        rig: the cameras.

    Returns:
        One row for each id; features with fewer than two observations are not good, and their
        point is NaN.
    """
    window = FeatureTracks()
    for index, frame in enumerate(frames):
        window.add(index, frame)
    ascending = np.unique(ids)
    obs = window.observations(ascending)
    seen = obs.counts >= 2
    obs = obs.subset(seen)
    points = np.full((len(ascending), 3), np.nan)
    good = np.zeros(len(ascending), np.bool_)
    reprojection_px, depth_error = np.full((2, len(ascending)), np.inf)
    if len(obs):
        used = list(obs.frames)
        found = triangulate(
            obs, RigProjection(rig), rotations[used], positions[used], TriangulationConfig()
        )
        points[seen], good[seen] = found.points, found.good
        reprojection_px[seen], depth_error[seen] = found.reprojection_px, found.depth_error
    place = np.searchsorted(ascending, ids)
    return Triangulation(points[place], good[place], reprojection_px[place], depth_error[place])


def _rays(
    obs: Observations, rig: RigProjection, rotations: FloatArray, positions: FloatArray
) -> _Rays:
    anchor = np.searchsorted(obs.feature, np.arange(len(obs.ids)))
    body_R = rotations[obs.frame]
    body_R_camera, body_p_camera = rig.mounts(obs)
    world_R = body_R @ body_R_camera
    world_p = positions[obs.frame] + np.einsum("nij,nj->ni", body_R, body_p_camera)
    home = anchor[obs.feature]
    camera_R_world = world_R.transpose(0, 2, 1)
    return _Rays(
        anchor,
        world_R,
        world_p,
        camera_R_world @ world_R[home],
        np.einsum("nij,nj->ni", camera_R_world, world_p[home] - world_p),
        rig.pixel_slopes(obs) if rig.wide else None,
    )


def _nearest_to_rays(obs: Observations, rays: _Rays) -> FloatArray:
    """Points (J, 3) with the least sum of squared distances to their rays."""
    bearings = np.concatenate([obs.normalized, np.ones((len(obs), 1))], axis=1)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    b = np.einsum("nij,nj->ni", rays.world_R_camera, bearings)
    home = rays.world_p_camera[rays.anchor]
    offset = rays.world_p_camera - home[obs.feature]
    A = np.eye(3) - b[:, :, None] * b[:, None, :]
    starts = rays.anchor
    lhs = np.add.reduceat(A, starts) + _REGULARISATION * np.eye(3)
    rhs = np.add.reduceat(np.einsum("nij,nj->ni", A, offset), starts)
    return home + np.linalg.solve(lhs, rhs[:, :, None])[:, :, 0]


def _refine(obs: Observations, rays: _Rays, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton on the normalised reprojection error in inverse depth of the first camera.

    Returns:
        points: (J, 3) in the world.
        depth_error: (J,) see `Triangulation`.
    """
    home_R, home_p = rays.world_R_camera[rays.anchor], rays.world_p_camera[rays.anchor]
    local = np.einsum("nji,nj->ni", home_R, points - home_p)
    z = np.where(np.abs(local[:, 2]) > 1e-3, local[:, 2], 1e-3)
    z = np.where(z < 0, 1e3, z)  # behind the camera: a distant point and noise
    start = np.stack([local[:, 0] / z, local[:, 1] / z, 1.0 / z], axis=1)
    behind = local[:, 2] <= 1e-3
    start[behind, :2] = obs.normalized[rays.anchor][behind]
    x, damping = start, np.full(len(points), 1e-3)
    error, lhs, rhs = _normal_equations(obs, rays, x)
    for _ in range(STEPS):
        diagonal = np.einsum("jii->ji", lhs) * damping[:, None] + _REGULARISATION
        step = np.linalg.solve(lhs + diagonal[:, :, None] * np.eye(3), rhs[:, :, None])[:, :, 0]
        trial = x + step
        trial[:, 2] = np.maximum(trial[:, 2], 1e-6)
        trial_error, trial_lhs, trial_rhs = _normal_equations(obs, rays, trial)
        better = trial_error < error
        x = np.where(better[:, None], trial, x)
        lhs = np.where(better[:, None, None], trial_lhs, lhs)
        rhs = np.where(better[:, None], trial_rhs, rhs)
        error = np.where(better, trial_error, error)
        damping = np.where(better, damping * 0.1, damping * 10.0)
        if np.max(np.abs(step), initial=0.0) < 1e-7:
            break
    local = np.concatenate([x[:, :2], np.ones((len(x), 1))], axis=1) / x[:, 2:]
    points = home_p + np.einsum("nij,nj->ni", home_R, local)
    variance = np.linalg.inv(lhs + _REGULARISATION * np.eye(3))[:, 2, 2]
    return points, np.sqrt(variance) / x[:, 2]


def _normal_equations(
    obs: Observations, rays: _Rays, x: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Squared error (J,), JᵀJ (J, 3, 3) and Jᵀr (J, 3) at inverse depths x (J, 3)."""
    starts = rays.anchor
    xi = x[obs.feature]
    direction = np.concatenate([xi[:, :2], np.ones((len(xi), 1))], axis=1)
    p = np.einsum("nij,nj->ni", rays.R, direction) + xi[:, 2:] * rays.t
    z = np.maximum(p[:, 2:], 1e-3)
    m = p[:, :2] / z
    r = obs.normalized - m
    by_x = np.concatenate([rays.R[:, :, :2], rays.t[:, :, None]], axis=2)
    J = (by_x[:, :2, :] - m[:, :, None] * by_x[:, 2:, :]) / z[:, :, None]
    if rays.weights is not None:
        J, r = rays.weights @ J, np.einsum("nij,nj->ni", rays.weights, r)
    lhs = np.add.reduceat(J.transpose(0, 2, 1) @ J, starts)
    rhs = np.add.reduceat(np.einsum("nij,ni->nj", J, r), starts)
    return np.add.reduceat(np.sum(r * r, axis=1), starts), lhs, rhs


def _parallax(obs: Observations, rays: _Rays, points: FloatArray) -> FloatArray:
    """Largest angle (J,) in rad between the first ray to each feature and any other."""
    toward = points[obs.feature] - rays.world_p_camera
    toward /= np.linalg.norm(toward, axis=1, keepdims=True) + 1e-12
    cosine = np.sum(toward * toward[rays.anchor][obs.feature], axis=1)
    smallest = np.ones(len(obs.ids))
    np.minimum.at(smallest, obs.feature, cosine)
    return np.arccos(np.clip(smallest, -1.0, 1.0))
