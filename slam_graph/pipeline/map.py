# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The map as a stage: built at the end from the keyframes and their best poses."""

from __future__ import annotations

import logging

from slam_graph.diagnostics import Diagnostics
from slam_graph.loop_closure import Keyframe, Loop, reposed
from slam_graph.maps import MapRecording, PoseSource, SlamMap, build_map
from slam_graph.pipeline.loops import NOT_RECOGNISABLE, Keyframes
from slam_graph.pipeline.stage import COMPLETED, Stage, warn_on_failure
from slam_graph.pose_graph import Poses
from slam_graph.results import RunResult

logger = logging.getLogger(__name__)


class MapBuilding(Stage):
    """Builds the map of a run.

    Args:
        result: of the run; it is given the map.
        keyframes: collected on the way.
        diagnostics: counts what goes wrong.
    """

    def __init__(self, result: RunResult, keyframes: Keyframes, diagnostics: Diagnostics) -> None:
        self._result, self._keyframes, self._diagnostics = result, keyframes, diagnostics

    def finish(self) -> None:
        """Build the map, unless there is nothing to recognise places by."""
        if self._result.status not in COMPLETED:
            return
        if not self._keyframes.found:
            self._diagnostics.warn("map_impossible", NOT_RECOGNISABLE)
            return
        with warn_on_failure(self._diagnostics, "map_failed", "no map is built"):
            self._result.slam_map = made = _build(self._result, self._keyframes.found)
            logger.info("map: %d keyframes, %d features", len(made), len(made.points))


def _build(result: RunResult, keyframes: list[Keyframe]) -> SlamMap:
    """The map of the keyframes at their best poses."""
    config = result.config.loop_closure
    loops = _accepted_loops(result)
    source, poses = _best_poses(result, keyframes, loops)
    return build_map(
        keyframes,
        poses,
        MapRecording(result.input.info.name, source, result.input.rig),
        loops,
        config.places,
        config.verification,
        config.degrees_of_freedom == 4,
        result.config.seed,
    )


def _accepted_loops(result: RunResult) -> list[Loop]:
    if result.loops is None:
        return []
    pairs = zip(result.loops.loops, result.loops.accepted.tolist(), strict=True)
    return [loop for loop, accepted in pairs if accepted]


def _best_poses(
    result: RunResult, keyframes: list[Keyframe], loops: list[Loop]
) -> tuple[PoseSource, Poses]:
    """The best world_T_body of all keyframes, and where they come from.

    After accepted loop closures these are the corrected poses, else the smoothed ones, else the
    causal ones.
    """
    if loops and result.loops is not None:
        return "loop_closed", result.loops.poses
    if result.final_ba is not None:
        smoothed = reposed(keyframes, result.final_ba.trajectory)
        return "smoothed", Poses.from_gtsam([k.world_T_body for k in smoothed])
    return "causal", Poses.from_gtsam([k.world_T_body for k in keyframes])
