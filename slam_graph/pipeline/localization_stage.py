# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Localization as a stage of a run: every frame's causal pose in a map that was saved before."""

from __future__ import annotations

import logging
import time
from typing import Protocol

import cv2
import numpy as np

from slam_graph.config import RunConfig
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry.trajectory import NavState
from slam_graph.loop_closure.loop_keyframes import Keyframe, KeyframeDescriber
from slam_graph.maps.map_localization import MapLocalizer
from slam_graph.maps.map_model import SlamMap
from slam_graph.maps.map_places import MapPlaces
from slam_graph.results.localization_result import LocalizationLog
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame
from slam_graph.sensors.rig import Rig

logger = logging.getLogger(__name__)


class Localization(Protocol):
    """Takes the frames of a run."""

    def keep(
        self, frame: CameraFrame | FeatureFrame, features: FeatureFrame, state: NavState
    ) -> None:
        """Take a frame with what was found in it, and the causal estimate then."""
        ...

    def finish(self) -> LocalizationLog | None:
        """What became of it."""
        ...


class NoLocalization:
    """Locates nothing."""

    def keep(
        self, frame: CameraFrame | FeatureFrame, features: FeatureFrame, state: NavState
    ) -> None:
        """Take nothing."""

    def finish(self) -> LocalizationLog | None:
        """Nothing became of it."""
        return None


class LocalizationStage:
    """Locates a run in a map while it goes on.

    Args:
        known: the map.
        rig: the cameras of the run.
        config: all settings.
        name: of the recording.
        diagnostics: counts what goes wrong.
    """

    def __init__(
        self, known: SlamMap, rig: Rig, config: RunConfig, name: str, diagnostics: Diagnostics
    ) -> None:
        loops, settings = config.loop_closure, config.localization
        self._places = MapPlaces(known, rig, loops.verification, settings.neighbours)
        self._localizer = MapLocalizer(self._places, settings)
        self._describer = KeyframeDescriber(rig.cameras[0].camera, loops.keyframes.further_corners)
        self._name, self._diagnostics = name, diagnostics
        self._log = LocalizationLog(known)

    def keep(
        self, frame: CameraFrame | FeatureFrame, features: FeatureFrame, state: NavState
    ) -> None:
        """Take a frame with what was found in it, and the causal estimate then.

        Raises:
            DataError: if the run has descriptors of another kind than the map.
        """
        start = time.perf_counter()
        localizer = self._localizer
        localizer.move(state.stamp_ns, state.world_T_body)
        if localizer.wants(state.stamp_ns):
            view = self._view(frame, features, state)
            if view is not None:
                self._places.check(view.descriptors, self._name)
                try:
                    localizer.match(view)
                except (cv2.error, np.linalg.LinAlgError) as error:
                    reason = " ".join(str(error).split())[:200]
                    self._diagnostics.warn("localization_query_failed", reason)
        self._log.append(state.stamp_ns, localizer.filter, localizer.located)
        self._log.seconds += time.perf_counter() - start

    def _view(
        self, frame: CameraFrame | FeatureFrame, features: FeatureFrame, state: NavState
    ) -> Keyframe | None:
        """What the first camera sees, with descriptors."""
        image = frame.images[0] if isinstance(frame, CameraFrame) else None
        seen = features.cameras[0]
        if image is not None:
            seen = self._describer.describe(image, seen)
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

    def finish(self) -> LocalizationLog:
        """The poses in the map."""
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
        return log
