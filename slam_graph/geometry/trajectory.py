# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States and trajectories: one state, poses over time, their interpolation, and TUM's format.

The accelerometer bias stands before the gyroscope bias everywhere: in the fields, in the covariance
of a state (where it is GTSAM's order), and in the columns of ``states.csv``.

Interpolation of trajectories: positions linearly, orientations by slerp.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class NavState:
    """The state of the platform at one time.

    Its error is a vector of 15 components in the order of the fields: rotation (rad, body frame),
    position (m, body frame), velocity (m/s, world frame), accelerometer bias (m/s², body frame),
    gyroscope bias (rad/s, body frame). These are the tangents of GTSAM's Pose3, Vector3 and
    ConstantBias. Biases and covariance are given by name.

    Attributes:
        COMPONENTS: names of the 15 components, with units.
        stamp_ns: time.
        world_T_body: pose of the body in the world (z up).
        velocity: (3,) m/s, in the world frame.
        accel_bias: (3,) m/s², in the body frame.
        gyro_bias: (3,) rad/s, in the body frame.
        covariance: (15, 15) of the error, in the order of `COMPONENTS`; None where it is not known.
    """

    COMPONENTS: ClassVar[tuple[str, ...]] = tuple(
        f"{part}_{axis}_{unit}"
        for part, unit in (
            ("rotation_body", "rad"),
            ("position_body", "m"),
            ("velocity", "m_s"),
            ("accel_bias", "m_s2"),
            ("gyro_bias", "rad_s"),
        )
        for axis in "xyz"
    )

    stamp_ns: int
    world_T_body: gtsam.Pose3
    velocity: FloatArray
    accel_bias: FloatArray = field(kw_only=True)
    gyro_bias: FloatArray = field(kw_only=True)
    covariance: FloatArray | None = field(default=None, kw_only=True)

    def predicted(self, pim: gtsam.PreintegratedCombinedMeasurements, stamp_ns: int) -> NavState:
        """The state at `stamp_ns`, the end of a preintegration that began at this state: g(x_t)."""
        bias = gtsam.imuBias.ConstantBias(self.accel_bias, self.gyro_bias)
        there = pim.predict(gtsam.NavState(self.world_T_body, self.velocity), bias)
        return NavState(
            stamp_ns,
            there.pose(),
            np.asarray(there.velocity()),
            accel_bias=self.accel_bias,
            gyro_bias=self.gyro_bias,
        )

    def __repr__(self) -> str:
        position = ", ".join(f"{value:.3f}" for value in self.world_T_body.translation())
        return f"NavState({seconds_text(self.stamp_ns)} s, position ({position}) m)"


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time, as arrays.

    Attributes:
        MAX_GAP_S: inside a longer gap between poses `interpolate` gives nothing by default: four
            frames at 20 Hz; over more a straight line says little of the motion.
        stamps_ns: (N,) int64, strictly increasing.
        positions: (N, 3) of the body in the world, in metres.
        quaternions: (N, 4) of world_R_body as (x, y, z, w), of unit length.
        velocities: (N, 3) in the world frame, m/s, or None where the source has none.
        accel_biases: (N, 3) m/s², or None. Biases are given by name.
        gyro_biases: (N, 3) rad/s, or None.
    """

    MAX_GAP_S: ClassVar[float] = 0.2

    stamps_ns: IntArray
    positions: FloatArray
    quaternions: FloatArray
    velocities: FloatArray | None = None
    accel_biases: FloatArray | None = field(default=None, kw_only=True)
    gyro_biases: FloatArray | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def pose(self, index: int) -> gtsam.Pose3:
        """`world_T_body` of one row."""
        x, y, z, w = self.quaternions[index]
        return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), self.positions[index])

    def select(self, rows: IntArray | BoolArray) -> Trajectory:
        """Some of the poses, with all that belongs to them."""
        optional = {
            name: None if values is None else values[rows]
            for name in ("velocities", "accel_biases", "gyro_biases")
            for values in (getattr(self, name),)
        }
        stamps_ns, quaternions = self.stamps_ns[rows], self.quaternions[rows]
        return Trajectory(stamps_ns, self.positions[rows], quaternions, **optional)

    def tum_lines(self) -> Iterator[str]:
        """The lines of a TUM file: t[s] x y z qx qy qz qw, with nine decimals."""
        rows = np.hstack([self.positions, self.quaternions])
        for stamp, row in zip(self.stamps_ns, rows, strict=True):
            yield f"{seconds_text(int(stamp))} {' '.join(f'{v:.9f}' for v in row.tolist())}\n"

    def as_dict(self) -> dict[str, FloatArray | IntArray]:
        """All columns (N,) by name with unit, as for `pandas.DataFrame(trajectory.as_dict())`."""
        columns: dict[str, FloatArray | IntArray] = {"stamp_ns": self.stamps_ns}
        for name, values in (
            ("position_{}_m", self.positions),
            ("quaternion_{}", self.quaternions),
            ("velocity_{}_m_s", self.velocities),
            ("accel_bias_{}_m_s2", self.accel_biases),
            ("gyro_bias_{}_rad_s", self.gyro_biases),
        ):
            if values is not None:
                columns |= {
                    name.format(axis): values[:, k]
                    for k, axis in enumerate("xyzw"[: values.shape[1]])
                }
        return columns

    def __repr__(self) -> str:
        if len(self) == 0:
            return "Trajectory(0 poses)"
        length_s = (self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9
        path_m = np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum()
        return f"Trajectory({len(self)} poses, {length_s:.2f} s, {path_m:.2f} m)"


_STATE_WIDTH = 16
"""Position, quaternion (x y z w), velocity, accelerometer bias, gyroscope bias."""

_ERROR_WIDTH = len(NavState.COMPONENTS)
_POSE_WIDTH = 6


class StateHistory:
    """All states of a run, as compact rows: about 0.6 kB a state.

    It grows by one state at a time and gives arrays. Where a state has no covariance its rows are
    NaN.
    """

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._states = array("d")
        self._sigmas = array("d")
        self._pose_covariances = array("d")

    def __len__(self) -> int:
        return len(self._stamps_ns)

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
        variances = np.maximum(np.diag(covariance), 0.0)
        self._stamps_ns.append(state.stamp_ns)
        self._states.extend(row.tolist())
        self._sigmas.extend(np.sqrt(variances).tolist())
        self._pose_covariances.extend(covariance[:_POSE_WIDTH, :_POSE_WIDTH].ravel().tolist())

    def trajectory(self) -> Trajectory:
        """The states as a trajectory with velocities and biases."""
        rows = _table(self._states, _STATE_WIDTH)
        return Trajectory(
            np.array(self._stamps_ns, dtype=np.int64),
            rows[:, 0:3],
            rows[:, 3:7],
            velocities=rows[:, 7:10],
            accel_biases=rows[:, 10:13],
            gyro_biases=rows[:, 13:16],
        )

    def sigmas(self) -> FloatArray:
        """(N, 15) standard deviations, in the order of `NavState.COMPONENTS`."""
        return _table(self._sigmas, _ERROR_WIDTH)

    def pose_covariances(self) -> FloatArray:
        """(N, 6, 6) covariances of rotation and position, in the body frame."""
        return _table(self._pose_covariances, _POSE_WIDTH * _POSE_WIDTH).reshape(
            -1, _POSE_WIDTH, _POSE_WIDTH
        )


def _table(values: array[float], width: int) -> FloatArray:
    """A copy of flat values as rows of `width`."""
    return np.array(values, dtype=np.float64).reshape(-1, width)


def seconds_text(stamp_ns: int) -> str:
    """A time in seconds with all nine decimals, which a float would not keep."""
    sign, magnitude = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{magnitude // 10**9}.{magnitude % 10**9:09d}"


def interpolate(
    trajectory: Trajectory, stamps_ns: IntArray, max_gap_s: float = Trajectory.MAX_GAP_S
) -> tuple[Trajectory, BoolArray]:
    """The trajectory at those of the given times that have poses before and after, near enough.

    Args:
        trajectory: of at least one pose.
        stamps_ns: (M,) increasing times.
        max_gap_s: inside a longer gap between poses nothing is interpolated.

    Returns:
        The trajectory at the K times that can be interpolated, and a mask (M,) of which these are.
    """
    times = trajectory.stamps_ns
    after = np.clip(np.searchsorted(times, stamps_ns), 0, len(times) - 1)
    before = np.where(times[after] == stamps_ns, after, np.maximum(after - 1, 0))
    inside = (times[before] <= stamps_ns) & (stamps_ns <= times[after])
    valid = inside & (times[after] - times[before] <= round(max_gap_s * 1e9))
    before, after, queries = before[valid], after[valid], stamps_ns[valid]
    length = np.maximum(times[after] - times[before], 1)
    weight = ((queries - times[before]) / length)[:, None]

    def blend(values: FloatArray | None) -> FloatArray | None:
        if values is None:
            return None
        mixed: FloatArray = values[before] * (1.0 - weight) + values[after] * weight
        return mixed

    positions = blend(trajectory.positions)
    assert positions is not None
    return (
        Trajectory(
            queries,
            positions,
            _slerp(trajectory.quaternions[before], trajectory.quaternions[after], weight),
            blend(trajectory.velocities),
            accel_biases=blend(trajectory.accel_biases),
            gyro_biases=blend(trajectory.gyro_biases),
        ),
        valid,
    )


def _slerp(start: FloatArray, end: FloatArray, weight: FloatArray) -> FloatArray:
    """Quaternions (K, 4) at weights (K, 1) of the way from `start` to `end`."""
    if len(start) == 0:
        return start
    first = Rotation.from_quat(start)
    step = (first.inv() * Rotation.from_quat(end)).as_rotvec()
    return np.asarray((first * Rotation.from_rotvec(step * weight)).as_quat())
