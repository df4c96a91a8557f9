# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The protocol that every front end fulfils."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors.measurements import CameraFrame, FeatureFrame


@runtime_checkable
class Frontend(Protocol):
    """Turns what cameras record into features with identities.

    Attributes:
        frame_stats: counts and milliseconds (`…_ms`) of the last frame, by name.
    """

    frame_stats: dict[str, float]

    def track(self, frame: CameraFrame | FeatureFrame) -> FeatureFrame:
        """The features of the next frame.

        Ids increase and are never used again for another feature.
        """
        ...

    def drop(self, ids: NDArray[np.int64]) -> None:
        """Do not report these features any more: the back end rejected them."""
        ...
