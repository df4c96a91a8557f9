# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run shows by itself, while it lasts, that good ones hardly ever show."""

from __future__ import annotations

from slam_graph.diagnostics import Diagnostics
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.results import RunResult

_DOUBTS = ("start_corrected", "new_segment", "scale_unknown")
"""Warnings after which an estimate that came to its end is doubted."""
_MAX_REJECTED = 0.05
"""The same for the share of features that the gate rejects. Of good recordings it is 2 to 4 %."""
_MAX_AT_LIMIT = 0.05
"""Largest share of the frames in which the noise of the IMU is at its limit. Of good recordings it
is 0 with two cameras, and nearly always with one; of those that a wrong set-up ruins it is 0.06 to
0.87 after 6 s, or the gate rejects more than `_MAX_REJECTED`, in 56 of 57."""


class RunDoubts:
    """Counts frames with a state, and those whose images contradict the IMU.

    Args:
        result: of the run, with its logs so far.
        diagnostics: of the run.
    """

    def __init__(self, result: RunResult, diagnostics: Diagnostics) -> None:
        self._result, self._diagnostics = result, diagnostics
        self._estimated = self._at_limit = 0
        self._before = 0, 0  # features that were tested and rejected before the present segment
        config = result.config
        self._has_imu = result.input.rig.has_imu
        self._learns = config.algorithm.engine == "square_root"
        self._learns &= config.backend.noise.adaptive.enabled

    def forget(self) -> None:
        """Forget all frames, as the estimator begins anew."""
        self._estimated = self._at_limit = 0
        self._before = self._result.logs.innovations.totals

    def add(self, frame: EstimatedFrame) -> None:
        """Take the next frame."""
        self._estimated += frame.initialized
        self._at_limit += frame.initialized and frame.imu_noise_at_limit

    @property
    def noise_at_limit(self) -> float | None:
        """Share of the frames with a noise of the IMU at its limit; None without any, or an IMU."""
        return self._at_limit / self._estimated if self._has_imu and self._estimated else None

    @property
    def exist(self) -> bool:
        """Whether a warning or what the gate rejects makes an estimate doubtful."""
        return self._rejects_much() or any(self._diagnostics.counts[kind] for kind in _DOUBTS)

    @property
    def imu_agrees(self) -> bool:
        """Whether images agree with the IMU as in good runs, since the estimator last began.

        Only an estimate that learns the noise of its IMU can say so.
        """
        share = self.noise_at_limit
        if share is None or not self._learns:
            return False
        return share <= _MAX_AT_LIMIT and not self._rejects_much(*self._before)

    def _rejects_much(self, tested: int = 0, rejected: int = 0) -> bool:
        """Whether too much is rejected of what came after some features."""
        of_all, rejected_of_all = self._result.logs.innovations.totals
        return rejected_of_all - rejected > _MAX_REJECTED * max(of_all - tested, 1)
