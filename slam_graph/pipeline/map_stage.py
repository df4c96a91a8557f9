# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a run, from its keyframes and the best poses that there are of them."""

from __future__ import annotations

import logging

import cv2
import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import SlamGraphError
from slam_graph.loop_closure.loop_keyframes import Keyframe, reposed
from slam_graph.loop_closure.loop_verification import Loop
from slam_graph.maps.map_building import build_map
from slam_graph.maps.map_model import MapRecording, PoseSource, SlamMap
from slam_graph.pose_graph.graph import Poses
from slam_graph.results.run_result import RunResult

logger = logging.getLogger(__name__)


def map_of(
    result: RunResult, keyframes: list[Keyframe], diagnostics: Diagnostics
) -> SlamMap | None:
    """The map of a run, or None if there is nothing to recognise places by.

    Its poses are those of the bundle adjustment of the whole recording, else the causal ones; if
    there were loops, closed on these.

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
    held: list[Loop] = []
    if result.loops is not None:
        pairs = zip(result.loops.loops, result.loops.accepted.tolist(), strict=True)
        held = [loop for loop, accepted in pairs if accepted]
    try:
        source, poses = best_poses(result, keyframes, held)
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
    except (cv2.error, RuntimeError, np.linalg.LinAlgError, SlamGraphError) as error:
        diagnostics.warn("map_failed", " ".join(str(error).split())[:200])
        return None
    except KeyboardInterrupt:
        diagnostics.warn("map_failed", "interrupted")
        return None
    logger.info("map: %d keyframes, %d features", len(made), len(made.points))
    return made


def best_poses(
    result: RunResult, keyframes: list[Keyframe], held: list[Loop]
) -> tuple[PoseSource, Poses]:
    """The best world_T_body of all keyframes, and where they come from.

    Args:
        result: of the run.
        keyframes: with causal poses.
        held: loop closures that are true.
    """
    if held and result.loops is not None:
        return "loop_closed", result.loops.poses
    if result.final_ba is not None:
        smoothed = reposed(keyframes, result.final_ba.trajectory)
        return "smoothed", Poses.from_gtsam([k.world_T_body for k in smoothed])
    return "causal", Poses.from_gtsam([k.world_T_body for k in keyframes])
