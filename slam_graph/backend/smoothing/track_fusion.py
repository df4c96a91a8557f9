# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fusion of tracks of the same point, before the bundle adjustment of a segment.

A front end gives a point a new identity each time its track starts again, after a loss or when the
platform returns. Where the point of one track is projected near the observations of another, the
two may be the same. Descriptors are not used, so the poses must be accurate to a few pixels. Tracks
that follow each other closely must match up to noise; tracks of an earlier visit must match up to a
drift that is common to the features of that visit (`projected_matches.py`). Features that are seen
in the same frame are different points.

Fusion alternates with a loose bundle adjustment of every second keyframe: fused features reduce the
drift of the poses, and with better poses more features are found to be the same. Each round starts
from the original tracks, so that a false fusion can be corrected, and from the noise of the IMU
that the one before has shown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.smoothing.projected_matches import (
    REACH_PX,
    Matches,
    Scene,
    consistent_matches,
    match_probabilities,
    projected_matches,
)
from slam_graph.backend.smoothing.recording_problem import BundleAdjustment
from slam_graph.backend.smoothing.recording_segment import (
    RecordingSegment,
    row_motions,
    triangulated,
    views,
    with_gtsam_cameras,
)
from slam_graph.backend.smoothing.smoothing_task import (
    LooseAdjustment,
    SegmentStart,
    SmoothingTask,
)
from slam_graph.geometry import NavState
from slam_graph.sensors import Rig

_VISIT_S = 6.0
"""Length of a visit: the drift within it is negligible."""
_MAX_OFFSET = 3.0
"""Largest offset of a match after removal of the drift, in standard deviations."""
_LEAST_PROBABILITY = 0.95
"""Of a match to be true: a false one bends the map as a false loop closure does."""
_SEED = 0
"""Of RANSAC."""
_THINNING = 2
"""One of this many keyframes is in the loose bundle adjustments."""
_MAX_ROUNDS = 10
_SETTLED = 0.1
"""Rounds end when less than this part of the fused features differs from an earlier round."""


def with_fused_features(
    given: SegmentStart, task: SmoothingTask, report: Callable[[int, int], None]
) -> tuple[SegmentStart, int]:
    """Fuse the features of a segment.

    Args:
        given: segment, initial states and anchor.
        task: calibration and settings.
        report: is given after each step: steps so far, rounds that are complete.

    Returns:
        The segment with fused features, with the states of its keyframes and the noise of the IMU
        after the last loose bundle adjustment; and the number of steps of all of them.

    Raises:
        EstimationError: if there is no minimum.
    """
    segment, states, anchor = given.segment, given.states, given.anchor
    chosen = np.unique([*range(anchor % _THINNING, len(states), _THINNING), 0, len(states) - 1])
    fixed = int(np.searchsorted(chosen, anchor))
    steps = rounds = 0

    def adjusted(
        segment: RecordingSegment, states: list[NavState], loose: LooseAdjustment | None = None
    ) -> tuple[list[NavState], LooseAdjustment]:
        nonlocal steps, rounds
        before = steps
        keyframes = segment.keyframes[chosen]
        aiding = segment.aiding.at(segment.stamps_ns[keyframes])
        thin = replace(segment, keyframes=keyframes, aiding=aiding)
        start = SegmentStart(thin, [states[k] for k in chosen], fixed, loose)
        problem = BundleAdjustment(start, task, lambda n, _: report(before + n, rounds))
        states = problem.solve_loosely(segment.keyframe_stamps_ns)
        steps, rounds = steps + problem.iterations, rounds + 1
        return states, LooseAdjustment([given.states[k] for k in chosen], problem.imu_noise)

    states, loose = adjusted(segment, states)
    own = np.arange(len(segment.seen.ids))
    tried = [own]
    for _ in range(_MAX_ROUNDS):
        label = _labels(segment, states, task.rig, task.backend)
        # a few features may be fused and separated in turn; the adjustment that follows begins near
        # the minimum with either
        least = min(int(np.sum(label != before)) for before in tried)
        if least <= _SETTLED * np.sum(label != own):
            break
        tried.append(label)
        states, loose = adjusted(_relabelled(segment, label), states, loose)
    loose = LooseAdjustment(given.states, loose.noise)
    segment = _relabelled(segment, label)
    return replace(given, segment=segment, states=states, loose=loose), steps


def _relabelled(segment: RecordingSegment, label: IntArray) -> RecordingSegment:
    """The segment with fused features."""
    return replace(segment, seen=relabelled(segment.seen, label))


