# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Stages that watch a run and change nothing of its estimate.

They keep the factor graphs of single frames, write the estimate so far, and hand each frame to a
recorder of feature tracks, a progress report and a viewer. These three come from outside of the
package as well: each has a protocol, and a null object stands for it where there is none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Protocol, TypeGuard

from slam_graph.backend import Estimator
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import Trajectory
from slam_graph.pipeline.stage import EstimatedFrame, Stage, warn_on_failure
from slam_graph.results import RunResult
from slam_graph.sensors import AidingData, FeatureFrame, ImuData, Rig

_SNAPSHOT_PERIOD_S, _SNAPSHOT_SHARE = 10.0, 0.02
"""The estimate so far is written no more often, and takes no more of the time of a run."""

_FIRST_STAMP = 1_000_000_000
"""Whole numbers from here on are stamps in nanoseconds."""


class GraphKeeping(Stage):
    """Keeps the factor graph of the first estimated frame at or after each time asked for.

    Args:
        result: gets the graphs.
        estimator: the back end.
        times: in seconds after the first frame of the run; whole numbers from 1e9 on are stamps
            in ns (a float cannot hold them).
        diagnostics: counts the times after the last state.
    """

    def __init__(
        self,
        result: RunResult,
        estimator: Estimator,
        times: Sequence[int | float],
        diagnostics: Diagnostics,
    ) -> None:
        self._result, self._estimator, self._diagnostics = result, estimator, diagnostics
        start_ns = result.input.start_ns
        self._stamps_ns = sorted(
            time if _is_stamp(time) else start_ns + round(time * 1e9) for time in times
        )

    def frame(self, frame: EstimatedFrame) -> None:
        """Keep the graph if it is time for one."""
        stamp_ns = frame.features.stamp_ns
        if frame.state is None or not self._stamps_ns or stamp_ns < self._stamps_ns[0]:
            return
        self._stamps_ns = [time for time in self._stamps_ns if time > stamp_ns]
        self._result.graphs[stamp_ns] = self._estimator.factor_graph()

    def finish(self) -> None:
        """Warn of times for which there was no state."""
        for stamp_ns in self._stamps_ns:
            self._diagnostics.warn("graph_not_saved", f"no state at or after {stamp_ns} ns")


def _is_stamp(time: int | float) -> TypeGuard[int]:
    """Whether a time is a stamp, not seconds."""
    return isinstance(time, int) and time >= _FIRST_STAMP


class Snapshots(Stage):
    """Writes the estimate so far into a folder now and then, for the case that the run is killed.

    What cannot be written is counted as a warning and not tried again.

    Args:
        result: of the run.
        folder: to write to.
        diagnostics: counts the warning.
    """

    def __init__(self, result: RunResult, folder: Path, diagnostics: Diagnostics) -> None:
        self._result, self._diagnostics = result, diagnostics
        self._folder: Path | None = folder
        self._began = self._due = time.monotonic()

    def frame(self, frame: EstimatedFrame) -> None:
        """Write if it is due: after the first frame, and so that it takes little of the time."""
        now = time.monotonic()
        if self._folder is None or now < self._due:
            return
        folder, self._folder = self._folder, None
        with warn_on_failure(self._diagnostics, "not_kept", "the run is not kept if it is killed"):
            self._result.save_so_far(folder, now - self._began)
            self._folder = folder
        after = time.monotonic()
        self._due = after + max(_SNAPSHOT_PERIOD_S, (after - now) / _SNAPSHOT_SHARE)


class Viewer(Protocol):
    """Watches a run."""

    def open(self, rig: Rig, truth: Trajectory | None) -> None:
        """Called once, before the first frame."""
        ...

    def show(self, frame: EstimatedFrame, estimator: Estimator) -> None:
        """Called after each frame.

        Args:
            frame: with what the front end and the estimator made of it.
            estimator: after this frame.
        """
        ...

    def finish(self, result: RunResult) -> None:
        """Called once, when all stages are done, if there is an estimate."""
        ...

    def close(self) -> None:
        """Called once, at the end, however the run ended."""
        ...


class Progress(Protocol):
    """Reports how far a run is."""

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Called after each frame, with its time."""
        ...

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Called after each step of the final bundle adjustment.

        Args:
            done: keyframes that the work so far amounts to; it never falls.
            keyframes: number of all keyframes.
            steps: number of steps so far.
        """
        ...


class Recorder(Protocol):
    """Records feature tracks, for a replay."""

    def write(self, imu: ImuData, frame: FeatureFrame, aiding: AidingData | None = None) -> None:
        """Called after each frame.

        Args:
            imu: the samples since the frame before.
            frame: what the front end found.
            aiding: position fixes and odometry since the frame before; not given if there are none.
        """
        ...


class NullViewer:
    """Shows nothing."""

    def open(self, rig: Rig, truth: Trajectory | None) -> None:
        """Show nothing."""

    def show(self, frame: EstimatedFrame, estimator: Estimator) -> None:
        """Show nothing."""

    def finish(self, result: RunResult) -> None:
        """Show nothing."""

    def close(self) -> None:
        """Show nothing."""


class NullProgress:
    """Reports nothing."""

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Report nothing."""

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Report nothing."""


class NullRecorder:
    """Records nothing."""

    def write(self, imu: ImuData, frame: FeatureFrame, aiding: AidingData | None = None) -> None:
        """Record nothing."""


class Observers(Stage):
    """Hands each frame to the recorder and the progress report.

    Args:
        progress, recorder: null objects where there is none.
    """

    def __init__(self, progress: Progress, recorder: Recorder) -> None:
        self._progress, self._recorder = progress, recorder

    def frame(self, frame: EstimatedFrame) -> None:
        """Record and report a frame."""
        packet = frame.packet
        if packet.aiding is None:
            self._recorder.write(packet.imu, frame.features)
        else:
            self._recorder.write(packet.imu, frame.features, packet.aiding)
        self._progress.advance(frame.features.stamp_ns, frame.initialized)


class Viewing(Stage):
    """Hands each frame, and at last what came of the run, to the viewer.

    A viewer that fails is left alone from then on: the run goes on without it.

    Args:
        result: of the run.
        estimator: the back end.
        viewer: a null object where there is none.
        diagnostics: counts what goes wrong.
    """

    def __init__(
        self, result: RunResult, estimator: Estimator, viewer: Viewer, diagnostics: Diagnostics
    ) -> None:
        self._result, self._estimator, self._diagnostics = result, estimator, diagnostics
        self._viewer = viewer
        self._closing = ExitStack()

    def begin(self, resources: ExitStack) -> None:
        """Open the viewer; it is closed however the run ends."""
        resources.enter_context(self._closing)
        self._closing.callback(self._viewer.close)
        self._try(lambda: self._viewer.open(self._result.input.rig, self._result.groundtruth))

    def frame(self, frame: EstimatedFrame) -> None:
        """Show a frame."""
        self._try(lambda: self._viewer.show(frame, self._estimator))

    def _try(self, show: Callable[[], None]) -> None:
        """Show something; a viewer that cannot is not asked again."""
        failed = True
        with self._warning("not all of the run is shown"):
            show()
            failed = False
        if failed:
            self._viewer = NullViewer()

    def finish(self) -> None:
        """Show what came of the run, and close the viewer, which completes a recording for it."""
        if len(self._result.history):
            with self._warning("the end of the run is not shown"):
                self._viewer.finish(self._result)
        with self._warning("viewer not closed properly"):
            self._closing.close()

    def _warning(self, consequence: str) -> AbstractContextManager[None]:
        return warn_on_failure(self._diagnostics, "viewer_failed", consequence)
