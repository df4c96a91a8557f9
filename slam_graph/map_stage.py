# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a run, from its keyframes and the best poses that there are of them."""

from __future__ import annotations

import logging

import gtsam
import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import SlamGraphError
from slam_graph.geometry.interpolation import interpolate
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.mapping.loop_keyframes import Keyframe
from slam_graph.mapping.loop_pose_graph import stacked
from slam_graph.mapping.map_building import build_map
from slam_graph.mapping.map_model import MapRecording, PoseSource, SlamMap
from slam_graph.mapping.pose_graph import Poses
from slam_graph.output.run_result import RunResult

logger = logging.getLogger(__name__)


def map_of(
    result: RunResult, keyframes: list[Keyframe], diagnostics: Diagnostics
) -> SlamMap | None:
    """The map of a run, or None if there is nothing to recognise places by.

    Its poses are those with loops closed if there were any, else those of the bundle adjustment of
    the whole recording, else the causal ones.

    Args:
        result: of the run, whose loops are closed.
        keyframes: that were collected on the way.
        diagnostics: counts what goes wrong.
    """
    if not keyframes:
        message = "nothing to recognise places by: no images, and tracks without descriptors"
        diagnostics.warn("map_impossible", message)
        return None
    config = result.config.loop_closure
    source, poses = best_poses(result, keyframes)
    loops = result.loops
    held = [] if loops is None else np.array(loops.loops, dtype=object)[loops.accepted].tolist()
    try:
        made = build_map(
            keyframes,
            poses,
            MapRecording(result.info.name, source, result.rig),
            held,
            config.places,
            config.verification,
            config.degrees_of_freedom == 4,
            result.config.seed,
        )
    except (RuntimeError, np.linalg.LinAlgError, SlamGraphError) as error:
        diagnostics.warn("map_failed", " ".join(str(error).split())[:200])
        return None
    logger.info("map: %d keyframes, %d features", len(made), len(made.points))
    return made


def best_poses(result: RunResult, keyframes: list[Keyframe]) -> tuple[PoseSource, Poses]:
    """The best world_T_body of all keyframes, and where they come from."""
    if result.loops is not None and result.loops.accepted.any():
        return "loop_closed", result.loops.poses
    if result.final_ba is not None:
        return "smoothed", stacked(_posed(keyframes, result.final_ba.trajectory))
    return "causal", stacked([k.world_T_body for k in keyframes])


def _posed(keyframes: list[Keyframe], trajectory: Trajectory) -> list[gtsam.Pose3]:
    """Poses of keyframes by a trajectory; those that it does not reach stay."""
    stamps_ns = np.array([k.stamp_ns for k in keyframes])
    found, valid = interpolate(trajectory, stamps_ns)
    poses = [k.world_T_body for k in keyframes]
    for row, number in enumerate(np.flatnonzero(valid).tolist()):
        poses[number] = found.pose(row)
    return poses
