# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A piece of a recording with features that are the same point fused, before its bundle adjustment.

Fusion and a rough bundle adjustment of every second keyframe take turns: what is fused takes drift
out of the poses, and by better poses more can be fused. Each turn begins with the tracks as they
came, so that a wrong fusion does not last.

Features that are the same point of the world: tracks that broke off, and places seen again.

A front end gives a point a new identity each time that its track begins anew. Where the point of
one track is projected to where another track sees its own, the two may be one. Looks are not
compared, so this is for poses that are right to some pixels. Tracks that follow each other closely
must match exactly; tracks of an earlier visit must match but for a drift that they share with
others of that visit (`drift_consensus`).

Features that one frame sees both are different points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.rig import Rig
from slam_graph.smoothing.drift_consensus import agreeing
from slam_graph.smoothing.projected_matches import Matches, Scene, projected_matches
from slam_graph.smoothing.recording_keyframes import Piece, triangulated, views, with_native_cameras
from slam_graph.smoothing.recording_problem import BundleAdjustment
from slam_graph.smoothing.smoothing_config import FinalBaConfig

VISIT_S = 6.0
"""Over so short a time nothing drifts: features this near in time share one drift."""
LIMIT = 3.0
"""How far a feature may be projected beside what it is fused with, in standard deviations."""
SEED = 0
"""Of RANSAC."""


def fused(scene: Scene, reach_px: float) -> IntArray:
    """Which features are the same point.

    Args:
        scene: the features, each by its own track.
        reach_px: how far drift may have moved a projection.

    Returns:
        (J,) for each feature the row of the first one that it is the same as; its own, if none.
    """
    matches = projected_matches(scene, reach_px)
    good, left = _confirmed(matches, scene.times_s)
    return _joined(matches.select(good), left[good], scene.seen)


def relabelled(seen: Observations, label: IntArray) -> Observations:
    """The observations with fused features under the identity of the first of them.

    Args:
        seen: observations of J features.
        label: (J,) row of the feature that each is the same as.
    """
    kept = np.unique(label)
    feature = np.searchsorted(kept, label)[seen.feature]
    order = np.lexsort((seen.camera, seen.frame, feature))
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
    """Which matches (P,) others confirm or need not, and what is left of their offsets (P,)."""
    rng = np.random.default_rng(SEED)
    first_s, second_s = times_s[matches.earlier], times_s[matches.later]
    left = np.linalg.norm(matches.offsets, axis=1)
    good = (second_s - first_s < VISIT_S) & (left < LIMIT)
    far = np.flatnonzero(second_s - first_s >= VISIT_S)
    for half in range(4):  # visits overlap by half, so that none is cut by where they begin
        first = np.floor(first_s[far] / VISIT_S + 0.5 * (half % 2)).astype(np.int64)
        second = np.floor(second_s[far] / VISIT_S + 0.5 * (half // 2)).astype(np.int64)
        order = np.lexsort((second, first))
        starts = np.flatnonzero(np.diff(first[order]) | np.diff(second[order])) + 1
        groups = [group for group in np.split(far[order], starts) if len(group) > 2]
        for group in groups:
            chance = float(np.mean(matches.chances[group]))
            J, offsets = matches.by_drift[group], matches.offsets[group]
            agree, unexplained = agreeing(J, offsets, LIMIT, chance, len(groups), rng)
            better = agree & (~good[group] | (unexplained < left[group]))
            good[group] |= agree
            left[group[better]] = unexplained[better]
    return good, left


def _joined(matches: Matches, left: FloatArray, seen: Observations) -> IntArray:
    """Labels (J,) after joining matches, the nearest first, unless a frame sees both."""
    label = np.arange(len(seen.ids))
    members = {row: [row] for row in np.union1d(matches.earlier, matches.later).tolist()}
    seen_in = np.zeros((len(seen.ids), len(seen.frames)), np.bool_)
    seen_in[seen.feature, seen.frame] = True
    for match in np.argsort(left, kind="stable"):
        a, b = sorted((int(label[matches.earlier[match]]), int(label[matches.later[match]])))
        if a == b or np.any(seen_in[a] & seen_in[b]):
            continue
        seen_in[a] |= seen_in[b]
        label[members[b]] = a
        members[a] += members.pop(b)
    return label


THINNING = 2
"""Of so many keyframes one is in the rough bundle adjustments."""
TURNS, SETTLED = 10, 0.1
"""Most turns, and the share of the fused features below which a change of these ends them."""


def with_fused_features(
    piece: Piece,
    states: list[NavState],
    anchor: int,
    rig: Rig,
    backend: BackendConfig,
    config: FinalBaConfig,
    report: Callable[[int], None],
) -> tuple[Piece, list[NavState], int]:
    """Fuse the features of a piece.

    Args:
        piece: of a recording.
        states: of its keyframes, where to begin.
        anchor: number of the keyframe that keeps its position and yaw.
        rig: calibrated sensors.
        backend: noise and triangulation.
        config: how to solve, and how far features may have drifted.
        report: is told of each step.

    Returns:
        The piece with fused features, the states of its keyframes after the last rough adjustment,
        and the number of steps that these took.

    Raises:
        EstimationError: if there is no minimum.
    """
    chosen = np.unique([*range(anchor % THINNING, len(states), THINNING), 0, len(states) - 1])

    steps = 0

    def adjusted(piece: Piece, states: list[NavState]) -> list[NavState]:
        nonlocal steps
        before = steps
        thin = replace(piece, keyframes=piece.keyframes[chosen])
        start, fixed = [states[k] for k in chosen], int(np.searchsorted(chosen, anchor))
        problem = BundleAdjustment(
            thin, start, fixed, rig, backend, config, lambda n: report(before + n)
        )
        everywhere = problem.solve_roughly()
        steps += problem.iterations
        return [everywhere[frame] for frame in piece.keyframes]

    states, own = adjusted(piece, states), np.arange(len(piece.seen.ids))
    before = own
    for _ in range(TURNS):
        label = _labels(piece, states, rig, backend, config.fusion_reach_px)
        if np.sum(label != before) <= SETTLED * np.sum(label != own):
            break
        states, before = adjusted(_relabelled(piece, label), states), label
    return _relabelled(piece, label), states, steps


def _relabelled(piece: Piece, label: IntArray) -> Piece:
    return replace(piece, seen=relabelled(piece.seen, label))


def _labels(
    piece: Piece, states: list[NavState], rig: Rig, backend: BackendConfig, reach_px: float
) -> IntArray:
    """For each feature (J,) of the piece the row of the first one that is the same point."""
    projection = RigProjection(with_native_cameras(rig))
    seen = piece.seen_by_keyframes()
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
    times_s = np.interp(frames, np.arange(len(states)), piece.keyframe_stamps_ns * 1e-9)
    at = Geometry(*poses, points)
    scene = Scene(seen, at, usable, times_s, projection, backend.noise.pixel_sigma)
    label[rows] = rows[fused(scene, reach_px)]
    return label
