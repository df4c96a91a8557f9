# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A piece of a recording with features that are the same point fused, before its bundle adjustment.

Fusion and a rough bundle adjustment of every second keyframe take turns: what is fused takes drift
out of the poses, and by better poses more can be fused. Each turn begins with the tracks as they
came, so that a wrong fusion does not last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam_graph.backend.config import BackendConfig
from slam_graph.backend.reprojection import Geometry, RigProjection
from slam_graph.geometry.trajectory import NavState
from slam_graph.mapping.bundle_adjustment import BundleAdjustment
from slam_graph.mapping.feature_fusion import fused, relabelled
from slam_graph.mapping.final_ba_config import FinalBaConfig
from slam_graph.mapping.keyframes import Piece, triangulated, views, with_native_cameras
from slam_graph.mapping.projected_matches import Scene
from slam_graph.sensors.rig import Rig

IntArray = NDArray[np.int64]

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
