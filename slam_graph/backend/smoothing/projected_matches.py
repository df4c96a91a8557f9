# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matches of features between two visits of a place: by projection, then RANSAC over the drift.

RANSAC over the relative drift between two visits of a place, given uncertain feature matches. A
visual-inertial estimate drifts in four degrees of freedom, position and yaw (Kelly & Sukhatme 2011;
gravity determines roll and pitch). So all true matches between two short visits are offset by the
same four numbers, and false ones by anything. The offset of a match is linear in these,

    offset ≈ J [shift; yaw],

and the largest consistent set is found by RANSAC over pairs of matches.

Candidate matches of features: the point of one is projected to where another is seen, and is as far
away. Where many points are projected into one image some are near any observation; few of them have
its depth, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import bdtrc

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import MEDIAN_1D
from slam_graph.kernels.feature_matches import drift_consensus, mixture_probabilities
from slam_graph.kernels.near_pairs import near_pairs
from slam_graph.kernels.projection import points_ahead

_DRIFT_SIGMAS = np.array([0.1, 0.1, 0.1, 0.02])
"""Standard deviation of the drift between visits, a weak prior: shift (m) and yaw (rad)."""
_MAX_FALSE_ALARMS = 0.01
_SAMPLES = 100
_REFINEMENTS = 3
_EM_STEPS = 30


def drift_jacobian(by_point: FloatArray, arms: FloatArray) -> FloatArray:
    """(P, m, 4) Jacobians of offsets by a shift and yaw of the points.

    Args:
        by_point: (P, m, 3) Jacobians of the offsets by the points in the world.
        arms: (P, 3) from the centre of rotation to the points, in the world.
    """
    turned = np.stack([-arms[:, 1], arms[:, 0], np.zeros(len(arms))], axis=1)
    return np.concatenate([by_point, by_point @ turned[:, :, None]], axis=2)


def consistent_matches(
    J: FloatArray,
    offsets: FloatArray,
    limit: float,
    chance: float,
    tests: int,
    rng: np.random.Generator,
) -> tuple[BoolArray, FloatArray]:
    """Matches that are consistent with one drift, or with none, if they are more than by chance.

    The expected number of equally large consistent sets among false matches (the number of false
    alarms) must be small (a contrario: Moisan & Stival 2004).

    Args:
        J: (P, m, 4) Jacobians of the offsets by the drift.
        offsets: (P, m) in standard deviations.
        limit: largest residual of a consistent match, in standard deviations.
        chance: probability that a false match has an offset shorter than a standard deviation.
        tests: number of sets of matches that are tested.
        rng: draws the samples.

    Returns:
        consistent: (P,) all false if the set may be chance.
        residuals: (P, m) offsets after removal of the drift.
    """
    count, chance = len(offsets), min(limit**2 * chance, 1.0)
    undrifted = np.linalg.norm(offsets, axis=1) < limit
    alarms = tests * bdtrc(np.sum(undrifted) - 1, count, chance)
    consistent, residuals = _largest_set(J, offsets, limit, rng)
    if alarms < _MAX_FALSE_ALARMS and np.sum(undrifted) >= np.sum(consistent):
        return undrifted, offsets
    # two matches were sampled to fit
    drifted = tests * math.comb(count, 2) * bdtrc(np.sum(consistent) - 3, count - 2, chance)
    if drifted < _MAX_FALSE_ALARMS:
        return consistent, residuals
    return undrifted & (alarms < _MAX_FALSE_ALARMS), offsets


def _largest_set(
    J: FloatArray, offsets: FloatArray, limit: float, rng: np.random.Generator
) -> tuple[BoolArray, FloatArray]:
    """The largest set (P,) consistent with one drift, and what is left (P, m) of all offsets."""
    if len(J) < 2:  # which any drift would fit
        return np.zeros(len(J), np.bool_), offsets
    residuals = np.empty(offsets.shape)
    consistent = drift_consensus(
        np.ascontiguousarray(J),
        np.ascontiguousarray(offsets),
        _pairs(len(J), rng),
        _DRIFT_SIGMAS**-2.0,
        limit,
        _REFINEMENTS,
        residuals,
    )
    return consistent, residuals