def _labels(
    segment: RecordingSegment, states: list[NavState], rig: Rig, backend: BackendConfig
) -> IntArray:
    """The labels (J,) of the features of a segment."""
    motions = row_motions(states, segment.imu, rig)
    projection = RigProjection(with_gtsam_cameras(rig), motions, rig)
    seen = segment.seen_by_keyframes()
    often = np.bincount(views(seen)[0], minlength=len(seen.ids)) > 1
    label = np.arange(len(often))
    if not often.any():
        return label
    rows, seen = np.flatnonzero(often), seen.subset(often)
    matrices = np.array([state.world_T_body.matrix() for state in states])
    poses = matrices[:, :3, :3], matrices[:, :3, 3]
    points, usable = triangulated(seen, poses, projection, backend)
    first = np.searchsorted(seen.feature, np.arange(len(rows)))
    frames = 0.5 * (seen.frame[first] + seen.frame[first + seen.counts - 1])
    times_s = np.interp(frames, np.arange(len(states)), segment.keyframe_stamps_ns * 1e-9)
    at = Geometry(*poses, points)
    scene = Scene(seen, at, usable, times_s, projection, backend.noise.pixel_sigma)
    label[rows] = rows[fused_labels(scene)]
    return label


def fused_labels(scene: Scene, reach_px: float = REACH_PX) -> IntArray:
    """Labels of features: those of the same point have the same one.

    Args:
        scene: the features, one for each track.
        reach_px: largest mean offset of a match.

    Returns:
        (J,) row of the first feature that is the same point.
    """
    matches = projected_matches(scene, reach_px)
    good, residuals = _confirmed(matches, scene.times_s)
    return _merged(matches.select(good), residuals[good], scene.seen)


def relabelled(seen: Observations, label: IntArray) -> Observations:
    """The observations with fused features, each with the id of the first of them.

    Args:
        seen: observations of J features.
        label: (J,) see `fused_labels`.
    """
    kept = np.unique(label)
    feature = np.searchsorted(kept, label)[seen.feature]
    image = seen.frame * (int(seen.camera.max(initial=0)) + 1) + seen.camera
    count = int(image.max(initial=0)) + 1
    # most are in order already, which a stable sort of one key makes use of
    order = np.argsort(feature * count + image, kind="stable")
    return Observations(
        seen.ids[kept],
        seen.frames,
        feature[order],
        seen.frame[order],
        seen.camera[order],
        seen.pixels[order],
        seen.normalized[order],
    )


def _confirmed(matches: Matches, times_s: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Which matches (P,) are confirmed, and their residual offsets (P,)."""
    rng = np.random.default_rng(_SEED)
    first_s, second_s = times_s[matches.earlier], times_s[matches.later]
    residuals = np.linalg.norm(matches.offsets, axis=1)
    close = np.flatnonzero(second_s - first_s < _VISIT_S)
    good = np.zeros(len(residuals), np.bool_)
    probable = match_probabilities(matches.offsets[close], matches.chances[close])
    good[close] = (probable > _LEAST_PROBABILITY) & (residuals[close] < _MAX_OFFSET)
    far = np.flatnonzero(second_s - first_s >= _VISIT_S)
    for half in range(4):  # visits overlap by half, so that none is cut
        first = np.floor(first_s[far] / _VISIT_S + 0.5 * (half % 2)).astype(np.int64)
        second = np.floor(second_s[far] / _VISIT_S + 0.5 * (half // 2)).astype(np.int64)
        order = np.lexsort((second, first))
        starts = np.flatnonzero(np.diff(first[order]) | np.diff(second[order])) + 1
        groups = [group for group in np.split(far[order], starts) if len(group) > 2]
        for group in groups:
            chances = matches.chances[group]
            J, offsets = matches.by_drift[group], matches.offsets[group]
            consistent, left = consistent_matches(
                J, offsets, _MAX_OFFSET, float(np.mean(chances)), len(groups), rng
            )
            consistent &= match_probabilities(left, chances) > _LEAST_PROBABILITY
            after = np.linalg.norm(left, axis=1)
            better = consistent & (~good[group] | (after < residuals[group]))
            good[group] |= consistent
            residuals[group[better]] = after[better]
    return good, residuals


def _merged(matches: Matches, residuals: FloatArray, seen: Observations) -> IntArray:
    """Labels (J,) after merging matches, the closest first, unless both are seen in one frame."""
    label = np.arange(len(seen.ids))
    members = {row: [row] for row in np.union1d(matches.earlier, matches.later).tolist()}
    seen_in = np.zeros((len(seen.ids), len(seen.frames)), np.bool_)
    seen_in[seen.feature, seen.frame] = True
    for match in np.argsort(residuals, kind="stable"):
        a, b = sorted((int(label[matches.earlier[match]]), int(label[matches.later[match]])))
        if a == b or np.any(seen_in[a] & seen_in[b]):
            continue
        seen_in[a] |= seen_in[b]
        label[members[b]] = a
        members[a] += members.pop(b)
    return label
