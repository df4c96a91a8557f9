# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the estimator carries from one step to the next: variables, their prior, and the tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from slam_graph.backend.square_root import Layout, SquareRootInformation
from slam_graph.backend.state import State, dims_of, imu_state_keys
from slam_graph.backend.tracks import TrackWindow
from slam_graph.geometry.trajectory import NavState

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(eq=False)
class Window:
    """The variables in the cost, and all that is known of them.

    Attributes:
        frame: index of the current frame.
        stamp_ns: its time on the clock of the IMU.
        state: estimates and linearisation points.
        prior: what the steps so far have left behind about the variables.
        tracks: observations that have not been used yet.
        past: indices of the past frames whose poses are in the state, ascending.
        features: ids (N,) of the features in the state, ascending.
    """

    frame: int
    stamp_ns: int
    state: State
    prior: SquareRootInformation
    tracks: TrackWindow = field(default_factory=TrackWindow)
    past: list[int] = field(default_factory=list)
    features: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    def keys(self, past: Sequence[int], features: IntArray) -> list[int]:
        """Keys of some features and past poses, and of the current IMU state, in this order."""
        poses = [X(i) for i in past]
        return [L(int(j)) for j in features] + poses + list(imu_state_keys(self.frame))

    def shrink(self, past: Sequence[int], features: IntArray) -> None:
        """Keep only these past frames and features."""
        self.past, self.features = list(past), features
        self.tracks.retain([*past, self.frame])

    def current(self) -> NavState:
        """The state of the current frame, with its covariance."""
        return self.state.nav_state(self.frame, self.stamp_ns, self.covariance())

    def covariance(self) -> FloatArray:
        """Covariance (15, 15) of the current IMU state: the last columns of the prior."""
        layout = Layout(dims_of(imu_state_keys(self.frame)))
        return SquareRootInformation(layout, self.prior.Rd[-16:, -16:]).covariance()

    def points(self) -> FloatArray:
        """World positions (N, 3) of the features in the state."""
        points = [self.state.estimate.atPoint3(L(j)) for j in self.features.tolist()]
        return np.array(points).reshape(-1, 3)