def _pairs(count: int, rng: np.random.Generator) -> IntArray:
    """(S, 2) random pairs of two out of `count` matches."""
    first = rng.integers(count, size=_SAMPLES)
    return np.stack([first, (first + rng.integers(1, count, _SAMPLES)) % count], axis=1)


def match_probabilities(residuals: FloatArray, chances: FloatArray) -> FloatArray:
    """Probability of each match of a set to be true, by expectation maximisation.

    Residuals of true matches are normal with unit covariance. Those of false ones are uniform in
    the image, and their depths scatter more widely. The share of true matches and the scatter of
    the depths of false ones are found from the set itself: where most matches are false, one must
    be closer to be believed.

    Args:
        residuals: (P, 2 or 3) in standard deviations: in the image, and of the inverse depth.
        chances: (P,) probability that a false match has an offset in the image below a standard
            deviation.
    """
    squares = np.sum(residuals[:, :2] ** 2, axis=1)
    depths = np.abs(residuals[:, 2]) if residuals.shape[1] > 2 else np.zeros(len(residuals))
    order = np.argsort(depths, kind="stable")
    probabilities = np.empty(len(residuals))
    probabilities[order] = mixture_probabilities(
        squares[order], depths[order], chances[order], MEDIAN_1D, _EM_STEPS
    )
    return probabilities


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
_IMAGES = 64
"""So many images of a camera are taken at once: more of them take memory, and no less time."""
_MIN_DEPTH_M = 0.1
"""Points nearer to the camera are not projected."""
_STRETCH = 4.0
"""Normalised points are at most so many times as far apart as pixels at the axis would say."""


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
        offsets: (P, 3) mean offset from the observations of one to the projection of the other, and
            that of the inverse depths.
        by_drift: (P, 3, 4) Jacobians of the offsets by the drift of the earlier feature.
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
    around_px = reach_px + _VIEW_SIGMAS * scene.sigma_px
    block = seen.frame // _IMAGES * len(scene.projection.cameras) + seen.camera
    order = np.lexsort((seen.frame, block))
    starts = np.flatnonzero(np.diff(block[order])) + 1
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
    """Features in some images of a camera, others projected near them, and the offsets.

    Args:
        scene: the features.
        rows: of `seen`, all of one camera, sorted by frame.
        around_px: how near.
    """
    seen = scene.seen
    starts = np.flatnonzero(np.diff(seen.frame[rows], prepend=-1))
    others, pixels = _projected(scene, rows, starts, around_px)
    other, stops = np.concatenate(others), np.cumsum([0, *map(len, others)])
    feature, usable = seen.feature[rows], scene.usable[seen.feature[rows]]
    own_pixels = seen.pixels[rows[usable]]
    begins = np.append(0, np.cumsum(usable))[np.append(starts, len(rows))]
    pairs = []
    for k in range(len(starts)):
        own, projected = slice(*begins[k : k + 2]), slice(*stops[k : k + 2])
        near = near_pairs(own_pixels[own], pixels[projected], around_px)
        pairs.append(near + np.array([begins[k], stops[k]]))
    near, hit = np.concatenate(pairs).T
    return feature[usable][near], other[hit], pixels[hit] - own_pixels[near]


def _projected(
    scene: Scene, rows: IntArray, starts: IntArray, around_px: float
) -> tuple[list[IntArray], FloatArray]:
    """Features that each image of a camera may see but does not, and the pixels of all of them.

    Args:
        scene: the features.
        rows: of `seen`, all of one camera, sorted by frame.
        starts: where those of each image begin.
        around_px: how far from what an image sees they may be.
    """
    seen, at, projection = scene.seen, scene.at, scene.projection
    camera, frames = seen.camera[rows[0]], seen.frame[rows[starts]]
    lens = projection.cameras[camera]
    R = at.rotations[frames] @ projection.body_R_camera[camera]
    centres = at.positions[frames] + at.rotations[frames] @ projection.body_p_camera[camera]
    # a distortion model is valid as far from the axis as features are seen
    places = seen.normalized[rows]
    squares = np.maximum.reduceat(np.sum(places**2, axis=1), starts).tolist()
    wide = math.inf if lens.model.sees_sideways else _STRETCH * around_px / min(lens.fx, lens.fy)
    least, most = np.minimum.reduceat(places, starts), np.maximum.reduceat(places, starts)
    bounds = np.stack([least - wide, most + wide], axis=1)
    used, others, normalized = scene.usable.copy(), [], []
    numbers, ahead = np.empty(len(used), np.int64), np.empty((len(used), 2))
    for k, own in enumerate(np.split(seen.feature[rows], starts[1:])):
        used[own] = False
        where = R[k], centres[k], _MIN_DEPTH_M, squares[k], bounds[k]
        count = points_ahead(at.points, used, *where, numbers, ahead)
        used[own] = scene.usable[own]
        others.append(numbers[:count].copy())
        normalized.append(ahead[:count].copy())
    return others, lens.pixels(np.concatenate(normalized))


