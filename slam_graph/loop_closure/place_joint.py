# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How well recognised places join the segments of a trajectory that was lost in between.

The joint is the pose of the first keyframe after a break relative to the last one before it, as the
pose graph of the run has it, with its marginal covariance there: all accepted loop closures count,
and the odometry that leads from them to the break. A graph of level frames takes roll and pitch as
they were; their variances are those that it assumes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.loop_closure.loop_pose_graph import split_yaw
from slam_graph.pose_graph import PoseGraphSolution, Poses


@dataclass(frozen=True, slots=True, eq=False)
class PlaceJoint:
    """A joint of two segments by places.

    Attributes:
        first_ns, second_ns: times of the last keyframe before the break and the first one after it.
        first_T_second: relative pose of the body.
        covariance: (6, 6) of it in GTSAM's tangent at the second: rotation (rad), translation (m).
    """

    first_ns: int
    second_ns: int
    first_T_second: gtsam.Pose3
    covariance: FloatArray


def place_joints(
    stamps_ns: IntArray,
    begins_ns: Sequence[int],
    joined: Sequence[bool],
    poses: Poses,
    solution: PoseGraphSolution,
    level: bool,
) -> list[PlaceJoint | None]:
    """The joints of all breaks; None where there is none.

    Args:
        stamps_ns: (N,) times of the keyframes, ascending.
        begins_ns: times of the first states after the breaks.
        joined: whether accepted loop closures join what is before and after.
        poses: N corrected world_T_body.
        solution: of the pose graph that has corrected them.
        level: whether that graph is one of level frames.
    """
    joints: list[PlaceJoint | None] = []
    for begin_ns, holds in zip(begins_ns, joined, strict=True):
        second = int(np.searchsorted(stamps_ns, begin_ns))
        if not holds or not 0 < second < len(stamps_ns):
            joints.append(None)
            continue
        first = second - 1
        # GTSAM has the rotation first, a pose graph the translation
        covariance = np.roll(solution.covariances([second], first)[0], 3, axis=(0, 1))
        if level:  # from the tangent of the level frame to that of the body
            turn = np.kron(np.eye(2), split_yaw(poses.select(np.array([second])))[1].rotations[0])
            covariance = turn.T @ covariance @ turn
        relative = poses.pose3(first).between(poses.pose3(second))
        times = int(stamps_ns[first]), int(stamps_ns[second])
        joints.append(PlaceJoint(*times, relative, covariance))
    return joints
