# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects as a stage: after the platform they are estimated, frame by frame."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from slam_graph.backend import Estimator
from slam_graph.config import load_config
from slam_graph.datasets import Masks
from slam_graph.diagnostics import Diagnostics
from slam_graph.frontend import Feedback
from slam_graph.objects import (
    EgoWindow,
    ObjectFrame,
    ObjectHistory,
    ObjectTracker,
    merged_frame,
)
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects, warn_on_failure
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame


class Objects(NoObjects):
    """Estimates the moving objects, and tells estimator and front end what moves.

    Args:
        result: of the run; it is given the objects.
        estimator: of the platform.
        diagnostics: of the run; counts what goes wrong.
        masks: of objects in the images of the first camera; None without.

    Attributes:
        found: what became of the tracks of the last frame.
    """

    def __init__(
        self,
        result: RunResult,
        estimator: Estimator,
        diagnostics: Diagnostics,
        masks: Masks | None = None,
    ) -> None:
        self._diagnostics = diagnostics
        super().__init__()
        self._masks = masks
        self._estimator = estimator
        classes = {} if masks is None else masks.classes
        self._history = result.objects = ObjectHistory(classes=dict(classes))
        self._config = result.config
        self._window = EgoWindow(result.config.objects.window_s)
        self._tracker = self._new_tracker(result)
        self._result = result
        self.found = ObjectFrame()

    def _new_tracker(self, result: RunResult) -> ObjectTracker:
        config = result.config
        policies = load_config(config.objects.algorithm).algorithm
        return ObjectTracker(result.causal_rig, policies, config.backend, config.objects)

    def feedback(self, feedback: Feedback) -> Feedback:
        """What the front end is told, with what moves and where objects want more features."""
        found, wanted = self.found, self._config.objects.features
        return replace(
            feedback,
            moving=found.moving,
            static=found.static,
            wrong=found.wrong,
            hulls=tuple((hull, wanted) for _, hull in found.hulls if len(hull) > 2),
        )

    def noted(self, frame: EstimatedFrame) -> EstimatedFrame:
        """The frame with the objects in it; a failure costs no more than those.

        Raises:
            DataError: if a mask cannot be read.
        """
        self.found = ObjectFrame()
        features = self._labelled(merged_frame(frame.features, frame.features.moving))
        with warn_on_failure(self._diagnostics, "objects_failed", "a frame without moving objects"):
            self._estimate(frame, features)
        return replace(frame, objects=self.found)

    def _estimate(self, frame: EstimatedFrame, features: FeatureFrame) -> None:
        """Estimate the objects in a frame by all of its features."""
        if frame.restarted:
            self._window.forget()
            self._tracker = self._new_tracker(self._result)
        if frame.state is None or frame.waits:
            return
        begin = time.perf_counter()
        ego = self._window.add(features.stamp_ns, frame.state, self._estimator)
        if ego is None:
            return
        sigma_px = self._config.backend.noise.pixel_sigma
        self.found = self._tracker.add(features, ego, sigma_px)
        self._estimator.exclude(self.found.moving)
        self.moved = np.union1d(self.moved, self.found.moving)
        self._history.note(self.found.states, self._tracker.objects)
        self._history.milliseconds += 1e3 * (time.perf_counter() - begin)
        self._history.frames += 1

    def _labelled(self, frame: FeatureFrame) -> FeatureFrame:
        """The frame with the labels of the masks in which the first camera sees its features."""
        if self._masks is None:
            return frame
        seen, camera = frame.cameras[0], self._result.rig.cameras[0].camera
        labels = self._masks.labels(frame.stamp_ns, seen.pixels, (camera.width, camera.height))
        if labels is None:
            return frame
        return replace(frame, cameras=(replace(seen, labels=labels), *frame.cameras[1:]))
