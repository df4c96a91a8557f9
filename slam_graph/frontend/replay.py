# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The front end of recordings that hold feature tracks: it hands them on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import Feedback
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig


class ReplayFrontend:
    """Hands on recorded features, except those that were dropped.

    Attributes:
        frame_stats: `tracked`, `new` and `dropped` features of the last frame.
    """

    def __init__(
        self, rig: Rig, config: FrontendConfig, seed: int, diagnostics: Diagnostics
    ) -> None:
        """Prepare for the first frame; `drop_rejected` is the only option that matters."""
        self._cameras = len(rig.cameras)
        self._drop_rejected = config.drop_rejected
        self._seen = np.zeros(0, np.int64)
        self._dropped = np.zeros(0, np.int64)
        self.frame_stats: dict[str, float] = {}

    def track(self, frame: CameraFrame | FeatureFrame, imu: ImuData | None = None) -> FeatureFrame:
        """The recorded features; the IMU says nothing new of them.

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

    def drop(self, ids: NDArray[np.int64]) -> None:
        """Do not report these features any more."""
        self._dropped = np.union1d(self._dropped, ids)

    def hear(self, feedback: Feedback) -> None:
        """Drop what the back end rejected, if so configured."""
        if self._drop_rejected and len(feedback.rejected):
            self.drop(feedback.rejected)
