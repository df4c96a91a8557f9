# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run shows to whoever watches, and the viewer that shows nothing."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame
from slam_graph.sensors.rig import Rig


class Viewer(Protocol):
    """Watches a run."""

    def open(self, rig: Rig, truth: Trajectory | None) -> None:
        """Called once, before the first frame."""
        ...

    def show(
        self,
        frame: CameraFrame | FeatureFrame,
        features: FeatureFrame,
        state: NavState | None,
        points: NDArray[np.float64],
    ) -> None:
        """Called after each frame.

        Args:
            frame: what the sequence delivered.
            features: what the front end found in it.
            state: the estimate, or None before initialisation.
            points: (N, 3) features that are now estimated, in the world.
        """
        ...

    def close(self) -> None:
        """Called once, after the last frame, however the run ended."""
        ...


class NullViewer:
    """Shows nothing."""

    def open(self, rig: Rig, truth: Trajectory | None) -> None:
        """Show nothing."""

    def show(
        self,
        frame: CameraFrame | FeatureFrame,
        features: FeatureFrame,
        state: NavState | None,
        points: NDArray[np.float64],
    ) -> None:
        """Show nothing."""

    def close(self) -> None:
        """Show nothing."""
