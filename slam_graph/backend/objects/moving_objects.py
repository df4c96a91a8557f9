# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects of a run: estimated frame by frame beside the platform, and what was found."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import gtsam

from slam_graph.backend.aiding.world_alignment import WorldAlignment
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.depth_camera import with_depth_camera, with_depth_observed
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.objects.ego_motion import EgoWindow
from slam_graph.backend.objects.object_directions import DirectionTracker
from slam_graph.backend.objects.object_frame import ObjectFrame
from slam_graph.backend.objects.object_history import ObjectHistory
from slam_graph.backend.objects.object_tracker import ObjectTracker
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig


class MovingObjects(ObjectHistory):
    """Estimates moving objects, and keeps their states.

    Args:
        rig: the cameras.
        policies: of the estimators of objects.
        backend: settings of the estimator of the platform.
        config: of objects.
        classes: name of the class by label, where masks have labels.

    Attributes:
        smoothed: the objects by all of their observations, where they were smoothed.
        single_camera: whether one camera without depth images sees them: they have directions then,
            and no states.
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
        self.smoothed: ObjectHistory | None = None
        self._highest, self._offset_ns = 0, 0
        self.begin(rig)

    def begin(self, rig: Rig) -> None:
        """Begin without objects: the world is another one from now on; states so far stay."""
        self._note_numbers()
        policies, backend, config = self._settings
        self._window, self._moved = EgoWindow(config.window_s), gtsam.Pose3()
        self.single_camera = len(rig.cameras) == 1 and rig.depth is None
        first = self._highest + 1
        self._directions = DirectionTracker(rig, backend, config, first)
        self._rig = rig
        # depth is what a second camera sees
        with_virtual = replace(with_depth_camera(rig), depth=None)
        self._tracker = ObjectTracker(with_virtual, policies, backend, config, first)

    def _note_numbers(self) -> None:
        """A number means one object for good, also once its states are forgotten."""
        seen = (direction.number for direction in self.directions)
        self._highest = max([self._highest, *self.numbers, *seen])

    def forget_from(self, stamp_ns: int) -> None:
        """Forget what there is of objects at and after a time on the clock of the IMU."""
        self._note_numbers()
        super().forget_from(stamp_ns - self._offset_ns)

    def settle(self, found: WorldAlignment, since_ns: int) -> None:
        """Take what there is of objects at and after a time, as above, to the world of fixes."""
        super().settle(found, since_ns - self._offset_ns)

    def _move(self, estimator: Estimator) -> None:
        """Go on in the world of the platform, where fixes have moved it again.

        States so far stay where they were estimated, as those of the platform do.
        """
        moved = estimator.aiding.moved
        if moved is not self._moved:
            motion, self._moved = moved.compose(self._moved.inverse()), moved
            self._window.move(motion)
            self._tracker.move(motion)

    def take(self, frame: FeatureFrame, state: NavState, estimator: Estimator) -> ObjectFrame:
        """Take a frame, and leave what moves out of the estimate of the platform.

        Args:
            frame: all features, those that move among them, with labels where there are masks.
            state: of the platform then.
            estimator: of the platform, after the frame.
        """
        began = time.perf_counter()
        self._offset_ns = state.stamp_ns - frame.stamp_ns
        self._move(estimator)
        ego = self._window.add(frame.stamp_ns, state, estimator)
        if ego is None:
            return ObjectFrame()
        if self.single_camera:
            found = self._directions.add(frame, ego, self._sigma_px)
            self.directions += found.directions
        else:
            frame = with_depth_observed(frame, self._rig)
            found = self._tracker.add(frame, ego, self._sigma_px, estimator.pixel_noise_px())
        estimator.exclude(found.moving)
        self.note(found.states, self._tracker.objects)
        self.milliseconds += 1e3 * (time.perf_counter() - began)
        self.frames += 1
        return found
