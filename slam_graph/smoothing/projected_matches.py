# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Candidate matches of features: the point of one is projected to where another is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend import Geometry, Observations, RigProjection
from slam_graph.smoothing.drift_consensus import drift_jacobian

REACH_PX = 8.0
"""Largest mean offset of a match: how far drift may have moved the projection of a feature."""
_MIN_VIEW_RATIO = 0.6
"""Part of a feature's views in which the other must be projected near it."""
_VIEW_SIGMAS = 3.0
"""Noise of a single view that is allowed beside the mean offset, in σ."""
_CORRELATED = 0.25
"""Least variance of a mean offset relative to that of one view: errors of tracks are correlated."""
_MAX_PROJECTION_SIGMAS = 1.5
"""Projections of larger uncertainty are not used, in σ of the observations."""
_MIN_DEPTH_M = 0.1
"""Points nearer to the camera are not projected."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Features, one for each track, and the poses from which they are seen.

    Attributes:
        seen: observations of J features by the keyframes.
        at: poses of the keyframes, and points of the features.
        usable: (J,) whether the point is well triangulated.
        times_s: (J,) middle of each track in time.
        projection: of the rig.
        sigma_px: standard deviation of the observations.
    """

    seen: Observations
    at: Geometry
    usable: BoolArray
    times_s: FloatArray
    projection: RigProjection
    sigma_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pairs of features that may be the same point; offsets are whitened.

    Attributes:
        earlier, later: (P,) rows of the features.
        offsets: (P, 2) mean offset from the observations of one to the projection of the other.
        by_drift: (P, 2, 4) Jacobians of the offsets by the drift of the earlier feature.
        chances: (P,) probability that a false match has an offset below a standard deviation.
    """

    earlier: IntArray
    later: IntArray
    offsets: FloatArray
    by_drift: FloatArray
    chances: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Matches:
        """Some of the matches."""
        return Matches(
            self.earlier[chosen],
            self.later[chosen],
            self.offsets[chosen],
            self.by_drift[chosen],
            self.chances[chosen],
        )


def projected_matches(scene: Scene, reach_px: float) -> Matches:
    """Pairs of features whose points are projected near the observations of each other.

    Args:
        scene: the features.
        reach_px: largest mean offset.
    """
    seen, count = scene.seen, len(scene.seen.ids)
    order = np.lexsort((seen.camera, seen.frame))
    image = seen.frame * len(scene.projection.cameras) + seen.camera
    starts = np.flatnonzero(np.diff(image[order])) + 1
    around_px = reach_px + _VIEW_SIGMAS * scene.sigma_px
    found = [_around(scene, rows, around_px) for rows in np.split(order, starts)]
    viewed, other, offsets = (np.concatenate(column) for column in zip(*found, strict=True))
    pair, row = np.unique(viewed * count + other, return_inverse=True)
    hits = np.bincount(row, minlength=len(pair))
    sums = [np.bincount(row, offsets[:, i], len(pair)) for i in range(2)]
    means = np.stack(sums, axis=1) / hits[:, None]
    viewed, other = np.divmod(pair, count)
    near = np.linalg.norm(means, axis=1) < reach_px
    near &= hits >= _MIN_VIEW_RATIO * seen.counts[viewed]
    return _whitened(scene, viewed[near], other[near], means[near], reach_px)


def _around(
    scene: Scene, rows: IntArray, around_px: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Features seen in one image (rows of `seen`), others projected near them, and the offsets."""
    seen, at, projection = scene.seen, scene.at, scene.projection
    frame, camera = seen.frame[rows[0]], seen.camera[rows[0]]
    world_R_camera = at.rotations[frame] @ projection.body_R_camera[camera]
    centre = at.positions[frame] + at.rotations[frame] @ projection.body_p_camera[camera]
    points = (at.points - centre) @ world_R_camera
    ahead = scene.usable & (points[:, 2] > _MIN_DEPTH_M)
    ahead[seen.feature[rows]] = False
    others = np.flatnonzero(ahead)
    normalized = points[others, :2] / points[others, 2:]
    # a distortion model is valid as far from the axis as features are seen
    inside = np.sum(normalized**2, axis=1) < np.max(np.sum(seen.normalized[rows] ** 2, axis=1))
    others, pixels = others[inside], projection.cameras[camera].distort(normalized[inside])[0]
    rows = rows[scene.usable[seen.feature[rows]]]
    # balancing the trees does not pay off for a single search
    seen_at, projected_to = (
        cKDTree(places, compact_nodes=False, balanced_tree=False)
        for places in (seen.pixels[rows], pixels)
    )
    near = seen_at.sparse_distance_matrix(projected_to, around_px, output_type="ndarray")
    rows, hit = rows[near["i"]], near["j"]
    return seen.feature[rows], others[hit], pixels[hit] - seen.pixels[rows]


def _whitened(
    scene: Scene, viewed: IntArray, other: IntArray, offsets_px: FloatArray, reach_px: float
) -> Matches:
    """Whitened matches, each pair once: with the projection of smaller uncertainty."""
    seen, at, projection = scene.seen, scene.at, scene.projection
    middle = np.searchsorted(seen.feature, viewed) + seen.counts[viewed] // 2
    views = replace(seen.rows(middle), feature=other)
    by_point = projection.jacobians(views, at)[1]
    S = by_point @ _covariances(scene)[other] @ by_point.transpose(0, 2, 1)
    S += (_CORRELATED + 1.0 / seen.counts[viewed])[:, None, None] * np.eye(2)
    S *= scene.sigma_px**2
    whitening = np.linalg.inv(np.linalg.cholesky(S))
    J = drift_jacobian(by_point, at.points[other] - at.positions[views.frame])
    forward = scene.times_s[other] < scene.times_s[viewed]
    J[~forward] *= -1.0
    earlier, later = np.where(forward, (other, viewed), (viewed, other))
    area = np.sqrt(np.linalg.det(S))
    offsets = (whitening @ offsets_px[:, :, None])[:, :, 0]
    order = np.lexsort((area, later, earlier))
    best = order[np.diff(earlier[order] * len(seen.ids) + later[order], prepend=-1) != 0]
    certain = (
        np.linalg.norm(S[best], ord=2, axis=(1, 2)) < (_MAX_PROJECTION_SIGMAS * scene.sigma_px) ** 2
    )
    return Matches(earlier, later, offsets, whitening @ J, area / reach_px**2).select(best[certain])


def _covariances(scene: Scene) -> FloatArray:
    """(J, 3, 3) covariances of the usable points, for observations with a noise of 1 px."""
    by_point = scene.projection.jacobians(scene.seen, scene.at)[1]
    starts = np.searchsorted(scene.seen.feature, np.arange(len(scene.seen.ids)))
    information = np.add.reduceat(by_point.transpose(0, 2, 1) @ by_point, starts)
    information[~scene.usable] = np.eye(3)  # these may be undefined
    return np.asarray(np.linalg.pinv(information, hermitian=True))
