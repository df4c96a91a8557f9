# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Building a map from the keyframes of a run: observations become features with world points.

A feature is a track, or several that loop closures have matched. Its point is the mean of the
points that its keyframes have triangulated, weighted by the inverse squared distance.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.loop_closure import Keyframe, Loop, LoopClosureConfig, Vocabulary
from slam_graph.maps.map_model import (
    NO_FEATURE,
    Links,
    MapRecording,
    SlamMap,
    majority_descriptors,
)
from slam_graph.pose_graph import Poses
from slam_graph.sensors import Rig
from slam_graph.version import __version__


def build_map(
    keyframes: list[Keyframe],
    poses: Poses,
    recording: MapRecording,
    loops: list[Loop],
    config: LoopClosureConfig,
    seed: int = 0,
) -> SlamMap:
    """The map of one recording.

    Args:
        keyframes: K, at least one, in the order of time.
        poses: K best estimates world_T_body.
        recording: the recording.
        loops: accepted loop closures, whose matches become one feature.
        config: size of the vocabulary, largest reprojection error of an observation, and whether
            the z axis of the world is up (4 degrees of freedom).
        seed: of the training.
    """
    offsets = np.cumsum([0, *(len(k.descriptors) for k in keyframes)])
    features = _track_features(keyframes, loops, offsets)
    empty = np.zeros((0, 3))
    whole = SlamMap(
        (recording,),
        datetime.now(UTC).isoformat(timespec="seconds"),
        __version__,
        config.degrees_of_freedom == 4,
        np.zeros(len(keyframes), np.int64),
        np.array([k.stamp_ns for k in keyframes], np.int64),
        poses,
        empty,
        keyframes[0].descriptors[:0],
        offsets.astype(np.int64),
        features,
        np.concatenate([k.normalized for k in keyframes]),
        np.concatenate([k.descriptors for k in keyframes]),
        links_of(loops),
        Vocabulary.train(
            [k.descriptors for k in keyframes], config.places.words, np.random.default_rng(seed)
        ),
    )
    body_points = np.concatenate([k.points for k in keyframes])
    return with_points(whole, features, body_points, config.verification.max_error_px)


def links_of(loops: list[Loop]) -> Links:
    """Loop closures as links."""
    if not loops:
        return Links.none()
    matrices = np.array([loop.first_T_second.matrix() for loop in loops])
    return Links(
        np.array([(loop.first, loop.second) for loop in loops], np.int64),
        Poses(matrices[:, :3, :3], matrices[:, :3, 3]),
        np.array([loop.covariance for loop in loops]),
    )


def with_points(
    whole: SlamMap, features: IntArray, body_points: FloatArray, max_error_px: float
) -> SlamMap:
    """The map with its points computed anew from those of each observation.

    Observations with a larger reprojection error lose their feature, and features without
    observations or points are removed.

    Args:
        whole: the map, with its observations and poses.
        features: (N,) feature of each observation, -1 for none.
        body_points: (N, 3) its point in the body frame; NaN where not triangulated.
        max_error_px: largest reprojection error of an observation.
    """
    features = features.copy()
    points = _world_points(whole, features, body_points)
    features[~_is_inlier(whole, features, points, max_error_px)] = NO_FEATURE
    used, compact = np.unique(features, return_inverse=True)
    first = int(np.searchsorted(used, 0))
    features, points = compact.reshape(-1) - first, points[used[first:]]
    descriptors = majority_descriptors(whole.descriptors, features, len(points))
    return replace(whole, features=features, points=points, feature_descriptors=descriptors)


def merged_groups(count: int, pairs: IntArray) -> IntArray:
    """(count,) connected component of each of some items, of which pairs (M, 2) are the same."""
    links = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _track_features(keyframes: list[Keyframe], loops: list[Loop], offsets: IntArray) -> IntArray:
    """(N,) number of the feature of each observation: its track, and those matched with it."""
    ids = np.concatenate([k.ids for k in keyframes])
    tracked = ids >= 0
    _, track = np.unique(ids, return_inverse=True)
    # a corner without a track is a feature of its own, which a loop may merge with others
    track = np.where(tracked, track.reshape(-1), track.max(initial=0) + 1 + np.arange(len(ids)))
    rows = [offsets[[loop.first, loop.second]] + loop.pairs for loop in loops]
    pairs = track[np.concatenate([np.zeros((0, 2), np.int64), *rows])]
    return merged_groups(int(track.max(initial=-1)) + 1, pairs)[track]


def _world_points(whole: SlamMap, features: IntArray, body_points: FloatArray) -> FloatArray:
    """(P, 3) world points of features 0 to P - 1; NaN where no observation has a point."""
    count = int(features.max(initial=-1)) + 1
    known = np.flatnonzero((features >= 0) & np.isfinite(body_points).all(axis=1))
    at, local = whole.keyframe_of[known], body_points[known]
    world = np.einsum("nij,nj->ni", whole.poses.rotations[at], local)
    world += whole.poses.translations[at]
    weights = 1.0 / np.maximum(np.sum(local**2, axis=1), 1e-6)
    total = np.bincount(features[known], weights, count)
    sums = [np.bincount(features[known], weights * axis, count) for axis in world.T]
    return np.asarray(np.column_stack(sums) / np.where(total > 0, total, np.nan)[:, None])


def _is_inlier(
    whole: SlamMap, features: IntArray, points: FloatArray, max_error_px: float
) -> BoolArray:
    """(N,) whether the reprojection error of each observation is small."""
    inlier = np.zeros(len(features), np.bool_)
    for number, recording in enumerate(whole.recordings):
        rows = np.flatnonzero((features >= 0) & (whole.recording_of[whole.keyframe_of] == number))
        at = whole.keyframe_of[rows]
        body = points[features[rows]] - whole.poses.translations[at]
        body = np.einsum("nji,nj->ni", whole.poses.rotations[at], body)
        ahead, seen = _projected(recording.rig, body)
        off = np.linalg.norm(seen - whole.normalized[rows], axis=1)
        camera = recording.rig.cameras[0].camera
        inlier[rows] = ahead & (off * np.sqrt(camera.fx * camera.fy) < max_error_px)
    return inlier


def _projected(rig: Rig, body: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Which points (N, 3) of the body are ahead of the first camera, and their projections."""
    mount = rig.cameras[0].body_T_camera
    local = (body - mount.translation()) @ mount.rotation().matrix()
    ahead = local[:, 2] > 0
    return ahead, local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
