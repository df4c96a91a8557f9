# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Segments of a run: stretches of the trajectory, each from a start to where the estimate was lost.

A run that is never lost has one segment. `segments.csv` has a row for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, Literal, Protocol

import gtsam
import numpy as np
import scipy  # its parts are imported when they are first used

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.geometry import Trajectory

JoinedBy = Literal["start", "imu", "none"]
"""Of the first segment, joined by the IMU, and not joined: its place is not known."""


_COLUMNS = (
    *("segment", "world", "begin_ns", "end_ns", "states", "joined_by"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_yaw_rad", "loops", "ended_by"),
    *("joint_first_ns", "joint_second_ns"),
    *(f"joint_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")),
    *(f"joint_cov_{i}{j}" for i in range(6) for j in range(i, 6)),
    *("sigma_about_x_rad", "sigma_about_y_rad"),
)
_OF_PLACES = 2 + 7 + 21
"""Columns of the joint by places."""

_UNKNOWN = np.diag([1000.0**2] * 3 + [np.pi**2])
"""Covariance of a place of which nothing is known: m², rad²."""


class PlaceJoint(Protocol):
    """What recognised places say of the pose of a segment relative to the one before."""

    @property
    def first_ns(self) -> int:
        """Time of the last keyframe before the segment."""
        ...

    @property
    def second_ns(self) -> int:
        """Time of its first keyframe."""
        ...

    @property
    def first_T_second(self) -> gtsam.Pose3:
        """Pose of the second in the first."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of it in GTSAM's tangent: rotation (rad), translation (m)."""
        ...


@dataclass(eq=False)
class Segment:
    """A stretch of the trajectory.

    Attributes:
        begin_ns, end_ns: times of its first and its last state.
        joined_by: what puts it into the world of the segment before.
        joint_covariance: (4, 4) of that: position (m) in axes of the world, and yaw (rad). Without
            an IMU nothing tells where is up, and it is (6, 6): position, then rotation (rad) about
            the axes x, y, z of the world, of which the last is yaw.
        loops: number of accepted loop closures to earlier segments, if loops were closed.
        place_joint: how these join it to the segment before; None without them.
        ended_by: what ended it; empty for the end of the recording.
        of_fixes: whether its world is that of position fixes.
    """

    begin_ns: int
    end_ns: int
    joined_by: JoinedBy = "start"
    joint_covariance: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))
    loops: int = 0
    place_joint: PlaceJoint | None = None
    ended_by: str = ""
    of_fixes: bool = False

    @property
    def joint_sigmas(self) -> tuple[float, float]:
        """Standard deviations of the joint: rotation (rad), then position (m), of the worst axis.

        With an IMU the rotation is yaw.
        """
        variances = np.diag(self.joint_covariance)
        return float(np.sqrt(variances[3:].max())), float(np.sqrt(variances[:3].max()))

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return (self.end_ns - self.begin_ns) * 1e-9

    def part_of(self, trajectory: Trajectory) -> Trajectory:
        """The poses of a trajectory within this segment."""
        stamps = trajectory.stamps_ns
        return trajectory.select((stamps >= self.begin_ns) & (stamps <= self.end_ns))


