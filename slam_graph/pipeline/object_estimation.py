# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects as a stage: after the platform they are estimated, frame by frame."""

from __future__ import annotations

import time

import numpy as np

from slam_graph.backend import Estimator
from slam_graph.objects.ego_motion import EgoWindow
from slam_graph.objects.object_history import ObjectHistory
from slam_graph.objects.object_tracker import ObjectFrame, ObjectTracker, merged_frame
from slam_graph.pipeline.stage import EstimatedFrame, Stage
from slam_graph.results import RunResult


class Objects(Stage):
    """Estimates the moving objects, and tells estimator and front end what moves.

    Args:
        result: of the run; it is given the objects.
        estimator: of the platform.

    Attributes:
        found: what became of the tracks of the last frame.
    """

    def __init__(self, result: RunResult, estimator: Estimator) -> None:
        self._estimator = estimator
        self._history = result.objects = ObjectHistory()
        self._config = result.config
        self._window = EgoWindow(result.config.objects.window_s)
        self._tracker = self._new_tracker(result)
        self._result = result
        self.found = ObjectFrame()

    def _new_tracker(self, result: RunResult) -> ObjectTracker:
        config = result.config
        return ObjectTracker(result.causal_rig, config.algorithm, config.backend, config.objects)

    def frame(self, frame: EstimatedFrame) -> None:
        """Estimate the objects in a frame."""
        self.found = ObjectFrame()
        if frame.restarted:
            self._window.forget()
            self._tracker = self._new_tracker(self._result)
        if frame.state is None or frame.waits:
            return
        begin = time.perf_counter()
        features = frame.features
        ego = self._window.add(features.stamp_ns, frame.state, self._estimator)
        if ego is None:
            return
        sigma_px = self._config.backend.noise.pixel_sigma
        self.found = self._tracker.add(merged_frame(features, features.moving), ego, sigma_px)
        self._estimator.exclude(self.found.moving)
        self._history.note(self.found.states, self._tracker.objects)
        self._history.milliseconds += 1e3 * (time.perf_counter() - begin)
        self._history.frames += 1
