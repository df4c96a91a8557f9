# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure as a stage of a run: keyframes are collected on the way, loops closed at the end.

Whatever goes wrong in it is counted as a warning, and the causal result stays as it is.
"""

from __future__ import annotations

import logging
import time

import cv2
import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import SlamGraphError
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.loop_closure.close_loops import LoopClosures, close_loops
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe, KeyframeLog, reposed
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame
from slam_graph.sensors.rig import Rig

logger = logging.getLogger(__name__)


class LoopStage:
    """Collects the keyframes of a run and closes its loops.

    Args:
        rig: the cameras.
        config: all settings.
        seed: of the training of the vocabulary.
        diagnostics: counts what goes wrong.
        collect: whether keyframes are collected although no loops are to be closed.

    Attributes:
        seconds: what collecting and closing took.
    """

    def __init__(
        self,
        rig: Rig,
        config: LoopClosureConfig,
        seed: int,
        diagnostics: Diagnostics,
        collect: bool = False,
    ) -> None:
        self.seconds = 0.0
        self._collect = collect or config.enabled
        self._rig, self._config, self._seed = rig, config, seed
        self._diagnostics = diagnostics
        self._log = KeyframeLog(rig, config.keyframes)

    def keep(
        self, frame: CameraFrame | FeatureFrame, features: FeatureFrame, state: NavState
    ) -> None:
        """Take a frame with what was found in it, and the causal estimate then."""
        if not self._collect:
            return
        start = time.perf_counter()
        image = frame.images[0] if isinstance(frame, CameraFrame) else None
        # the time of the estimate is that of the IMU's clock, also where the offset is estimated
        self._log.add(FeatureFrame(state.stamp_ns, features.cameras), state.world_T_body, image)
        self.seconds += time.perf_counter() - start

    @property
    def keyframes(self) -> list[Keyframe]:
        """All keyframes so far."""
        return self._log.keyframes

    def finish(self, best: Trajectory) -> LoopClosures | None:
        """Close the loops, if there is anything to find them by.

        Args:
            best: the best estimate of the trajectory that there is without loop closures.
        """
        keyframes = self._log.keyframes
        if not self._config.enabled:
            return None
        if not keyframes:
            message = "nothing to recognise places by: no images, and tracks without descriptors"
            self._diagnostics.warn("loop_closure_impossible", message)
            return None
        start = time.perf_counter()
        try:
            closures = close_loops(
                reposed(keyframes, best), self._rig, self._config, self._seed, self._diagnostics
            )
        except (cv2.error, RuntimeError, np.linalg.LinAlgError, SlamGraphError) as error:
            self._give_up(" ".join(str(error).split())[:200])
            return None
        except KeyboardInterrupt:
            self._give_up("interrupted")
            return None
        self.seconds += time.perf_counter() - start
        logger.info(
            "loop closure: %d keyframes, %d loop closures, %d accepted, %.1f s in all",
            len(keyframes),
            len(closures.loops),
            closures.accepted.sum(),
            self.seconds,
        )
        return closures

    def _give_up(self, reason: str) -> None:
        self._diagnostics.warn("loop_closure_failed", f"the drift stays: {reason}")
