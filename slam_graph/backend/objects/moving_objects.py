# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects of a run: estimated frame by frame beside the platform, and what was found."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.objects.ego_motion import EgoWindow
from slam_graph.backend.objects.object_frame import ObjectFrame
from slam_graph.backend.objects.object_history import ObjectHistory
from slam_graph.backend.objects.object_log import ObjectLog
from slam_graph.backend.objects.object_smoothing import ObjectSmoothing
from slam_graph.backend.objects.object_tracker import ObjectTracker
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.errors import EstimationError
from slam_graph.geometry import NavState, StateHistory
from slam_graph.sensors import FeatureFrame, Rig

_NO_IDS = np.zeros(0, np.int64)


class MovingObjects(ObjectHistory):
    """Estimates moving objects, and keeps their states.

    Args:
        rig: the cameras.
        policies: of the estimators of objects.
        backend: settings of the estimator of the platform.
        config: of objects.
        classes: name of the class by label, where masks have labels.

    Attributes:
        smoothed: the objects by all of their observations, after `smooth`.
    """

    def __init__(
        self,
        rig: Rig,
        policies: AlgorithmConfig,
        backend: BackendConfig,
        config: ObjectsConfig,
        classes: Mapping[int, str],
    ) -> None:
        super().__init__(classes)
        self._settings = policies, backend, config
        self._sigma_px = backend.noise.pixel_sigma
        self._log: ObjectLog | None = None
        self.smoothed: ObjectHistory | None = None
        self.begin(rig)

    def begin(self, rig: Rig) -> None:
        """Begin without objects: the world is another one from now on; states so far stay."""
        config = self._settings[2]
        self._window = EgoWindow(config.window_s)
        self._tracker = ObjectTracker(rig, *self._settings, first=max([0, *self.numbers]) + 1)

    @contextmanager
    def recorded(self, rig: Rig, folder: Path) -> Iterator[None]:
        """Keep the tracks of objects inside of the block, so that `smooth` can be called after it.

        Args:
            rig: the cameras.
            folder: for files.
        """
        with ObjectLog.recording(rig, self._settings[2].window_s, folder) as log:
            self._log = log
            yield

    def smooth(self, rig: Rig, platform: StateHistory, config: FinalBaConfig) -> list[str]:
        """Adjust every object as a whole.

        Args:
            rig: the best calibration available.
            platform: its smoothed states.
            config: settings of the adjustment.

        Returns:
            What went wrong, for each object that is not smoothed for a reason.
        """
        if self._log is None:
            return []
        _, backend, objects = self._settings
        task = ObjectSmoothing(rig, platform, backend, objects, config)
        tracks, failures = self._log.tracks(), []
        self.smoothed = ObjectHistory(self.classes)
        for number in self.numbers:
            frames = self._log.frames(tracks.get(number, _NO_IDS))
            try:
                self.smoothed.note(task.smoothed(self.states(number), frames), ())
            except (EstimationError, RuntimeError, np.linalg.LinAlgError) as error:
                failures.append(f"object {number} is not smoothed: {error}")
        return failures

    def take(self, frame: FeatureFrame, state: NavState, estimator: Estimator) -> ObjectFrame:
        """Take a frame, and leave what moves out of the estimate of the platform.

        Args:
            frame: all features, those that move among them, with labels where there are masks.
            state: of the platform then.
            estimator: of the platform, after the frame.
        """
        began = time.perf_counter()
        ego = self._window.add(frame.stamp_ns, state, estimator)
        if ego is None:
            return ObjectFrame()
        found = self._tracker.add(frame, ego, self._sigma_px)
        estimator.exclude(found.moving)
        self.note(found.states, self._tracker.objects)
        if self._log is not None:
            self._log.add(frame, found.members)
        self.milliseconds += 1e3 * (time.perf_counter() - began)
        self.frames += 1
        return found
