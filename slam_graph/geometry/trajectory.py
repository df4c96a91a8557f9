# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States and trajectories: one state, poses over time, their interpolation, and TUM's format.

The accelerometer bias stands before the gyroscope bias everywhere: in the fields, in the covariance
of a state (where it is GTSAM's order), and in the columns of ``states.csv``.

Interpolation of trajectories: positions linearly, orientations by slerp.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, overload

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.display import Displayed
from slam_graph.errors import ConfigError, DataError, closest
from slam_graph.files import Files

TrajectoryFormat = Literal["tum", "kitti", "euroc"]


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
class Trajectory(Displayed):
    """Poses over time, as arrays.

    `trajectory[5]` is a pose, `trajectory[100:200]` (or rows, or a mask) a part of it, and a loop
    goes over the poses; `trajectory.stamps_ns` has their times.

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

    def __iter__(self) -> Iterator[gtsam.Pose3]:
        return (self.pose(row) for row in range(len(self)))

    @overload
    def __getitem__(self, rows: int) -> gtsam.Pose3: ...
    @overload
    def __getitem__(self, rows: slice | IntArray | BoolArray) -> Trajectory: ...
    def __getitem__(self, rows: int | slice | IntArray | BoolArray) -> gtsam.Pose3 | Trajectory:
        if isinstance(rows, int | np.integer):
            return self.pose(int(rows))
        return self.select(rows)

    def pose(self, index: int) -> gtsam.Pose3:
        """`world_T_body` of one row."""
        x, y, z, w = self.quaternions[index]
        return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), self.positions[index])

    def at(self, stamp_ns: int, max_gap_s: float = MAX_GAP_S) -> gtsam.Pose3:
        """`world_T_body` at any time: positions are interpolated linearly, orientations by slerp.

        Args:
            stamp_ns: time, a whole number of nanoseconds as in `stamps_ns`.
            max_gap_s: inside a longer gap between poses nothing is interpolated.

        Raises:
            DataError: if there is no pose before and after, near enough, or the time is not whole.
        """
        if not isinstance(stamp_ns, int | np.integer):
            raise DataError(
                f"at({stamp_ns!r}): a time is a whole number of nanoseconds, as in stamps_ns; for "
                "seconds after the first pose give trajectory.stamps_ns[0] + round(seconds * 1e9)"
            )
        if len(self):
            found, _ = interpolate(self, np.array([stamp_ns], np.int64), max_gap_s)
            if len(found):
                return found.pose(0)
        span = f"from {_time_text(self, 0)} to {_time_text(self, -1)} s" if len(self) else "empty"
        raise DataError(
            f"no pose at {seconds_text(stamp_ns)} s: the trajectory is {span}, and gaps of more "
            f"than {max_gap_s:g} s are not bridged"
        )

    @staticmethod
    def concatenate(parts: Sequence[Trajectory]) -> Trajectory:
        """Trajectories that follow one another, at least one, with the columns that all have."""
        optional = {
            name: np.concatenate(columns)
            for name in ("velocities", "accel_biases", "gyro_biases")
            for columns in ([getattr(part, name) for part in parts],)
            if all(values is not None for values in columns)
        }
        stamps_ns = np.concatenate([part.stamps_ns for part in parts])
        positions = np.concatenate([part.positions for part in parts])
        quaternions = np.concatenate([part.quaternions for part in parts])
        return Trajectory(stamps_ns, positions, quaternions, **optional)

    def select(self, rows: slice | IntArray | BoolArray) -> Trajectory:
        """Some of the poses, with all that belongs to them."""
        optional = {
            name: None if values is None else values[rows]
            for name in ("velocities", "accel_biases", "gyro_biases")
            for values in (getattr(self, name),)
        }
        stamps_ns, quaternions = self.stamps_ns[rows], self.quaternions[rows]
        return Trajectory(stamps_ns, self.positions[rows], quaternions, **optional)

    def mounted(self, body_T_part: gtsam.Pose3) -> Trajectory:
        """The poses of a part that is mounted on the body, such as a camera."""
        mounting, turns = body_T_part.matrix(), Rotation.from_quat(self.quaternions)
        positions = self.positions + turns.apply(mounting[:3, 3])
        turned = turns * Rotation.from_matrix(mounting[:3, :3])
        return Trajectory(self.stamps_ns, positions, turned.as_quat())

    def tum_lines(self) -> Iterator[str]:
        """The lines of a TUM file: t[s] x y z qx qy qz qw, with nine decimals."""
        rows = np.hstack([self.positions, self.quaternions])
        for stamp, row in zip(self.stamps_ns, rows, strict=True):
            yield f"{seconds_text(int(stamp))} {' '.join(f'{v:.9f}' for v in row.tolist())}\n"

    def kitti_lines(self) -> Iterator[str]:
        """The lines of a KITTI odometry file: the rows of world_T_body (3 x 4); it has no times."""
        for quaternion, t in zip(self.quaternions, self.positions, strict=True):
            R = Rotation.from_quat(quaternion).as_matrix()
            yield " ".join(f"{v:.9e}" for v in np.column_stack([R, t]).ravel().tolist()) + "\n"

    def euroc_lines(self) -> Iterator[str]:
        """The lines of EuRoC's ground truth: t[ns] p q(w x y z), and velocity and biases if known.

        Velocity, gyroscope bias and accelerometer bias come together; where one is not known none
        is written but a velocity alone.
        """
        columns = [self.positions, self.quaternions[:, [3, 0, 1, 2]]]
        names = [*(f"p_{axis} [m]" for axis in "xyz"), *(f"q_{axis} []" for axis in "wxyz")]
        extra = (
            (self.velocities, "v_{} [m s^-1]"),
            (self.gyro_biases, "b_w_{} [rad s^-1]"),
            (self.accel_biases, "b_a_{} [m s^-2]"),
        )
        whole = all(values is not None for values, _ in extra)
        for values, name in extra if whole else extra[:1]:
            if values is not None:
                columns.append(values)
                names += [name.format(axis) for axis in "xyz"]
        yield ",".join(["#timestamp [ns]", *names]) + "\n"
        for stamp, row in zip(self.stamps_ns.tolist(), np.hstack(columns), strict=True):
            yield f"{stamp},{','.join(f'{v:.9f}' for v in row.tolist())}\n"

    def save(self, path: Path | str, format: TrajectoryFormat | None = None) -> Path:
        """Write the trajectory as a file.

        Args:
            path: of the file, which is replaced when the new one is complete.
            format: `tum`, `kitti` (without times) or `euroc` (CSV); by default `euroc` for a name
                that ends with `.csv`, else `tum`.

        Raises:
            DataError: if the format is unknown, or the file cannot be written.
        """
        path = Path(path)
        writers = {"tum": self.tum_lines, "kitti": self.kitti_lines, "euroc": self.euroc_lines}
        format = format or ("euroc" if path.suffix == ".csv" else "tum")
        if format not in writers:
            raise DataError(f"no trajectory format '{format}'; {closest(format, writers)}")
        Files.make_folder(path.parent)
        Files.write_text(path, writers[format]())
        return path

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

    def to_dataframe(self) -> Any:
        """All columns as a pandas table, by the time since the first pose in seconds.

        Raises:
            ConfigError: if pandas is not installed.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError as error:
            raise ConfigError("to_dataframe needs pandas: pip install pandas") from error
        first = self.stamps_ns[0] if len(self) else 0
        seconds = (self.stamps_ns - first) * 1e-9
        return pandas.DataFrame(self.as_dict(), index=pandas.Index(seconds, name="time_s"))

    def plot(self, **others: Trajectory) -> Any:
        """The path from above and from the side, and x, y, z and yaw over time, as a figure.

        Args:
            others: further trajectories in the same world, by their names, such as `smoothed` or
                `ground_truth`.
        """
        return self._drawn_by("notebook_figures").trajectory_figure(self, others)

    @property
    def duration_s(self) -> float:
        """From the first to the last pose, s."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9 if len(self) else 0.0

    @property
    def length_m(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def __repr__(self) -> str:
        if len(self) == 0:
            return "Trajectory(0 poses)"
        return f"Trajectory({len(self)} poses, {self.duration_s:.2f} s, {self.length_m:.2f} m)"

    def _facts(self) -> dict[str, object]:
        columns = {"velocities": self.velocities, "gyro_biases": self.gyro_biases}
        known = [name for name, values in columns.items() if values is not None]
        if not len(self):
            return {"poses": 0}
        extent = " x ".join(f"{length:.2f}" for length in np.ptp(self.positions, axis=0))
        return {
            "poses": len(self),
            "time": f"{_time_text(self, 0)} to {_time_text(self, -1)} s ({self.duration_s:.2f} s)",
            "path": f"{self.length_m:.2f} m, within {extent} m",
            "also has": ", ".join(known) or None,
        }

    def _sketch(self) -> Any:
        return self._drawn_by("notebook_figures").path_figure({"path": self}) if len(self) else None


def _time_text(trajectory: Trajectory, row: int) -> str:
    """The time of a pose in seconds, with milliseconds."""
    return f"{trajectory.stamps_ns[row] * 1e-9:.3f}"


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
    valid = inside & (times[after] - times[before] <= np.rint(max_gap_s * 1e9))
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
