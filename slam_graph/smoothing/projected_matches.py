# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matches of features by where they are: one is projected to where another is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.smoothing.drift_consensus import by_drift

LEAST_SHARE = 0.6
"""Share of a feature's views in which the other must be projected to where it is seen."""
VIEW_SIGMAS = 3.0
"""Noise of a single view that is allowed for beside the mean offset, in σ."""
CORRELATED = 0.25
"""Variance of the mean offset of any number of views, over that of one: errors of tracks last."""
KNOWN_SIGMAS = 1.5
"""Projections that are known worse than this tell nothing."""
NEAREST_M = 0.1
"""Depth from which points are projected."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Features, each by its own track, and the poses that saw them.

    Attributes:
        seen: by the keyframes, J features.
        at: poses of these, and the points of the features.
        usable: (J,) which points can be trusted.
        times_s: (J,) in the middle of each track.
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
    """Pairs of features that may be one point, in units of what they may be off by noise.

    Attributes:
        earlier, later: (P,) rows of the features.
        offsets: (P, 2) from where one is seen to the projection of the other, in the mean.
        by_drift: (P, 2, 4) derivatives of these by the drift of the earlier one.
        chances: (P,) probability that a wrong match is off by less than a standard deviation.
    """

    earlier: IntArray
    later: IntArray
    offsets: FloatArray
    by_drift: FloatArray
    chances: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Matches:
        """Some of them."""
        return Matches(
            self.earlier[chosen],
            self.later[chosen],
            self.offsets[chosen],
            self.by_drift[chosen],
            self.chances[chosen],
        )


def projected_matches(scene: Scene, reach_px: float) -> Matches:
    """Features that are projected to where others are seen, and these to where they are.

    Args:
        scene: the features.
        reach_px: how far drift may have moved a projection.
    """
    seen, count = scene.seen, len(scene.seen.ids)
    order = np.lexsort((seen.camera, seen.frame))
    image = seen.frame * len(scene.projection.cameras) + seen.camera
    starts = np.flatnonzero(np.diff(image[order])) + 1
    around_px = reach_px + VIEW_SIGMAS * scene.sigma_px
    found = [_around(scene, rows, around_px) for rows in np.split(order, starts)]
    viewed, other, offsets = (np.concatenate(column) for column in zip(*found, strict=True))
    pair, row = np.unique(viewed * count + other, return_inverse=True)
    hits = np.bincount(row, minlength=len(pair))
    sums = [np.bincount(row, offsets[:, i], len(pair)) for i in range(2)]
    means = np.stack(sums, axis=1) / hits[:, None]
    viewed, other = np.divmod(pair, count)
    near = np.linalg.norm(means, axis=1) < reach_px
    near &= hits >= LEAST_SHARE * seen.counts[viewed]
    return _whitened(scene, viewed[near], other[near], means[near], reach_px)


def _around(
    scene: Scene, rows: IntArray, around_px: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Features of one image (rows of `seen`), others projected near, and the ways to these."""
    seen, at, projection = scene.seen, scene.at, scene.projection
    frame, camera = seen.frame[rows[0]], seen.camera[rows[0]]
    world_R_camera = at.rotations[frame] @ projection.body_R_camera[camera]
    centre = at.positions[frame] + at.rotations[frame] @ projection.body_p_camera[camera]
    points = (at.points - centre) @ world_R_camera
    ahead = scene.usable & (points[:, 2] > NEAREST_M)
    ahead[seen.feature[rows]] = False
    others = np.flatnonzero(ahead)
    normalized = points[others, :2] / points[others, 2:]
    # a distortion model holds as far out as features are seen
    inside = np.sum(normalized**2, axis=1) < np.max(np.sum(seen.normalized[rows] ** 2, axis=1))
    others, pixels = others[inside], projection.cameras[camera].distort(normalized[inside])[0]
    rows = rows[scene.usable[seen.feature[rows]]]
    # a single search does not pay for the best of trees
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
    """Matches of projections, each pair once: as the better known one of the two is projected."""
    seen, at, projection = scene.seen, scene.at, scene.projection
    middle = np.searchsorted(seen.feature, viewed) + seen.counts[viewed] // 2
    views = replace(seen.rows(middle), feature=other)
    by_point = projection.jacobians(views, at)[1]
    S = by_point @ _covariances(scene)[other] @ by_point.transpose(0, 2, 1)
    S += (CORRELATED + 1.0 / seen.counts[viewed])[:, None, None] * np.eye(2)
    S *= scene.sigma_px**2
    whitening = np.linalg.inv(np.linalg.cholesky(S))
    J = by_drift(by_point, at.points[other] - at.positions[views.frame])
    forward = scene.times_s[other] < scene.times_s[viewed]
    J[~forward] *= -1.0
    earlier, later = np.where(forward, (other, viewed), (viewed, other))
    area = np.sqrt(np.linalg.det(S))
    offsets = (whitening @ offsets_px[:, :, None])[:, :, 0]
    order = np.lexsort((area, later, earlier))
    best = order[np.diff(earlier[order] * len(seen.ids) + later[order], prepend=-1) != 0]
    known = np.linalg.norm(S[best], ord=2, axis=(1, 2)) < (KNOWN_SIGMAS * scene.sigma_px) ** 2
    return Matches(earlier, later, offsets, whitening @ J, area / reach_px**2).select(best[known])


def _covariances(scene: Scene) -> FloatArray:
    """Of the usable points (J, 3, 3), for observations with a standard deviation of one pixel."""
    by_point = scene.projection.jacobians(scene.seen, scene.at)[1]
    starts = np.searchsorted(scene.seen.feature, np.arange(len(scene.seen.ids)))
    information = np.add.reduceat(by_point.transpose(0, 2, 1) @ by_point, starts)
    information[~scene.usable] = np.eye(3)  # these may be nowhere
    return np.asarray(np.linalg.pinv(information, hermitian=True))
