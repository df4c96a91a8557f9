# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The joint of two segments: a new start is put where the IMU predicts it from the last good state.

A start defines its own world, in position and yaw. After an estimate is lost, the next start is
moved into the world of the segment before, by the prediction of the IMU over the time in between.
That holds only if the prediction and the start agree in what both know: velocity and tilt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.start_review import contradict
from slam_graph.backend.solve.square_root import SquareRootInformation, triangularize
from slam_graph.backend.solve.state import letter_and_index
from slam_graph.backend.window import Window
from slam_graph.backend.world_gauge import gauge_covariance, with_unknown_gauge, world_motion
from slam_graph.geometry import NavState

_UNKNOWN_M = 1000.0
"""Standard deviation of a position of which nothing is known."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentJoint:
    """How a segment continues the one before.

    Attributes:
        before: the last good state of the segment before.
        predicted: the state at the start of the new segment as the IMU predicts it from `before`,
            with its covariance.
        holds: whether the start agrees with the prediction. If not, the place of the new segment
            is not known: something else happened in between than the IMU has measured.
        level: whether both worlds have gravity in common.
    """

    before: NavState
    predicted: NavState
    holds: bool
    level: bool = True

    @property
    def covariance(self) -> FloatArray:
        """Of the gauge of the new segment: position (m), then yaw or rotation (rad)."""
        if self.holds:
            return gauge_covariance(self.predicted, self.level)
        return np.diag([_UNKNOWN_M**2] * 3 + [np.pi**2] * (1 if self.level else 3))

    def superseded(self) -> SegmentJoint:
        """The joint of a segment whose place is measured: nothing of it is unknown any more."""
        known = replace(self.predicted, covariance=np.zeros((15, 15)))
        return replace(self, predicted=known, holds=True)

    def added_to(self, state: NavState) -> NavState:
        """A state of the new segment with a covariance relative to the segment before."""
        return with_unknown_gauge(state, self.covariance, self.predicted.world_T_body.translation())


def place(
    window: Window, before: NavState, context: EngineContext, measured: bool = True
) -> tuple[Window, SegmentJoint]:
    """A window that has just begun, moved into the world of the segment before, and the joint.

    Args:
        window: after a start; its world is its own.
        before: the last good state of the segment before, with its covariance.
        context: shared with the engine; it has the IMU samples from that state on.
        measured: whether these have measured all that happened since.
    """
    start = window.current(window.prior)
    level = context.rig.has_imu
    predictable = (
        level and context.imu.covers(before.stamp_ns) and before.stamp_ns < window.stamp_ns
    )
    predicted = before
    if predictable:
        predicted = context.propagation.predict(before, context.imu, window.stamp_ns)
    holds = measured and predictable and not contradict(start, predicted)
    motion = world_motion(start.world_T_body, predicted.world_T_body, level)
    return moved(window, motion), SegmentJoint(before, predicted, holds, level)


def moved(window: Window, motion: gtsam.Pose3) -> Window:
    """A window in a world that is moved: one that has just begun, or a running one between steps.

    Args:
        window: whose factors, if it has some, hold there too: dynamics, standstill and odometry are
            the same in every world, and fixes stay if it is the estimate that is moved. Waiting
            observations are in images. Features in `lost_features` stay in the world before.
        motion: new_T_old of the two worlds; with an IMU position and a rotation about the vertical,
            as gravity, which the dynamics have, stays.
    """
    rotation = motion.rotation().matrix()

    def there(known: tuple[IntArray, FloatArray]) -> tuple[IntArray, FloatArray]:
        ids, points = known
        return ids, points @ rotation.T + motion.translation()

    return replace(
        window,
        state=window.state.moved(motion),
        prior=turned(window.prior, rotation),
        kept_points=there(window.kept_points),
        last_points=there(window.last_points),
    )


def turned(prior: SquareRootInformation, rotation: FloatArray) -> SquareRootInformation:
    """A prior with the axes of velocities and points turned; tangents of poses are of the body."""
    Rd = np.array(prior.Rd)
    for key in prior.layout.dims:
        if letter_and_index(key)[0] in "vl":
            columns = prior.layout.indices([key])
            Rd[:, columns] = Rd[:, columns] @ rotation.T
    return SquareRootInformation(prior.layout, triangularize(Rd))
