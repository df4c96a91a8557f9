# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Localization as a stage: the pose of every frame in a map that was saved before."""

from __future__ import annotations

import logging
import time

import cv2
import numpy as np

from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.loop_closure import Keyframe, KeyframeDescriber
from slam_graph.maps import MapLocalizer, MapPlaces, SlamMap
from slam_graph.pipeline.stage import EstimatedFrame, Stage
from slam_graph.results import LocalizationLog, RunResult

logger = logging.getLogger(__name__)


class Localization(Stage):
    """Locates a run in a map while it goes on.

    Args:
        result: of the run; it is given the poses in the map.
        known: the map.
        diagnostics: counts what goes wrong.
    """

    def __init__(self, result: RunResult, known: SlamMap, diagnostics: Diagnostics) -> None:
        rig, config = result.input.rig, result.config
        loops, settings = config.loop_closure, config.localization
        self._places = MapPlaces(known, rig, loops.verification, settings.neighbours)
        self._localizer = MapLocalizer(self._places, settings)
        self._describer = KeyframeDescriber(rig.cameras[0].camera, loops.keyframes.further_corners)
        self._name, self._diagnostics = result.input.info.name, diagnostics
        self._log = result.localization = LocalizationLog(known)

    def frame(self, frame: EstimatedFrame) -> None:
        """Take a frame, if there is an estimate.

        Raises:
            DataError: if the run has descriptors of another kind than the map.
        """
        state = frame.state
        if state is None:
            return
        began = time.perf_counter()
        localizer = self._localizer
        localizer.move(state.stamp_ns, state.world_T_body)
        if localizer.wants(state.stamp_ns):
            view = self._view(frame, state)
            if view is not None:
                self._places.check(view.descriptors, self._name)
                try:
                    localizer.match(view)
                except (cv2.error, np.linalg.LinAlgError) as error:
                    reason = " ".join(str(error).split())[:200]
                    self._diagnostics.warn("localization_query_failed", reason)
        self._log.append(state.stamp_ns, localizer.filter, localizer.located)
        self._log.seconds += time.perf_counter() - began

    def _view(self, frame: EstimatedFrame, state: NavState) -> Keyframe | None:
        """What the first camera sees, with descriptors; None if it has none."""
        seen = frame.features.cameras[0]
        if frame.image is not None:
            seen = self._describer.describe(frame.image, seen)
        if seen.descriptors is None or len(seen) == 0:
            return None
        unknown = np.full((len(seen), 3), np.nan)
        return Keyframe(
            state.stamp_ns,
            state.world_T_body,
            seen.ids,
            seen.normalized,
            seen.descriptors,
            unknown,
        )

    def finish(self) -> None:
        """Count the comparisons with the map."""
        localizer, log = self._localizer, self._log
        log.count(
            queries=localizer.queries,
            matches=localizer.matches,
            accepted=localizer.accepted,
            starts=localizer.starts,
        )
        if len(log.located) and localizer.queries == 0:
            self._diagnostics.warn(
                "localization_impossible",
                "nothing to recognise places by: no images, and tracks without descriptors",
            )
        located = int(log.located.sum())
        logger.info("located in the map: %d of %d frames", located, len(log.located))