def _whitened(
    scene: Scene, viewed: IntArray, other: IntArray, offsets_px: FloatArray, reach_px: float
) -> Matches:
    """Whitened matches, each pair once: with the projection of smaller uncertainty."""
    seen, at, projection = scene.seen, scene.at, scene.projection
    middle = np.searchsorted(seen.feature, viewed) + seen.counts[viewed] // 2
    views = replace(seen.rows(middle), feature=other)
    covariances = _covariances(scene)
    own, of_own = _inverse_depths(scene, views, viewed)
    inverse, of_inverse = _inverse_depths(scene, views, other)
    by_point = np.concatenate([projection.jacobians(views, at)[1], of_inverse], axis=1)
    S = by_point @ covariances[other] @ by_point.transpose(0, 2, 1)
    S[:, :2, :2] += (_CORRELATED + 1.0 / seen.counts[viewed])[:, None, None] * np.eye(2)
    S[:, 2:, 2:] += of_own @ covariances[viewed] @ of_own.transpose(0, 2, 1)
    S *= scene.sigma_px**2
    whitening = np.linalg.inv(np.linalg.cholesky(S))
    J = drift_jacobian(by_point, at.points[other] - at.positions[views.frame])
    forward = scene.times_s[other] < scene.times_s[viewed]
    J[~forward] *= -1.0
    earlier, later = np.where(forward, (other, viewed), (viewed, other))
    area = np.sqrt(np.linalg.det(S[:, :2, :2]))
    offsets = np.column_stack([offsets_px, inverse - own])
    offsets = (whitening @ offsets[:, :, None])[:, :, 0]
    order = np.lexsort((area, later, earlier))
    best = order[np.diff(earlier[order] * len(seen.ids) + later[order], prepend=-1) != 0]
    pixels = np.linalg.norm(S[best, :2, :2], ord=2, axis=(1, 2))
    certain = pixels < (_MAX_PROJECTION_SIGMAS * scene.sigma_px) ** 2
    return Matches(earlier, later, offsets, whitening @ J, area / reach_px**2).select(best[certain])


def _inverse_depths(
    scene: Scene, views: Observations, feature: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Inverse depths (P,) of features in some images, and (P, 1, 3) Jacobians by their points."""
    at, projection = scene.at, scene.projection
    frame, camera = views.frame, views.camera
    R = at.rotations[frame]
    centre = at.positions[frame] + (R @ projection.body_p_camera[camera][:, :, None])[:, :, 0]
    axis = (R @ projection.body_R_camera[camera])[:, :, 2]
    inverse = 1.0 / np.sum(axis * (at.points[feature] - centre), axis=1)
    return inverse, (-(inverse**2)[:, None] * axis)[:, None, :]


def _covariances(scene: Scene) -> FloatArray:
    """(J, 3, 3) covariances of the usable points, for observations with a noise of 1 px."""
    by_point = scene.projection.jacobians(scene.seen, scene.at)[1]
    starts = np.searchsorted(scene.seen.feature, np.arange(len(scene.seen.ids)))
    information = np.add.reduceat(by_point.transpose(0, 2, 1) @ by_point, starts)
    information[~scene.usable] = np.eye(3)  # these may be undefined
    return np.asarray(np.linalg.pinv(information, hermitian=True))
