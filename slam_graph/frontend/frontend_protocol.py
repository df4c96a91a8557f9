# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The protocol of front ends: frames in, features out; and which front end a recording gets.

`FrameStats` collects what a front end counts and times in a frame.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.frontend.frontend_config import DESCRIPTORS, FRONTENDS, FrontendConfig
from slam_graph.geometry import NavState
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData, Rig

STANDARD_GRAVITY = 9.81
"""Magnitude of gravity in m/s² where the settings (`backend.noise.gravity`) are not at hand."""


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
            self[name] += int(np.count_nonzero(selected))

    def timed(self, stage: str) -> _Timed:
        """A context that adds the time of its block to a stage."""
        return _Timed(self, stage)


class _Timed:
    """The time of a block; `contextmanager` would take several times as long for it."""

    __slots__ = ("_stage", "_start", "_stats")

    def __init__(self, stats: FrameStats, stage: str) -> None:
        self._stats, self._stage = stats, stage

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        self._stats[self._stage] += (time.perf_counter() - self._start) * 1e3


@dataclass(frozen=True, eq=False)
class Feedback:
    """What the back end knows after a frame.

    Attributes:
        state: its estimate; None before it is initialised.
        rejected: (N,) ids of features that its χ² gate rejected.
        ids: (M,) ids of features whose position is estimated, ascending.
        points: (M, 3) these positions in the world frame, in metres.
        rig: the calibration, where the back end has corrected it; None otherwise.
        moving: (K,) ids of features that move by themselves.
        static: (K,) ids of features that do not, although the front end may have thought so.
        wrong: (K,) ids of features that are neither: wrong matches.
        hulls: polygons (N, 2) around moving objects, in pixels of the first camera, and how many
            features are wanted in each.
    """

    state: NavState | None = None
    rejected: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    ids: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    rig: Rig | None = None
    moving: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    static: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    wrong: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    hulls: tuple[tuple[FloatArray, int], ...] = ()

    @staticmethod
    def of(
        state: NavState | None,
        rejected: IntArray,
        ids: IntArray,
        points: FloatArray,
        rig: Rig | None = None,
    ) -> Feedback:
        """The same from features in any order."""
        order = np.argsort(ids, kind="stable")
        return Feedback(state, rejected, ids[order], points[order], rig)


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


def build_frontend(
    rig: Rig,
    config: FrontendConfig | None = None,
    seed: int = 0,
    diagnostics: Diagnostics | None = None,
    content: Literal["images", "tracks"] = "images",
    gravity: float = STANDARD_GRAVITY,
) -> Frontend:
    """The front end for a recording.

    Args:
        rig: calibrated cameras.
        config: settings; the defaults if None.
        seed: of everything random in the front end.
        diagnostics: where faults are counted.
        content: what the frames of the recording hold (`SequenceInfo.content`); tracks are passed
            on as they are.
        gravity: magnitude in m/s² (`backend.noise.gravity` of the settings).

    Raises:
        ConfigError: if a setting does not fit the rig, or the front end needs a library that is
            not installed.
    """
    config = config or FrontendConfig()
    diagnostics = diagnostics or Diagnostics()
    if content == "tracks":
        return _ReplayFrontend(rig, config)
    # a descriptor is matched by the same front end that tracks corners
    name = "klt" if config.method in DESCRIPTORS else config.method
    return FRONTENDS[name](rig, config, seed, diagnostics, gravity)


class _ReplayFrontend:
    """Passes on recorded features, except those that were dropped.

    Attributes:
        frame_stats: `tracked`, `new` and `dropped` features of the last frame.
    """

    def __init__(self, rig: Rig, config: FrontendConfig) -> None:
        self._cameras = len(rig.cameras)
        self._drop_rejected = config.drop_rejected
        self._keeps_moving = config.keep_moving
        self._seen = np.zeros(0, np.int64)
        self._dropped = np.zeros(0, np.int64)
        self.frame_stats: dict[str, float] = {}

    def track(self, frame: CameraFrame | FeatureFrame, imu: ImuData | None = None) -> FeatureFrame:
        """The recorded features; the IMU is not used.

        Those that were recorded as moving stay apart, and are left out if these are not wanted.

        Raises:
            DataError: if the frame holds images, or features of another number of cameras.
        """
        if isinstance(frame, CameraFrame):
            raise DataError(f"frame {frame.stamp_ns} holds images, not recorded features")
        if len(frame.cameras) != self._cameras:
            raise DataError(
                f"frame {frame.stamp_ns} has features of {len(frame.cameras)} cameras, the rig has "
                f"{self._cameras}"
            )
        ids = np.unique(np.concatenate([c.ids for c in frame.cameras]))
        dropped = np.isin(ids, self._dropped)
        self.frame_stats = {
            "tracked": float(np.count_nonzero(np.isin(ids[~dropped], self._seen))),
            "new": float(np.count_nonzero(~np.isin(ids[~dropped], self._seen))),
            "dropped": float(np.count_nonzero(dropped)),
        }
        self._seen = ids
        static = frame.without(self._dropped) if dropped.any() else frame
        if not frame.moving:
            return static
        moving = FeatureFrame(frame.stamp_ns, frame.moving).without(self._dropped).cameras
        return replace(static, moving=moving if self._keeps_moving else ())

    def drop(self, ids: IntArray) -> None:
        """Do not report these features any more."""
        self._dropped = np.union1d(self._dropped, ids)

    def receive_feedback(self, feedback: Feedback) -> None:
        """Drop what the back end rejected, if so configured."""
        if self._drop_rejected and len(feedback.rejected):
            self.drop(feedback.rejected)
