# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What was run, under which settings, and how it ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from slam_graph.config import RunConfig
from slam_graph.datasets import SequenceInfo
from slam_graph.geometry import Trajectory
from slam_graph.sensors import Rig

_Ended = Literal[
    "ok", "interrupted", "not_initialized", "diverged", "low_coverage", "no_map", "failed"
]
Status = Literal[_Ended, "suspect", "unfinished"]


@dataclass(frozen=True, eq=False, repr=False)
class RunInput:
    """What was run: a part of a recording, under which settings.

    Attributes:
        info: the recording.
        config: all settings.
        rig: the sensors that were used.
        start_ns, end_ns: stamps of the first and the last frame that were asked for.
        truth: ground truth of the whole recording, or None.
        object_truth: true poses of moving objects by their numbers.
        datum: latitude, longitude (°) and height (m) of the origin of the fixes, or None.
        truth_of_fixes: whether the ground truth is in the world of the position fixes.
    """

    info: SequenceInfo
    config: RunConfig
    rig: Rig
    start_ns: int
    end_ns: int
    truth: Trajectory | None = None
    datum: tuple[float, float, float] | None = None
    object_truth: Mapping[int, Trajectory] = field(default_factory=dict)
    truth_of_fixes: bool = False

    @property
    def offset_ns(self) -> int:
        """Time of a state, on its clock, since the stamp of its frame, as it was calibrated."""
        return round(self.rig.pose_offset_s * 1e9)

    @property
    def states_ns(self) -> tuple[int, int]:
        """Times of the states at the first and the last frame."""
        return self.start_ns + self.offset_ns, self.end_ns + self.offset_ns

    @property
    def recorded_s(self) -> float:
        """Length of the part that was asked for, s."""
        return (self.end_ns - self.start_ns) * 1e-9


@dataclass(eq=False)
class Ending:
    """How a run ended.

    Attributes:
        status: in one word.
        message: why it did not end well; empty if it did.
        error: what ended the run, if something was raised.
        wall_s: time that the run took, without smoothing, loop closure and map, s.
        waiting_for: the end of the message of a run that waits for a start: what for, and what the
            estimator takes for the likeliest cause.
    """

    status: Status = "ok"
    message: str = ""
    error: BaseException | None = None
    wall_s: float = 0.0
    waiting_for: str = ""
