# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the estimator carries from one step to the next: variables, their prior, and the tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import FeatureTracks, is_in
from slam_graph.backend.marginalization.landmark_store import LandmarkStore
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State, features_of, imu_state_keys, landmark_keys
from slam_graph.geometry import NavState


def _no_ids() -> IntArray:
    return np.zeros(0, np.int64)


def no_points() -> tuple[IntArray, FloatArray]:
    """Ids and world positions of no features."""
    return np.zeros(0, np.int64), np.zeros((0, 3))


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
        past_stamps_ns: their times on the clock of the IMU, by index.
        moving: those of the past frames whose velocity and bias are in the state too, ascending.
        keyframes: those of the past frames that are keyframes.
        factors: GTSAM's factors that are not part of the prior yet.
        state_features: ids (N,) of the features in the state, ascending.
        lost_features: the features that were in the state and are not tracked any more.
        kept_points: ids (N,) and world positions (N, 3) of the features outside the state that stay
            in the cost.
        last_points: the same of all features that the last step estimated outside the state.
        calibration: keys of the parameters of rig and position fixes that are in the state.
        images_wait_until_ns: images are left out until it is known how far one camera has moved,
            and up to this time at most; None if they are used.
    """

    frame: int
    stamp_ns: int
    state: State
    prior: SquareRootInformation
    tracks: FeatureTracks = field(default_factory=FeatureTracks)
    past: list[int] = field(default_factory=list)
    past_stamps_ns: dict[int, int] = field(default_factory=dict)
    moving: list[int] = field(default_factory=list)
    keyframes: set[int] = field(default_factory=set)
    factors: list[gtsam.NonlinearFactor] = field(default_factory=list)
    state_features: IntArray = field(default_factory=_no_ids)
    lost_features: LandmarkStore = field(default_factory=LandmarkStore)
    kept_points: tuple[IntArray, FloatArray] = field(default_factory=no_points)
    last_points: tuple[IntArray, FloatArray] = field(default_factory=no_points)
    calibration: tuple[int, ...] = ()
    images_wait_until_ns: int | None = None

    def keys(self, past: Sequence[int], moving: Sequence[int], features: IntArray) -> list[int]:
        """Keys of some features, the calibration, past poses and past and current IMU states.

        They are in this order, and features that are no longer tracked come first, the others after
        them as they were: what no new measurement touches stands to the left, where an update need
        not go, and what does not change its place is cheap to keep.
        """
        known = features_of(self.prior.layout)
        staying, new = known[is_in(known, features)], features[~is_in(features, np.sort(known))]
        tracked, live = is_in(staying, self.tracks.seen), new[is_in(new, self.tracks.seen)]
        keys = landmark_keys(np.concatenate([staying[~tracked], staying[tracked], live]))
        keys += self.calibration
        keys += [X(i) for i in past if i not in moving]
        for i in (*moving, self.frame):
            keys += imu_state_keys(i)
        return keys

    def current(self, information: SquareRootInformation) -> NavState:
        """The state of the current frame, with its covariance (15, 15) under some information."""
        covariance = information.covariance_of(imu_state_keys(self.frame))
        return self.state.nav_state(self.frame, self.stamp_ns, covariance)

    def points(self) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and world positions (N, 3) of all features that the last step estimated."""
        in_state = self.state.positions_of(self.state_features)
        ids, points = self.last_points
        other = ~is_in(ids, self.state_features)
        return (
            np.concatenate([self.state_features, ids[other]]),
            np.concatenate([in_state, points[other]]),
        )

    def recall_features(self) -> None:
        """Make variables again of the features that the current frame sees and the store has."""
        again = self.lost_features.due(self.tracks.seen)
        if len(again):
            self.prior = self.lost_features.recall(again, self.prior, self.state)
            self.state_features = np.union1d(self.state_features, again)
