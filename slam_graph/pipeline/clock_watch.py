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

SPACING_NS = 90_000_000
"""Time between frames of a run that are diagnosed."""


class ClockWatch:
    """The time offset between camera and IMU, in windows of some seconds.

    Only the frames of the present window are kept, so that a run of any length can be watched.

    Args:
        result: of the run; it knows the rig, and where the estimate was lost.
        objects: knows what moves.
        diagnostics: counts windows that cannot be judged because something fails.
    """

    def __init__(self, result: RunResult, objects: NoObjects, diagnostics: Diagnostics) -> None:
        from slam_graph.diagnosis import Diagnosis  # it takes a moment to import

        self._result, self._objects, self._diagnostics = result, objects, diagnostics
        self._frames: list[FeatureFrame] = []
        self._samples: list[ImuData] = []
        self._windows = Diagnosis.Clocks()
        self._losses = 0

    def add(self, frame: EstimatedFrame) -> None:
        """Take the next frame."""
        features = frame.features
        self._forget_lost()
        if self._frames and self._lasts_ns(features.stamp_ns) >= self._windows.LENGTH_NS:
            self._close()
        if not self._frames:
            self._samples = self._samples[-1:]
        self._samples.append(frame.imu)
        if not features.cameras or not len(features.cameras[0]):
            return
        if not self._frames or features.stamp_ns - self._frames[-1].stamp_ns >= SPACING_NS:
            self._frames.append(FeatureFrame(features.stamp_ns, features.cameras[:1]))

    def finish(self) -> Diagnosis:
        """A finding of the first change that is beyond doubt, if there is one.

        The last window may be half as long as the others.
        """
        from slam_graph.diagnosis import Diagnosis

        self._forget_lost()
        frames = self._frames
        if frames and 2 * self._lasts_ns(frames[-1].stamp_ns) >= self._windows.LENGTH_NS:
            self._close()
        return Diagnosis.of_clocks(self._windows, self._result.input.start_ns)

    def _lasts_ns(self, stamp_ns: int) -> int:
        """How long the present window lasts at a time."""
        return stamp_ns - self._frames[0].stamp_ns

    def _forget_lost(self) -> None:
        """Begin anew after a loss of the estimate, and forget the windows that reach into it.

        The platform may have been put somewhere else, and what comes is compared with what was
        before.
        """
        losses = self._result.segments.losses
        for begin_ns, _ in losses[self._losses :]:
            self._frames, self._samples = [], []
            offset_ns = round(self._result.causal_rig.pose_offset_s * 1e9)
            self._windows.forget_after(begin_ns - offset_ns)
        self._losses = len(losses)

    def _close(self) -> None:
        """Estimate the offset of the present window, and begin another one."""
        kept, samples, rig = self._frames, self._samples, self._result.causal_rig
        self._frames, self._samples = [], samples[-1:]
        if not rig.cameras[0].rotation_known:
            return
        with warn_on_failure(self._diagnostics, "diagnosis_failed", "a window is left out"):
            frames = [frame.usable(1)[0].without(self._objects.moved) for frame in kept]
            self._windows.add(rig, frames, ImuData.concatenate(samples))
