# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The protocol of front ends: frames in, features out, and feedback of the back end.

`FrameStats` collects what a front end counts and times in a frame.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.geometry import NavState
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData


class FrameStats(defaultdict[str, float]):
    """Counts and milliseconds (`…_ms`) of a frame, by name; zero for what did not occur."""

    def __init__(self) -> None:
        super().__init__(float)

    def add(self, name: str, number: int) -> None:
        """Increase a count."""
        self[name] += number

    def count(self, **features: BoolArray) -> None:
        """Increase several counts, each by the number of features (N,) for which it holds."""
        for name, selected in features.items():
            self.add(name, int(np.count_nonzero(selected)))

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = time.perf_counter()
        yield
        self[stage] += (time.perf_counter() - start) * 1e3


@dataclass(frozen=True, eq=False)
class Feedback:
    """What the back end knows after a frame.

    Attributes:
        state: its estimate; None before it is initialised.
        rejected: (N,) ids of features that its χ² gate rejected.
        ids: (M,) ids of features whose position is estimated, ascending.
        points: (M, 3) these positions in the world frame, in metres.
    """

    state: NavState | None = None
    rejected: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    ids: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @staticmethod
    def of(
        state: NavState | None, rejected: IntArray, ids: IntArray, points: FloatArray
    ) -> Feedback:
        """The same from features in any order."""
        order = np.argsort(ids, kind="stable")
        return Feedback(state, rejected, ids[order], points[order])


@runtime_checkable
class Frontend(Protocol):
    """Turns what cameras record into features with identities.

    Attributes:
        frame_stats: counts and milliseconds (`…_ms`) of the last frame, by name.
    """

    frame_stats: dict[str, float]

    def track(self, frame: CameraFrame | FeatureFrame, imu: ImuData | None = None) -> FeatureFrame:
        """The features of the next frame.

        The same id in another frame or camera is the same point of the world. The ids of new
        features are larger than all before.

        Args:
            frame: what the cameras recorded.
            imu: the samples since the frame before, as in `Packet`; None where there are none.
        """
        ...

    def drop(self, ids: IntArray) -> None:
        """Do not report these features any more: the back end rejected them."""
        ...

    def receive_feedback(self, feedback: Feedback) -> None:
        """Take note of what the back end knows after an earlier frame."""
        ...
