# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The protocol of a viewer that watches a run, and the viewer that shows nothing."""

from __future__ import annotations

from typing import Protocol

from slam_graph.arrays import FloatArray
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import CameraFrame, FeatureFrame, Rig


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
        points: FloatArray,
    ) -> None:
        """Called after each frame.

        Args:
            frame: images, or recorded features.
            features: what the front end found in the frame.
            state: the causal estimate, or None before initialisation.
            points: (N, 3) positions of the features that are estimated now, in the world, m.
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
        points: FloatArray,
    ) -> None:
        """Show nothing."""

    def close(self) -> None:
        """Show nothing."""
