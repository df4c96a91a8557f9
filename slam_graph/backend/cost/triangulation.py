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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import Observations, is_in
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.solve.state import FrameMotion, State
from slam_graph.kernels.ray_triangulation import triangulate_rays
from slam_graph.sensors import FeatureFrame, Rig

_LEAST_INVERSE_DEPTH = 1e-2
"""An increment changes an inverse depth by no smaller factor."""
_TINY = 1e-12


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
    count = len(obs.ids)
    starts = obs.starts
    cameras = _world_cameras(obs, rig, rotations, positions)
    weights = rig.pixel_slopes(obs) if rig.wide else np.zeros((0, 2, 2))
    points, depth_error, parallax = np.empty((count, 3)), np.empty(count), np.empty(count)
    triangulate_rays(*cameras, obs.normalized, weights, starts, points, depth_error, parallax)
    residuals, depths = rig.residuals(obs, Geometry(rotations, positions, points))
    errors = residuals[:, 0] ** 2 + residuals[:, 1] ** 2  # a sum over so few columns takes longer
    squares = np.bincount(obs.feature, errors, count)
    good = (
        np.isfinite(points).all(axis=1)
        & (np.minimum.reduceat(depths, starts[:-1]) > config.min_depth_m)
        & (depths[starts[:-1]] < config.max_depth_m)
        & (parallax > max(config.min_parallax_rad, min_parallax_rad))
    )
    return Triangulation(points, good, np.sqrt(squares / (starts[1:] - starts[:-1])), depth_error)


def moved_in_inverse_depth(
    points: FloatArray, increments: FloatArray, before: FloatArray, after: FloatArray
) -> FloatArray:
    """Points (J, 3) moved by increments that are linear in (α, β, ρ), and not in metres.

    Both are the same to first order. The reprojection error of a point with little parallax is
    nearly linear in its inverse depth and far from linear in its depth, so that an increment in
    metres may lead through the camera. What moves the camera and the point alike changes no depth.

    Args:
        points: (J, 3) in the world.
        increments: (J, 3) in metres.
        before: (J, 3) of the cameras whose inverse depth is meant.
        after: (J, 3) the same where the step has moved them.
    """
    rays, increments = points - before, increments - (after - before)
    nearer = -np.add.reduce(increments * rays, axis=1, keepdims=True)
    nearer /= np.maximum(np.add.reduce(rays**2, axis=1, keepdims=True), _TINY)
    across = increments + nearer * rays
    return np.asarray(after + (rays + across) / np.maximum(1.0 + nearer, _LEAST_INVERSE_DEPTH))


def triangulate_frames(
    ids: IntArray,
    frames: Sequence[FeatureFrame],
    rotations: FloatArray,
    positions: FloatArray,
    rig: Rig,
    motions: Mapping[int, FrameMotion] | None = None,
) -> Triangulation:
    """Triangulate features from frames at known poses, with the default thresholds.

    Args:
        ids: (J,) features, in any order, seen or not.
        frames: F of them, in the order of time.
        rotations: (F, 3, 3) world_R_body of the frames.
        positions: (F, 3) of the body in the world.
        rig: the cameras.
        motions: of the body within frames 0, 1, …, for rolling shutters.

    Returns:
        One row for each id; features with fewer than two observations are not good, and their
        point is NaN.
    """
    ascending = np.unique(ids)
    obs = _observations(ascending, frames)
    seen = obs.counts >= 2
    obs = obs.subset(seen)
    points = np.full((len(ascending), 3), np.nan)
    good = np.zeros(len(ascending), np.bool_)
    reprojection_px, depth_error = np.full((2, len(ascending)), np.inf)
    if len(obs):
        projection = RigProjection(rig, motions)
        found = triangulate(obs, projection, rotations, positions, TriangulationConfig())
        points[seen], good[seen] = found.points, found.good
        reprojection_px[seen], depth_error[seen] = found.reprojection_px, found.depth_error
    place = np.searchsorted(ascending, ids)
    return Triangulation(points[place], good[place], reprojection_px[place], depth_error[place])


