# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The variables of the estimator, each with its estimate and its linearisation point.

Keys follow GTSAM's symbols with one frame index i everywhere: `X(i)` the pose world_T_body of frame
i, `V(i)` its velocity in the world, `B(i)` its IMU bias, `L(j)` the position of feature j in the
world; `E(c)`, `K(c)`, `distortion_key(c, n)` and `T(0)` are parameters of the rig (see
`online_calibration`), `A(0)` and `O(0)` those of the position fixes (see `aiding/fix_calibration`).
Tangents are GTSAM's (rotation before translation in the body frame, accelerometer bias first).

First-estimates Jacobians (Huang, Mourikis & Roumeliotis 2010): once a variable takes part in the
marginal prior, all Jacobians with respect to it are evaluated at the value it had then, its *first
estimate*, which moves with the world only (`aiding/world_linearization`). Otherwise its
linearisation point follows the estimate, and the estimator gains information about unobservable
directions (global position and yaw).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, D, V, X
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.solve.layout_parts import (
    FIRST_POINT,
    LETTER_SHIFT,
    LayoutParts,
    told_apart,
)
from slam_graph.backend.solve.point_table import PointTable
from slam_graph.backend.solve.pose_table import PoseTable
from slam_graph.backend.solve.square_root import Layout
from slam_graph.geometry import NavState

POSE_DIM, VELOCITY_DIM, BIAS_DIM, POINT_DIM = 6, 3, 6, 3
_IMU_STATE_DIMS = {"x": POSE_DIM, "v": VELOCITY_DIM, "b": BIAS_DIM, "l": POINT_DIM}
_CALIBRATION_DIMS = {"e": POSE_DIM, "k": 4, "t": 1, "a": 3, "o": 1}
DIMS = _IMU_STATE_DIMS | _CALIBRATION_DIMS
"""Tangent dimension by the letter of the symbol. Distortion coefficients (`d`) are not here: their
number depends on the camera model, and their keys carry it (see `distortion_key`)."""

INDEX_MASK = (1 << LETTER_SHIFT) - 1
_COUNT_SHIFT = 16
_DIMS_BY_CODE = {ord(letter): size for letter, size in DIMS.items()}
_DISTORTION_CODE, _POSE_CODE = ord("d"), ord("x")


def dim(key: int) -> int:
    """Tangent dimension of the variable of a key."""
    code = key >> LETTER_SHIFT
    if code == _DISTORTION_CODE:
        return (key & INDEX_MASK) >> _COUNT_SHIFT
    return _DIMS_BY_CODE[code]


def distortion_key(camera: int, coefficients: int) -> int:
    """Key of the distortion coefficients of a camera, as a variable.

    Camera models have different numbers of coefficients. The key holds the number, so that layouts
    can be made of keys alone.

    Args:
        camera: index in the rig.
        coefficients: their number, that of `CameraModel.coefficient_names`.
    """
    return int(D(camera + (coefficients << _COUNT_SHIFT)))


def letter_and_index(key: int) -> tuple[str, int]:
    """The letter of a key, and the index of its frame, feature or camera."""
    letter, index = chr(key >> LETTER_SHIFT), key & INDEX_MASK
    return letter, index & ((1 << _COUNT_SHIFT) - 1) if letter == "d" else index


