# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A front end of its own, which thins out what another one finds."""

from slam_graph.arrays import IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.frontend import FRONTENDS, Feedback, FrontendConfig
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData, Rig


class EveryOtherFeature:
    """The features of `klt` that have even ids."""

    def __init__(
        self,
        rig: Rig,
        config: FrontendConfig,
        seed: int,
        diagnostics: Diagnostics,
        gravity: float,
    ) -> None:
        self._all = FRONTENDS["klt"](rig, config, seed, diagnostics, gravity)
        self.frame_stats: dict[str, float] = {}

    def track(self, frame: CameraFrame | FeatureFrame, imu: ImuData | None = None) -> FeatureFrame:
        """The features of the next frame."""
        features = self._all.track(frame, imu)
        self.frame_stats = self._all.frame_stats
        ids = features.cameras[0].ids
        return features.only(ids[ids % 2 == 0])

    def drop(self, ids: IntArray) -> None:
        """Do not report these features any more."""
        self._all.drop(ids)

    def receive_feedback(self, feedback: Feedback) -> None:
        """Pass on what the back end knows."""
        self._all.receive_feedback(feedback)
