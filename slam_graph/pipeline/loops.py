# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes and loop closure as stages: keyframes are collected, loops closed at the end."""

from __future__ import annotations

import logging
import time

from slam_graph.diagnostics import Diagnostics
from slam_graph.loop_closure import Keyframe, KeyframeLog, close_loops, reposed
from slam_graph.pipeline.stage import COMPLETED, EstimatedFrame, Stage, warn_on_failure
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame

NOT_RECOGNISABLE = "nothing to recognise places by: no images, and tracks without descriptors"

logger = logging.getLogger(__name__)


class Keyframes(Stage):
    """Collects the keyframes that loop closure and map need, with their descriptors.

    Args:
        result: of the run.

    Attributes:
        seconds: that collecting them took.
    """

    def __init__(self, result: RunResult) -> None:
        self.seconds = 0.0
        self._log = KeyframeLog(result.input.rig, result.config.loop_closure.keyframes)

    def frame(self, frame: EstimatedFrame) -> None:
        """Take a frame, if there is an estimate."""
        state = frame.state
        if state is None:
            return
        began = time.perf_counter()
        # the state's time is on the IMU's clock, also where the camera's time offset is estimated
        features = FeatureFrame(state.stamp_ns, frame.features.cameras)
        self._log.add(features, state.world_T_body, frame.image)
        self.seconds += time.perf_counter() - began

    @property
    def found(self) -> list[Keyframe]:
        """All keyframes so far, with causal poses."""
        return self._log.keyframes


class LoopClosing(Stage):
    """Closes the loops of a run; the causal and the smoothed trajectory stay as they are.

    Args:
        result: of the run; it is given the loop closures.
        keyframes: collected on the way.
        diagnostics: counts what goes wrong.
    """

    def __init__(self, result: RunResult, keyframes: Keyframes, diagnostics: Diagnostics) -> None:
        self._result, self._keyframes, self._diagnostics = result, keyframes, diagnostics

    def finish(self) -> None:
        """Close the loops, starting from the best trajectory so far."""
        result = self._result
        if result.status not in COMPLETED:
            return
        if not self._keyframes.found:
            self._diagnostics.warn("loop_closure_impossible", NOT_RECOGNISABLE)
            return
        began = time.perf_counter()
        with warn_on_failure(self._diagnostics, "loop_closure_failed", "no loops are closed"):
            closures = close_loops(
                reposed(self._keyframes.found, result.best_trajectory),
                result.input.rig,
                result.config.loop_closure,
                result.config.seed,
                self._diagnostics,
            )
            logger.info(
                "loop closure: %d keyframes, %d loop closures, %d accepted, %.1f s in all",
                len(self._keyframes.found),
                len(closures.loops),
                closures.accepted.sum(),
                self._keyframes.seconds + time.perf_counter() - began,
            )
            result.loops = closures
