# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The front end for a recording: by name for images, or the one that replays recorded tracks."""

from __future__ import annotations

from typing import Literal

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.frontend.frontend_config import DESCRIPTORS, FRONTENDS, FrontendConfig
from slam_graph.frontend.frontend_protocol import Feedback, Frontend
from slam_graph.sensors import STANDARD_GRAVITY, CameraFrame, FeatureFrame, ImuData, Rig


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
        self._seen = np.zeros(0, np.int64)
        self._dropped = np.zeros(0, np.int64)
        self.frame_stats: dict[str, float] = {}

    def track(self, frame: CameraFrame | FeatureFrame, imu: ImuData | None = None) -> FeatureFrame:
        """The recorded features; the IMU is not used.

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
        if not dropped.any():
            return frame
        return frame.without(self._dropped)

    def drop(self, ids: IntArray) -> None:
        """Do not report these features any more."""
        self._dropped = np.union1d(self._dropped, ids)

    def receive_feedback(self, feedback: Feedback) -> None:
        """Drop what the back end rejected, if so configured."""
        if self._drop_rejected and len(feedback.rejected):
            self.drop(feedback.rejected)