def seen_by_first_and_another(ids: IntArray, frame: FeatureFrame) -> Observations:
    """Observations in one frame of features that the first camera sees, and another one as well.

    Args:
        ids: ascending; the first camera sees all of them.
        frame: the frame.

    Returns:
        Sorted by feature, and by camera.
    """
    cameras = frame.cameras
    others = np.concatenate([np.zeros(0, np.int64), *(seen.ids for seen in cameras[1:])])
    ids = ids[is_in(ids, np.sort(others))]
    found = np.concatenate([cameras[0].ids, others])
    camera = np.arange(len(cameras)).repeat([len(seen) for seen in cameras])
    order = found.argsort(kind="stable")
    rows = order[is_in(found.take(order), ids)]
    feature = ids.searchsorted(found.take(rows))
    pixels = np.concatenate([seen.pixels for seen in cameras]).take(rows, axis=0)
    normalized = np.concatenate([seen.normalized for seen in cameras]).take(rows, axis=0)
    frames = np.zeros(len(rows), np.int64)
    return Observations(ids, (0,), feature, frames, camera.take(rows), pixels, normalized)


def _observations(ids: IntArray, frames: Sequence[FeatureFrame]) -> Observations:
    """All observations of features (ascending ids) in some frames, in the order of time."""
    views = [
        (frame, camera, seen)
        for frame, of_frame in enumerate(frames)
        for camera, seen in enumerate(of_frame.cameras)
    ]
    sizes = [len(seen) for _, _, seen in views]
    numbers = np.repeat(np.array([view[:2] for view in views]).reshape(-1, 2), sizes, axis=0)
    found = np.concatenate([np.zeros(0, np.int64), *(seen.ids for _, _, seen in views)])
    order = found.argsort(kind="stable")
    rows = order[is_in(found[order], ids)]
    places = (
        np.concatenate([np.zeros((0, 2)), *(seen.pixels for _, _, seen in views)]),
        np.concatenate([np.zeros((0, 2)), *(seen.normalized for _, _, seen in views)]),
    )
    feature, (frame, camera) = ids.searchsorted(found[rows]), numbers[rows].T
    every = tuple(range(len(frames)))
    pixels, normalized = (values.take(rows, axis=0) for values in places)
    return Observations(ids, every, feature, frame, camera, pixels, normalized)


def first_centres(obs: Observations, rig: RigProjection, state: State) -> FloatArray:
    """Positions (J, 3), in the world, of the cameras that observed each of J features first."""
    rotations, positions = rig.when_taken(obs.frames, *state.poses(obs.frames))
    first = obs.starts[:-1]
    frames = obs.frame[first]
    if not rig.rolling:  # few cameras and frames
        centres = positions[:, None] + rig.body_p_camera @ rotations.transpose(0, 2, 1)
        return np.asarray(centres[frames, obs.camera[first]])
    mounted = rig.mounts(obs)[1][first]
    return np.asarray(positions[frames] + np.einsum("jik,jk->ji", rotations[frames], mounted))


def _world_cameras(
    obs: Observations, rig: RigProjection, rotations: FloatArray, positions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotations (N, 3, 3) and positions (N, 3) in the world of the cameras that observed."""
    if not rig.rolling:  # few cameras and frames, many observations
        world_R = rotations[:, None] @ rig.body_R_camera
        world_p = positions[:, None] + (rotations[:, None] @ rig.body_p_camera[:, :, None])[..., 0]
        rows = obs.frame * len(rig.body_R_camera) + obs.camera
        return world_R.reshape(-1, 3, 3).take(rows, axis=0), world_p.reshape(-1, 3).take(rows, 0)
    body_R = rotations[obs.frame]
    body_R_camera, body_p_camera = rig.mounts(obs)
    world_p = positions[obs.frame] + (body_R @ body_p_camera[:, :, None])[:, :, 0]
    return body_R @ body_R_camera, world_p
