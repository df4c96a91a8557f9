# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All states of a run as compact rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slam_graph.arrays import FloatArray, GrowingTable
from slam_graph.geometry.trajectory import NavState, Trajectory

if TYPE_CHECKING:
    import gtsam

    from slam_graph.geometry.trajectory_alignment import AlignmentMode

_STATE_WIDTH = 16
"""Position, quaternion (x y z w), velocity, accelerometer bias, gyroscope bias."""

_ERROR_WIDTH = len(NavState.COMPONENTS)
_POSE_WIDTH = 6
_UPPER = np.triu_indices(_POSE_WIDTH)
_DIAGONAL = np.equal(*_UPPER)


class StateHistory:
    """All states of a run, as compact rows: about 0.35 kB a state, or 0.21 kB.

    It grows by one state at a time and gives arrays. Where a state has no covariance its rows are
    NaN.

    Args:
        level: see below.
        scaled_camera: see below.
        compact: whether entries of covariances are kept with seven digits, as a run may be long.

    Attributes:
        level: whether gravity was measured, so that the vertical of its world is known.
        scaled_camera: body_T_camera of the camera whose path is known up to a scale, where nothing
            measured lengths; None where they are metres.
    """

    def __init__(
        self,
        level: bool = True,
        scaled_camera: gtsam.Pose3 | None = None,
        compact: bool = False,
    ) -> None:
        self.level, self.scaled_camera, self._compact = level, scaled_camera, compact
        self._stamps_ns = GrowingTable(1, np.int64)
        self._states = GrowingTable(_STATE_WIDTH)
        digits = np.float32 if compact else np.float64
        self._pose_covariances = GrowingTable(len(_UPPER[0]), digits)  # upper triangles
        self._other_variances = GrowingTable(_ERROR_WIDTH - _POSE_WIDTH, digits)

    def __len__(self) -> int:
        return len(self._stamps_ns)

    @property
    def _tables(self) -> tuple[GrowingTable, ...]:
        """All that is kept."""
        return self._stamps_ns, self._states, self._pose_covariances, self._other_variances

    @property
    def has_scale(self) -> bool:
        """Whether anything measured lengths; if not, they are known up to a common scale."""
        return self.scaled_camera is None

    @property
    def free(self) -> AlignmentMode:
        """The alignment with a truth that takes away what nothing measured, and no more."""
        if not self.has_scale:
            return "sim3"
        return "yaw" if self.level else "se3"

    def like(self) -> StateHistory:
        """A history of the same kind of world without states."""
        return StateHistory(self.level, self.scaled_camera, self._compact)

    def __repr__(self) -> str:
        return f"StateHistory({len(self)} states)"

    def append(self, state: NavState) -> None:
        """Add the state of the next frame."""
        pose = state.world_T_body
        quaternion: Any = pose.rotation().toQuaternion()  # an Eigen type that the stubs do not know
        row = np.concatenate(
            [
                pose.translation(),
                quaternion.coeffs(),
                state.velocity,
                state.accel_bias,
                state.gyro_bias,
            ]
        )
        covariance = state.covariance
        if covariance is None:
            covariance = np.full((_ERROR_WIDTH, _ERROR_WIDTH), np.nan)
        self._stamps_ns.append(state.stamp_ns)
        self._states.append(row)
        self._pose_covariances.append(covariance[_UPPER])
        self._other_variances.append(covariance.diagonal()[_POSE_WIDTH:])

    def extend(self, other: StateHistory) -> None:
        """Add all states of another history, which are later."""
        for own, others in zip(self._tables, other._tables, strict=True):
            own.extend(others.rows())

    def forget_from(self, stamp_ns: int) -> None:
        """Forget the states at and after a time."""
        kept = int(self._stamps_ns.rows()[:, 0].searchsorted(stamp_ns))
        for table in self._tables:
            table.cut(kept)

    def trajectory(self) -> Trajectory:
        """The states as a trajectory with velocities and biases."""
        rows = self._states.rows()
        return Trajectory(
            self._stamps_ns.rows()[:, 0],
            rows[:, 0:3],
            rows[:, 3:7],
            velocities=rows[:, 7:10],
            accel_biases=rows[:, 10:13],
            gyro_biases=rows[:, 13:16],
        )

    def sigmas(self) -> FloatArray:
        """(N, 15) standard deviations, in the order of `NavState.COMPONENTS`."""
        poses = self._pose_covariances.rows()[:, _DIAGONAL]
        variances = np.concatenate([poses, self._other_variances.rows()], axis=1)
        return np.asarray(np.sqrt(np.maximum(variances.astype(np.float64), 0.0)))

    def pose_covariances(self) -> FloatArray:
        """(N, 6, 6) covariances of rotation and position, in the body frame."""
        triangles = self._pose_covariances.rows()
        covariances = np.empty((len(triangles), _POSE_WIDTH, _POSE_WIDTH))
        rows, columns = _UPPER
        covariances[:, rows, columns] = covariances[:, columns, rows] = triangles
        return covariances
