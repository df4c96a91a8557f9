# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Watches the clocks of a whole run: the time offset in one window after another."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slam_graph.diagnostics import Diagnostics
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects, warn_on_failure
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, ImuData

if TYPE_CHECKING:
    from slam_graph.diagnosis import Diagnosis

_WINDOW_NS = 8_000_000_000
"""Length of a window; one at the end of a run is used from half of that on."""
_SPACING_NS = 90_000_000
"""Time between frames that are looked at."""


class ClockWatch:
    """The time offset between camera and IMU, in windows of some seconds.

    Only the frames of the present window are kept, so that a run of any length can be watched.

    Args:
        result: of the run; it knows the rig, and where the estimate was lost.
        objects: knows what moves.
        diagnostics: counts windows that cannot be judged because something fails.
    """

    def __init__(self, result: RunResult, objects: NoObjects, diagnostics: Diagnostics) -> None:
        self._result, self._objects, self._diagnostics = result, objects, diagnostics
        self._frames: list[FeatureFrame] = []
        self._samples: list[ImuData] = []
        self._windows: Diagnosis.Clocks | None = None
        self._losses = 0

    def add(self, frame: EstimatedFrame) -> None:
        """Take the next frame."""
        features, lost = frame.features, len(self._result.segments.losses)
        if lost > self._losses:
            self._losses, self._frames, self._samples = lost, [], []
        if self._frames and features.stamp_ns - self._frames[0].stamp_ns >= _WINDOW_NS:
            self._close()
        self._samples.append(frame.imu)
        if not self._frames or features.stamp_ns - self._frames[-1].stamp_ns >= _SPACING_NS:
            self._frames.append(FeatureFrame(features.stamp_ns, features.cameras[:1]))

    def finish(self) -> Diagnosis:
        """A finding of the first change that is beyond doubt, if there is one."""
        from slam_graph.diagnosis import Diagnosis  # it takes a moment to import

        frames, result = self._frames, self._result
        if frames and 2 * (frames[-1].stamp_ns - frames[0].stamp_ns) >= _WINDOW_NS:
            self._close()
        if self._windows is None:
            return Diagnosis([])
        change = self._windows.change(result.segments.losses, result.input.start_ns)
        return Diagnosis([] if change is None else [change])

    def _close(self) -> None:
        """Estimate the offset of the present window, and begin another one."""
        from slam_graph.diagnosis import Diagnosis

        imu, rig = ImuData.concatenate(self._samples), self._result.causal_rig
        frames = [frame.usable(1)[0].without(self._objects.moved) for frame in self._frames]
        self._frames, self._samples = [], self._samples[-1:]
        if not rig.cameras[0].rotation_known:
            return
        if self._windows is None:
            self._windows = Diagnosis.Clocks()
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "a window is left out"):
            self._windows.add(rig, frames, imu)
