# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Segments of a run: stretches of the trajectory, each from a start to where the estimate was lost.

A run that is never lost has one segment. `segments.csv` has a row for each.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry import Trajectory

JoinedBy = Literal["start", "imu", "none"]
"""Of the first segment, joined by the IMU, and not joined: its place is not known."""

_COLUMNS = (
    *("segment", "world", "begin_ns", "end_ns", "states", "joined_by"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_yaw_rad", "ended_by"),
)


@dataclass(eq=False)
class Segment:
    """A stretch of the trajectory.

    Attributes:
        begin_ns, end_ns: times of its first and its last state.
        joined_by: what puts it into the world of the segment before.
        joint_covariance: (4, 4) of that: position (m) in axes of the world, and yaw (rad).
        ended_by: what ended it; empty for the end of the recording.
    """

    begin_ns: int
    end_ns: int
    joined_by: JoinedBy = "start"
    joint_covariance: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))
    ended_by: str = ""

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return (self.end_ns - self.begin_ns) * 1e-9

    def part_of(self, trajectory: Trajectory) -> Trajectory:
        """The poses of a trajectory within this segment."""
        stamps = trajectory.stamps_ns
        return trajectory.select((stamps >= self.begin_ns) & (stamps <= self.end_ns))


def worlds(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Segments in groups that are joined: all poses of a group are in one world."""
    groups: list[list[Segment]] = []
    for segment in segments:
        if segment.joined_by == "none" or not groups:
            groups.append([])
        groups[-1].append(segment)
    return groups


def estimated_s(segments: Iterable[Segment]) -> float:
    """Time that is estimated, without what lies between segments, s."""
    return sum(segment.seconds for segment in segments)


def csv_lines(segments: Sequence[Segment], trajectory: Trajectory) -> Iterator[str]:
    """Segments as CSV; times between two of them have no state.

    Args:
        segments: in the order of time.
        trajectory: all states.
    """
    yield ",".join(_COLUMNS) + "\n"
    number = 0
    for world, group in enumerate(worlds(segments)):
        for segment in group:
            sigmas = np.sqrt(np.diag(segment.joint_covariance))
            cells = [
                *(str(number), str(world), str(segment.begin_ns), str(segment.end_ns)),
                str(len(segment.part_of(trajectory))),
                segment.joined_by,
                *(f"{sigma:.6g}" for sigma in sigmas),
                '"{}"'.format(segment.ended_by.replace('"', "'")),
            ]
            yield ",".join(cells) + "\n"
            number += 1
