# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All that a run found out about moving objects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.aiding.world_alignment import WorldAlignment
from slam_graph.backend.objects.object_errors import ObjectErrors, object_errors
from slam_graph.backend.objects.object_frame import ObjectDirection
from slam_graph.backend.objects.object_state import ObjectMotion, ObjectState
from slam_graph.backend.objects.object_table import csv_lines, direction_lines
from slam_graph.backend.objects.tracked_object import TrackedObject
from slam_graph.geometry import Trajectory


class ObjectHistory:
    """States of the objects of a run, as they were estimated frame by frame.

    Args:
        classes: name of the class by label, where masks have labels.

    Attributes:
        classes: the same.
        points: (N, 3) by the number of an object: its points, in its own frame, m.
        milliseconds: time that the objects took, of all frames with a state.
        frames: number of these frames.
        directions: of the objects before a single camera, which have no states, by time.
    """

    def __init__(self, classes: Mapping[int, str]) -> None:
        self.classes = classes
        self.points: dict[int, FloatArray] = {}
        self.milliseconds, self.frames = 0.0, 0
        self.directions: list[ObjectDirection] = []
        self._states: dict[int, list[ObjectState]] = {}

    def __len__(self) -> int:
        return len(self._states)

    def __repr__(self) -> str:
        states = sum(map(len, self._states.values()))
        return f"{type(self).__name__}({len(self)} objects, {states} states)"

    @property
    def numbers(self) -> list[int]:
        """Numbers of the objects, ascending."""
        return sorted(self._states)

    def note(self, states: Iterable[ObjectState], objects: Iterable[TrackedObject]) -> None:
        """Add the states of the next frame, and the points of the objects that are seen."""
        for state in states:
            self._states.setdefault(state.number, []).append(state)
        for item in objects:
            if item.number in self._states:
                self.points[item.number] = item.points()

    def forget_from(self, stamp_ns: int) -> None:
        """Forget states and directions at and after a time, and objects that have none before."""
        for number in self.numbers:
            states = [state for state in self._states[number] if state.stamp_ns < stamp_ns]
            self._states[number] = states
            if not states:
                del self._states[number]
                self.points.pop(number, None)
        self.directions = [seen for seen in self.directions if seen.stamp_ns < stamp_ns]

    def settle(self, found: WorldAlignment, since_ns: int) -> None:
        """Take states and directions at and after a time to the world of the fixes.

        Points stay as they are, in the frame of their object.
        """
        for number, states in self._states.items():
            self._states[number] = [
                state.moved(found.motion).with_unknown_gauge(found.covariance, found.centre)
                if state.stamp_ns >= since_ns
                else state
                for state in states
            ]
        self.directions = [
            seen.moved(found.motion) if seen.stamp_ns >= since_ns else seen
            for seen in self.directions
        ]

    def states(self, number: int) -> list[ObjectState]:
        """States of an object, in the order of time."""
        return list(self._states[number])

    def all_states(self) -> list[ObjectState]:
        """States of all objects, by time and number."""
        states = (state for states in self._states.values() for state in states)
        return sorted(states, key=lambda state: (state.stamp_ns, state.number))

    def motions(self, number: int) -> list[ObjectMotion]:
        """Motions of an object from frame to frame."""
        return [state.step for state in self._states[number] if state.step is not None]

    def trajectory(self, number: int) -> Trajectory:
        """Poses `world_T_object` of an object, with velocities."""
        states = self._states[number]
        return poses_over_time(
            np.array([state.stamp_ns for state in states], np.int64),
            [state.world_T_object for state in states],
            np.array([state.velocity for state in states]),
        )

    def csv_lines(self) -> Iterator[str]:
        """`objects.csv`: a row for each object and frame."""
        return csv_lines(self.all_states(), self.classes)

    def direction_lines(self) -> Iterator[str]:
        """`object_directions.csv`: a row for each object and frame, without any length."""
        return direction_lines(self.directions)

    def errors(self, truth: Mapping[int, Trajectory], true_body: Trajectory) -> ObjectErrors:
        """Errors against true poses.

        Args:
            truth: of objects by their numbers, at the stamps of the frames.
            true_body: of the platform, on the clock of the cameras.
        """
        return object_errors(self.all_states(), truth, true_body)

    def label(self, number: int) -> int:
        """Label of the mask of an object; 0 without one."""
        return self._states[number][-1].label


def poses_over_time(
    stamps_ns: IntArray, poses: list[gtsam.Pose3], velocities: FloatArray | None = None
) -> Trajectory:
    """Poses as a trajectory."""
    matrices = np.array([pose.matrix() for pose in poses]).reshape(-1, 4, 4)
    quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    return Trajectory(stamps_ns, matrices[:, :3, 3], quaternions, velocities)