class Segments:
    """All segments of a run, in the order of time.

    Attributes:
        lost: why the estimate was lost, the last time that it was; empty if it never was.
        losses: times of which it is not known what happened, ns, on the clock of the states: from
            the last good state before each loss to where that was noticed, whether the run went on
            or not. A segment from which nothing was good adds none.
        SHORT_S: a segment that lasts less is short: a wrong calibration may be what ends it.
    """

    SHORT_S: ClassVar[float] = 5.0

    def __init__(self) -> None:
        self.lost = ""
        self.losses: list[tuple[int, int]] = []
        self._all: list[Segment] = []

    def __len__(self) -> int:
        return len(self._all)

    def __iter__(self) -> Iterator[Segment]:
        return iter(self._all)

    def __getitem__(self, number: int) -> Segment:
        return self._all[number]

    @property
    def goes_on(self) -> bool:
        """Whether the last segment has not ended."""
        return bool(self._all) and not self._all[-1].ended_by

    @property
    def ended_ns(self) -> int | None:
        """Time until which states are those of segments that have ended; None if none has."""
        return max((segment.end_ns for segment in self._all if segment.ended_by), default=None)

    @property
    def lasted(self) -> bool:
        """Whether a segment was good for so long that a wrong calibration is unlikely."""
        return any(segment.seconds >= self.SHORT_S for segment in self._all)

    @property
    def all_of_fixes(self) -> bool:
        """Whether there are segments, and all of them are in the world of position fixes."""
        return bool(self._all) and all(segment.of_fixes for segment in self._all)

    @property
    def later(self) -> list[Segment]:
        """All but the first."""
        return self._all[1:]

    @property
    def seconds(self) -> float:
        """Time that is estimated, without what lies between segments."""
        return sum(segment.seconds for segment in self._all)

    def add(
        self,
        stamp_ns: int,
        joint: FloatArray | None = None,
        joined: bool = False,
        of_fixes: bool = False,
    ) -> None:
        """Note a state: it continues the last segment, or begins one where that has ended.

        Args:
            stamp_ns: its time.
            joint: (4, 4) or (6, 6) covariance of the joint, see `Segment`, if a segment begins
                that is not the first.
            joined: whether the joint holds.
            of_fixes: whether a segment that begins is in the world of position fixes.
        """
        if not self.goes_on:
            by: JoinedBy = "start" if not self._all else "imu" if joined else "none"
            known = _UNKNOWN if joint is None else joint
            known = np.zeros((4, 4)) if by == "start" else known
            self._all.append(Segment(stamp_ns, stamp_ns, by, known, of_fixes=of_fixes))
        self._all[-1].end_ns = stamp_ns

    def end(self, good_ns: int | None, reason: str) -> float:
        """End the last segment, if it goes on, and say how long it lasted, s.

        Args:
            good_ns: time of its last state that is good, later than its first one; if there is none
                it is forgotten.
            reason: why it ends.
        """
        self.lost = reason
        if not self.goes_on:
            return 0.0
        last = self._all[-1]
        if good_ns is None:
            self._all.pop()
            return 0.0
        last.end_ns, last.ended_by = good_ns, reason
        return last.seconds

    def forget_last(self) -> None:
        """Forget the last segment, if it goes on."""
        if self.goes_on:
            self._all.pop()

    def worlds(self) -> list[list[Segment]]:
        """Segments in groups that are joined: all poses of a group are in one world."""
        groups: list[list[Segment]] = []
        for segment in self._all:
            if segment.joined_by == "none" or not groups:
                groups.append([])
            groups[-1].append(segment)
        return groups

    def breaks_ns(self, joined_ns: IntArray | None = None) -> list[int]:
        """(W - 1,) times between worlds: halfway from the end of one to the begin of the next.

        Where a world is gone back to after another one, there is a break before and after that.

        Args:
            joined_ns: (K, 2) pairs of times that are in one world, beyond what `joined_by` says:
                those of accepted loop closures.
        """
        world = self._world_numbers(np.zeros((0, 2), np.int64) if joined_ns is None else joined_ns)
        return [
            (before.end_ns + after.begin_ns) // 2
            for (before, after), is_break in zip(
                pairwise(self._all), np.diff(world) != 0, strict=True
            )
            if is_break
        ]

    def _world_numbers(self, joined_ns: IntArray) -> IntArray:
        """(S,) number of the world of each segment, where pairs (K, 2) of times are in one."""
        if len(self._all) < 2:
            return np.zeros(len(self._all), np.int64)
        begins_ns = [segment.begin_ns for segment in self._all]
        places = np.searchsorted(begins_ns, joined_ns, "right") - 1  # of a segment and what follows
        pairs = [(k - 1, k) for k in range(1, len(begins_ns)) if self._all[k].joined_by != "none"]
        first, second = np.vstack([np.maximum(places, 0), np.reshape(pairs, (-1, 2))]).astype(int).T
        shape = (len(begins_ns), len(begins_ns))
        links = scipy.sparse.csr_array((np.ones(len(first)), (first, second)), shape=shape)
        _, world = scipy.sparse.csgraph.connected_components(links, directed=False)
        return np.asarray(world, np.int64)

    def csv_lines(self, trajectory: Trajectory) -> Iterator[str]:
        """Segments as CSV; times between two of them have no state.

        Args:
            trajectory: all states.
        """
        yield ",".join(_COLUMNS) + "\n"
        world = -1
        for number, segment in enumerate(self._all):
            world += segment.joined_by == "none" or number == 0
            sigmas = [f"{sigma:.6g}" for sigma in np.sqrt(np.diag(segment.joint_covariance))]
            cells = [
                *(str(number), str(world), str(segment.begin_ns), str(segment.end_ns)),
                str(len(segment.part_of(trajectory))),
                segment.joined_by,
                *(*sigmas[:3], sigmas[-1]),  # yaw is the last rotation, if not the only one
                str(segment.loops),
                '"{}"'.format(segment.ended_by.replace('"', "'")),
                *_joint_cells(segment.place_joint),
                *(sigmas[3:-1] or ["", ""]),
            ]
            yield ",".join(cells) + "\n"


def _joint_cells(joint: PlaceJoint | None) -> list[str]:
    """The joint by places: times, relative pose, upper triangle of its covariance."""
    if joint is None:
        return [""] * _OF_PLACES
    pose = joint.first_T_second
    quaternion: Any = pose.rotation().toQuaternion()  # a type that the stubs do not know
    values = [
        *pose.translation(),
        *quaternion.coeffs(),
        *joint.covariance[np.triu_indices(6)],
    ]
    return [str(joint.first_ns), str(joint.second_ns), *(f"{value:.9g}" for value in values)]
