# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Who watches a run: a viewer, a progress report, and a recorder of the feature tracks."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Protocol

from slam_graph.diagnostics import Diagnostics
from slam_graph.pipeline.stage import EstimatedFrame, Stage, warn_on_failure
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, ImuData
from slam_graph.visualization import Viewer


class Progress(Protocol):
    """Reports how far a run is."""

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Called after each frame, with its time."""
        ...

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Called after each step of the final bundle adjustment.

        Args:
            done: keyframes that are adjusted already.
            keyframes: number of all keyframes.
            steps: number of steps so far.
        """
        ...


class Recorder(Protocol):
    """Records feature tracks, for a replay."""

    def write(self, imu: ImuData, frame: FeatureFrame) -> None:
        """Called after each frame.

        Args:
            imu: the samples since the frame before.
            frame: what the front end found.
        """
        ...


class NullProgress:
    """Reports nothing."""

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Report nothing."""

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Report nothing."""


class NullRecorder:
    """Records nothing."""

    def write(self, imu: ImuData, frame: FeatureFrame) -> None:
        """Record nothing."""


class Observers(Stage):
    """Hands each frame to recorder, progress report and viewer.

    Args:
        result: of the run.
        viewer, progress, recorder: null objects where there is none.
        diagnostics: counts what goes wrong.
    """

    def __init__(
        self,
        result: RunResult,
        viewer: Viewer,
        progress: Progress,
        recorder: Recorder,
        diagnostics: Diagnostics,
    ) -> None:
        self._result, self._diagnostics = result, diagnostics
        self._viewer, self._progress, self._recorder = viewer, progress, recorder
        self._closing = ExitStack()

    def begin(self, resources: ExitStack) -> None:
        """Open the viewer; it is closed however the run ends."""
        resources.enter_context(self._closing)
        self._closing.callback(self._viewer.close)
        self._viewer.open(self._result.input.rig, self._result.groundtruth)

    def frame(self, frame: EstimatedFrame) -> None:
        """Record, report and show a frame."""
        stamp_ns = frame.features.stamp_ns
        self._recorder.write(frame.packet.imu, frame.features)
        self._progress.advance(stamp_ns, frame.initialized)
        self._viewer.show(frame.packet.frame, frame.features, frame.state, frame.landmarks)

    def finish(self) -> None:
        """Close the viewer, which completes a recording for it."""
        with warn_on_failure(self._diagnostics, "viewer_failed", "viewer not closed properly"):
            self._closing.close()
