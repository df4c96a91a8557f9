# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""An estimator that is fed with a recording, for tests that look into it on the way."""

from collections.abc import Iterator

import numpy as np
from gtsam.symbol_shorthand import L, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.window import Window
from slam_graph.config import load_config
from slam_graph.datasets import RecordedSequence
from slam_graph.sensors.measurements import FeatureFrame

BELIEVED = "backend.initialization.check_calibration=false"
"""A run does not look whether the calibration fits, which takes a third of a short one. For runs on
simulated flights, whose calibration is right, where something else is tested than starts, clocks
and verdicts."""


def from_given_state(sequence: RecordedSequence, algorithm: str) -> Iterator[Estimator]:
    """The estimator after each frame, from the state that comes with the recording."""
    config = load_config(
        algorithm=algorithm, overrides=["backend.initialization.mode=given", BELIEVED]
    )
    estimator = Estimator(sequence.rig, config.algorithm, config.backend)
    start = sequence.initial_state()
    assert start is not None
    estimator.start(start)
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        yield estimator


def seen_from_the_body(window: Window, first: bool) -> tuple[FloatArray, FloatArray]:
    """Poses with the velocity, and features (N, 3), relative to the last body."""
    values = window.state.first if first else window.state.estimate
    last = values.atPose3(X(window.frame))
    poses = [last.between(values.atPose3(X(i))).matrix().ravel() for i in window.past]
    points = [last.transformTo(values.atPoint3(L(j))) for j in window.state_features.tolist()]
    velocity = last.rotation().unrotate(values.atVector(V(window.frame)))
    return np.concatenate([*poses, velocity]), np.array(points)


def fed_with(sequence: RecordedSequence, algorithm: str) -> Estimator:
    """An estimator after all frames, with a window that has past poses and features."""
    told = load_config(algorithm)
    estimator = Estimator(sequence.rig, told.algorithm, told.backend)
    for packet in sequence.packets():
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
    assert estimator.window is not None
    assert len(estimator.window.past) > 3
    assert len(estimator.window.state_features) > 5
    return estimator
