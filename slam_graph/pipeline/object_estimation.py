# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Moving objects as a stage: after the platform they are estimated, frame by frame."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from slam_graph.backend import Estimator, MovingObjects, ObjectFrame, ObjectSmoother
from slam_graph.datasets import RecordedSequence
from slam_graph.diagnostics import Diagnostics
from slam_graph.frontend import Feedback
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects, warn_on_failure
from slam_graph.results import RunResult

_NOT_SMOOTHED = "no smoothed objects"


class Objects(NoObjects):
    """Estimates the moving objects, and tells estimator and front end what moves.

    Args:
        result: of the run; it is given the objects.
        estimator: of the platform.
        diagnostics: of the run; counts what goes wrong.
        recording: with masks or labels, if it has any; None where there can be none.

    Attributes:
        found: what became of the tracks of the last frame.
    """

    def __init__(
        self,
        result: RunResult,
        estimator: Estimator,
        diagnostics: Diagnostics,
        recording: RecordedSequence | None = None,
    ) -> None:
        super().__init__()
        config = result.config
        self._result, self._estimator, self._diagnostics = result, estimator, diagnostics
        self._labels = recording.labels_over_time() if recording is not None else None
        self._wanted = config.objects.features
        self._objects = result.objects = MovingObjects(
            result.causal_rig,
            config.object_policies,
            config.backend,
            config.objects,
            {} if recording is None else recording.mask_classes,
        )
        self._smoother = ObjectSmoother(config.backend, config.objects)
        self._recording = ExitStack()
        self.found = ObjectFrame()

    def begin(self, resources: ExitStack) -> None:
        """Make a temporary folder for the tracks of objects, if they are to be smoothed."""
        if not self._result.config.final_ba.enabled:
            return
        with warn_on_failure(self._diagnostics, "objects_failed", _NOT_SMOOTHED):
            folder = resources.enter_context(TemporaryDirectory(prefix="slam_graph_"))
            resources.enter_context(self._recording)  # released before the folder is removed
            rig = self._result.input.rig
            self._recording.enter_context(self._smoother.recorded(rig, Path(folder)))

    def feedback(self, feedback: Feedback) -> Feedback:
        """What the front end is told, with what moves and where objects want more features."""
        found = self.found
        return replace(
            feedback,
            moving=found.moving,
            static=found.static,
            wrong=found.wrong,
            hulls=tuple((hull, self._wanted) for _, hull in found.hulls if len(hull) > 2),
        )

    def noted(self, frame: EstimatedFrame) -> EstimatedFrame:
        """The frame with the objects in it, and its features with the labels of their masks.

        A failure costs no more than the objects.

        Raises:
            DataError: if a mask cannot be read.
        """
        self.found = ObjectFrame()
        if self._labels is not None:
            frame = replace(frame, features=self._labels.labelled(frame.features))
        features = frame.features.whole
        if frame.restarted:
            self._begin_again(frame)
        if frame.state is not None and not frame.waits:
            with warn_on_failure(
                self._diagnostics, "objects_failed", "a frame without moving objects"
            ):
                self.found = self._objects.take(features, frame.state, self._estimator)
                self._smoother.add(features, self.found.members)
        self.moved = np.union1d(self.moved, self.found.moving)
        return replace(frame, objects=self.found)

    def _begin_again(self, frame: EstimatedFrame) -> None:
        """Begin without objects; those so far move if the platform's states have moved."""
        found, ended_ns = self._estimator.aiding.found, self._result.segments.ended_ns
        rigid = frame.world_motion is not None and frame.world_scale == 1.0
        if rigid and found is not None:
            self._objects.settle(
                found, np.iinfo(np.int64).min if ended_ns is None else ended_ns + 1
            )
        self._objects.begin(self._result.causal_rig)

    def finish(self) -> None:
        """Smooth the objects, and say so if no mask belongs to any frame."""
        result = self._result
        if result.final_ba is not None:
            with warn_on_failure(self._diagnostics, "objects_failed", _NOT_SMOOTHED):
                self._recording.close()
                rig = result.estimated_rig
                task = self._objects, rig, result.final_ba, result.config.final_ba
                result.final_ba, failures = self._smoother.smooth(*task)
                for failure in failures:
                    self._diagnostics.warn("object_not_smoothed", failure)
            # they are large, and nothing else is joined to them
            result.final_ba = replace(result.final_ba, equations=None)
        if self._labels is not None and self._labels.frames == 0:
            self._diagnostics.warn(
                "masks_unused",
                f"none of the {self._labels.masks} masks has the time of a frame: they are named "
                "by the stamps of frames of the first camera, in ns",
            )