def imu_state_keys(frame: int) -> tuple[int, int, int]:
    """Keys of the pose, velocity and bias of a frame."""
    return X(frame), V(frame), B(frame)


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotion:
    """How the body moved when a frame was taken, for the time offset and rolling shutters.

    Attributes:
        rate: (6,) angular rate (rad/s) and velocity (m/s), both in the body frame.
        time_offset_s: time of the pose, on the clock of the IMU, since the stamp of the frame. For
            a global shutter the time offset under which the pose is that at the frame's time.
        change: (6,) derivatives of the angular rate (rad/s²), and acceleration (m/s²) in the body
            frame; used for rolling shutters only.
        stamp_ns: time of the pose; used for rolling shutters only.
    """

    rate: FloatArray
    time_offset_s: float
    change: FloatArray = field(default_factory=lambda: np.zeros(6))
    stamp_ns: int = 0

    def after(self, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the body was at N times, in its frame at the pose.

        `rate` and `change` may be (N, 6) too: those of N frames, each at one time.

        Args:
            seconds: (N,) since the pose; so short that rates are linear over it.

        Returns:
            Rotations (N, 3, 3) and positions (N, 3).
        """
        t = seconds[:, None]
        moved = self.rate * t + 0.5 * t * t * self.change
        return Rotation.from_rotvec(moved[:, :3]).as_matrix(), moved[:, 3:]

    def rates_after(self, seconds: FloatArray) -> FloatArray:
        """Angular rate and velocity (N, 6) of the body at N times, in its frame then."""
        t = seconds[:, None]
        rates = self.rate + self.change * t
        angles = (self.rate * t + 0.5 * t * t * self.change)[:, :3]
        # from the derivative of the rotation vector, to first order in it
        rates[:, :3] -= 0.5 * np.cross(angles, rates[:, :3])
        rates[:, 3:] = np.einsum("nji,nj->ni", self.after(seconds)[0], rates[:, 3:])
        return rates


class State:
    """Estimates and linearisation points of all variables in the cost.

    Those of features are in arrays, all others are GTSAM's values.

    Attributes:
        frames: current values of all variables but features.
        first_frames: linearisation points of these.
        points: the features.
        motions: of each frame with a pose, where a time offset is estimated or a shutter rolls.
    """

    def __init__(self) -> None:
        self.frames = gtsam.Values()
        self.first_frames = gtsam.Values()
        self.points = PointTable.empty()
        self.motions: dict[int, FrameMotion] = {}
        self._offsets: dict[int, FloatArray] = {}  # arrays are replaced, copies share them
        self._frozen: set[int] = set()
        self._poses: PoseTable | None = None  # once they were asked for
        self._first_poses: PoseTable | None = None

    def copy(self) -> State:
        """An independent copy."""
        other = State.__new__(State)
        other.assign(self)
        return other

    def assign(self, other: State) -> None:
        """Take over all values of another state."""
        self.frames = gtsam.Values(other.frames)
        self.first_frames = gtsam.Values(other.first_frames)
        self.points, self.motions = other.points, dict(other.motions)
        self._offsets, self._frozen = dict(other._offsets), set(other._frozen)
        self._poses, self._first_poses = other._poses, other._first_poses

    # --- reading ---------------------------------------------------------------------------------

    @property
    def estimate(self) -> gtsam.Values:
        """Current values of all variables, as a new object."""
        return _joined(self.frames, self.points.ids, self.points.estimate)

    @property
    def first(self) -> gtsam.Values:
        """Linearisation points of all variables, as a new object."""
        return _joined(self.first_frames, self.points.ids, self.points.first)

    @property
    def offsets(self) -> dict[int, FloatArray]:
        """Tangent (dim,) of every variable at its linearisation point."""
        points = zip(landmark_keys(self.points.ids), self.points.offsets, strict=True)
        return self._offsets | dict(points)

    def offset_of(self, key: int) -> FloatArray:
        """Tangent (dim,) of a variable that is no feature, at its linearisation point."""
        return self._offsets[key]

    @property
    def frozen(self) -> set[int]:
        """Keys whose linearisation point no longer moves."""
        return self._frozen.union(landmark_keys(self.points.ids[self.points.frozen]))

    def variables(self) -> list[int]:
        """Keys of all variables."""
        return [*self._offsets, *landmark_keys(self.points.ids)]

    def poses(self, frames: Iterable[int], first: bool = False) -> tuple[FloatArray, FloatArray]:
        """Rotations (F, 3, 3) and positions (F, 3) of some frames, or their first estimates."""
        known, other = self._poses, self._first_poses
        if first:
            known, other = other, known
        if known is None:
            indices = self._indices() if other is None else list(other.rows)
            known = PoseTable.of(self.first_frames if first else self.frames, indices)
            if first:
                self._first_poses = known
            else:
                self._poses = known
        return known.poses(frames)

    def _indices(self) -> list[int]:
        """Frames that have a pose, ascending."""
        keys = [key for key in self._offsets if key >> LETTER_SHIFT == _POSE_CODE]
        return sorted(key & INDEX_MASK for key in keys)

    def positions_of(self, features: IntArray, first: bool = False) -> FloatArray:
        """Positions (N, 3) of some features, or their first estimates.

        Raises:
            KeyError: if one is not a variable.
        """
        rows = self.points.rows(features)
        places = self.points.first.take(rows, axis=0)
        return places if first else places + self.points.offsets.take(rows, axis=0)

    def both_positions_of(self, features: IntArray) -> tuple[FloatArray, FloatArray]:
        """Positions (N, 3) of some features, and their first estimates.

        Raises:
            KeyError: if one is not a variable.
        """
        rows = self.points.rows(features)
        first = self.points.first.take(rows, axis=0)
        return first + self.points.offsets.take(rows, axis=0), first

    def offset(self, layout: Layout) -> FloatArray:
        """Stacked offset (n,) of the estimates from the linearisation points."""
        parts, offset = LayoutParts.of(layout), np.empty(layout.size)
        offset[parts.of_others] = parts.stacked(self._offsets)
        offset[parts.of_points] = self.points.offsets[self.points.rows(parts.features)]
        return offset

    def nav_state(self, frame: int, stamp_ns: int, covariance: FloatArray | None) -> NavState:
        """The state of a frame that still has its velocity and bias."""
        return nav_state_in(self.frames, frame, stamp_ns, covariance)

    # --- which variables there are ---------------------------------------------------------------

    def insert_imu_state(self, frame: int, state: NavState) -> None:
        """Add the pose, velocity and bias of a new frame."""
        tables = self._poses, self._first_poses
        bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
        new = gtsam.Values()  # without their names, types are tried in turn: 28 µs for a bias
        new.insert(X(frame), pose3=state.world_T_body)
        new.insert(V(frame), np.asarray(state.velocity, dtype=np.float64))
        new.insert(B(frame), constant_bias=bias)
        self._insert(new, imu_state_keys(frame))
        self._poses, self._first_poses = (
            None if table is None else table.with_pose(frame, state.world_T_body)
            for table in tables
        )

    def insert(self, values: gtsam.Values) -> None:
        """Add variables that are no features, such as parameters of rig or position fixes."""
        self._insert(values, values.keys())

    def _insert(self, values: gtsam.Values, keys: Iterable[int]) -> None:
        self.frames.insert(values)
        self.first_frames.insert(values)
        self._poses = self._first_poses = None
        for key in keys:
            self._offsets[key] = np.zeros(dim(key))

    def insert_point(self, feature: int, point: FloatArray) -> None:
        """Add a feature at a world position (3,)."""
        self.insert_points(np.array([feature]), point[None])

    def insert_points(self, features: IntArray, points: FloatArray) -> None:
        """Add features (N,) at world positions (N, 3)."""
        self.points = self.points.with_points(features, points)

    def remove(self, keys: Iterable[int]) -> None:
        """Forget variables."""
        others, features = told_apart(keys)
        self.points = self.points.without(features)
        gone = {key & INDEX_MASK for key in others if key >> LETTER_SHIFT == _POSE_CODE}
        for key in others:
            self.frames.erase(key)
            self.first_frames.erase(key)
            del self._offsets[key]
            self._frozen.discard(key)
        self._poses, self._first_poses = (
            None if table is None else table.without(gone)
            for table in (self._poses, self._first_poses)
        )
        if self.motions:
            self.motions = {i: m for i, m in self.motions.items() if X(i) in self._offsets}

    # --- linearisation points --------------------------------------------------------------------

    def relinearize(self) -> None:
        """Move the linearisation points of all variables that are not frozen to their estimates."""
        self.points = self.points.relinearized(self.points.frozen)
        tangents = gtsam.VectorValues()
        for key, offset in self._offsets.items():
            if key not in self._frozen and np.count_nonzero(offset):  # `any` takes longer
                tangents.insert(key, offset)
                self._offsets[key] = np.zeros(len(offset))
        if tangents.size():  # as the estimates were made, so that they are the same to the bit
            self.first_frames, self._first_poses = self.first_frames.retract(tangents), None

    def freeze(self, keys: Iterable[int]) -> None:
        """Hold the linearisation points of variables where they are."""
        others, features = told_apart(keys)
        self._frozen.update(others)
        self.points = self.points.with_frozen(features)

    def freeze_all_of(self, layout: Layout) -> None:
        """`freeze` the variables of a layout, in less time than by their keys."""
        parts = LayoutParts.of(layout)
        self._frozen.update(parts.keys)
        self.points = self.points.with_frozen(parts.features)

    def rebase(self) -> None:
        """Move all linearisation points to the estimates, the frozen ones too."""
        self._frozen.clear()
        self.points = self.points.relinearized(np.zeros(len(self.points.ids), np.bool_))
        self.relinearize()

    # --- moving ----------------------------------------------------------------------------------

    def update(self, layout: Layout, delta: FloatArray) -> None:
        """Add an increment (n,) to the tangents at the linearisation points."""
        parts = LayoutParts.of(layout)
        self.points = self.points.moved(parts.features, delta[parts.of_points])
        moved = parts.stacked(self._offsets) + delta[parts.of_others]
        self._offsets.update(zip(parts.keys, map(moved.__getitem__, parts.slices), strict=True))
        tangents = gtsam.VectorValues()
        for key, offset in self._offsets.items():
            tangents.insert(key, offset)
        self.frames, self._poses = self.first_frames.retract(tangents), None

    def moved(self, motion: gtsam.Pose3) -> State:
        """The same state in a world that is moved.

        Args:
            motion: new_T_old of the two worlds; with an IMU a rotation about the vertical, as
                gravity stays.
        """
        other, turn = self.copy(), motion.rotation().matrix()
        other.points = self.points.transformed(turn, motion.translation())
        for values in (other.frames, other.first_frames):
            for key in self._offsets:
                letter = letter_and_index(key)[0]
                if letter == "x":
                    values.update(key, motion.compose(values.atPose3(key)))
                elif letter == "v":
                    values.update(key, turn @ values.atVector(key))
        for key, offset in self._offsets.items():  # those of poses are of the body
            if letter_and_index(key)[0] == "v":
                other._offsets[key] = turn @ offset
        other._poses = other._first_poses = None
        return other


def _joined(frames: gtsam.Values, ids: IntArray, points: FloatArray) -> gtsam.Values:
    values = gtsam.Values(frames)
    for key, point in zip(landmark_keys(ids), points, strict=True):
        values.insert(key, point)
    return values


def nav_state_in(
    values: gtsam.Values, frame: int, stamp_ns: int, covariance: FloatArray | None
) -> NavState:
    """The state of a frame whose pose, velocity and bias are among some values."""
    bias = values.atConstantBias(B(frame))
    return NavState(
        stamp_ns,
        values.atPose3(X(frame)),
        np.asarray(values.atVector(V(frame))),
        accel_bias=np.asarray(bias.accelerometer()),
        gyro_bias=np.asarray(bias.gyroscope()),
        covariance=covariance,
    )


def features_of(layout: Layout) -> IntArray:
    """Ids (J,) of the features of a layout, in the order of its columns."""
    return LayoutParts.of(layout).features


def landmark_keys(ids: IntArray) -> list[int]:
    """Keys of features (J,): GTSAM's symbols have their index in the lowest bits."""
    keys: list[int] = (ids + FIRST_POINT).tolist()
    return keys


def dims_of(keys: Iterable[int]) -> Mapping[int, int]:
    """Dimension of each key."""
    return {key: dim(key) for key in keys}
