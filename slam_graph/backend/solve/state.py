# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The variables of the estimator, each with its estimate and its linearisation point.

Keys follow GTSAM's symbols with one frame index i everywhere: `X(i)` the pose world_T_body of frame
i, `V(i)` its velocity in the world, `B(i)` its IMU bias, `L(j)` the position of feature j in the
world; `E(c)`, `K(c)`, `distortion_key(c, n)` and `T(0)` are parameters of the rig (see
`online_calibration`). Tangents are GTSAM's (rotation before translation, both in the body frame;
accelerometer bias before gyroscope bias).

First-estimates Jacobians (Huang, Mourikis & Roumeliotis 2010): once a variable takes part in the
marginal prior, all Jacobians with respect to it are evaluated at the value it had then, its *first
estimate*. Otherwise its linearisation point follows the estimate, and the estimator gains
information about unobservable directions (global position and yaw).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, D, L, V, X
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.solve.square_root import Layout
from slam_graph.geometry import NavState

POSE_DIM, VELOCITY_DIM, BIAS_DIM, POINT_DIM = 6, 3, 6, 3
_IMU_STATE_DIMS = {"x": POSE_DIM, "v": VELOCITY_DIM, "b": BIAS_DIM, "l": POINT_DIM}
_CALIBRATION_DIMS = {"e": POSE_DIM, "k": 4, "t": 1}
DIMS = _IMU_STATE_DIMS | _CALIBRATION_DIMS
"""Tangent dimension by the letter of the symbol. Distortion coefficients (`d`) are not here: their
number depends on the camera model, and their keys carry it (see `distortion_key`)."""

_LETTER_SHIFT = 56  # GTSAM's symbols: the letter is in the highest of eight bytes
_INDEX_MASK = (1 << _LETTER_SHIFT) - 1
_COUNT_SHIFT = 16
_DIMS_BY_CODE = {ord(letter): size for letter, size in DIMS.items()}
_DISTORTION_CODE = ord("d")


def dim(key: int) -> int:
    """Tangent dimension of the variable of a key."""
    code = key >> _LETTER_SHIFT
    if code == _DISTORTION_CODE:
        return (key & _INDEX_MASK) >> _COUNT_SHIFT
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
    letter, index = chr(key >> _LETTER_SHIFT), key & _INDEX_MASK
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
    """

    rate: FloatArray
    time_offset_s: float
    change: FloatArray = field(default_factory=lambda: np.zeros(6))

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

    Attributes:
        first: linearisation point of every variable.
        offsets: tangent (dim,) of every variable at its linearisation point; copies share these, so
            they are replaced and never changed.
        estimate: current values, first ⊕ offsets.
        frozen: keys whose linearisation point no longer moves.
        motions: of each frame with a pose, where a time offset is estimated or a shutter rolls.
    """

    def __init__(self) -> None:
        self.first = gtsam.Values()
        self.estimate = gtsam.Values()
        self.offsets: dict[int, FloatArray] = {}
        self.frozen: set[int] = set()
        self.motions: dict[int, FrameMotion] = {}

    def copy(self) -> State:
        """An independent copy."""
        other = State()
        other.assign(self)
        return other

    def assign(self, other: State) -> None:
        """Take over all values of another state."""
        self.first, self.estimate = gtsam.Values(other.first), gtsam.Values(other.estimate)
        self.offsets = dict(other.offsets)
        self.frozen = set(other.frozen)
        self.motions = dict(other.motions)

    def insert_imu_state(self, frame: int, state: NavState) -> None:
        """Add the pose, velocity and bias of a new frame."""
        bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
        new = gtsam.Values()  # one by one a bias takes 20 µs to insert
        new.insert(X(frame), state.world_T_body)
        new.insert(V(frame), np.asarray(state.velocity, dtype=np.float64))
        new.insert(B(frame), bias)
        self.estimate.insert(new)
        self.first.insert(new)
        for key in imu_state_keys(frame):
            self.offsets[key] = np.zeros(dim(key))

    def insert_point(self, feature: int, point: FloatArray) -> None:
        """Add a feature at a world position (3,)."""
        self.estimate.insert(L(feature), point)
        self.first.insert(L(feature), point)
        self.offsets[L(feature)] = np.zeros(POINT_DIM)

    def insert_calibration(self, values: gtsam.Values) -> None:
        """Add parameters of the rig."""
        self.estimate.insert(values)
        self.first.insert(values)
        for key in values.keys():  # noqa: SIM118
            self.offsets[key] = np.zeros(dim(key))

    def variables(self) -> list[int]:
        """Keys of all variables."""
        return list(self.offsets)

    def remove(self, keys: Iterable[int]) -> None:
        """Forget variables."""
        for key in keys:
            self.estimate.erase(key)
            self.first.erase(key)
            del self.offsets[key]
            self.frozen.discard(key)
        if self.motions:
            self.motions = {i: motion for i, motion in self.motions.items() if X(i) in self.offsets}

    def relinearize(self) -> None:
        """Move the linearisation points of all variables that are not frozen to their estimates."""
        tangents = gtsam.VectorValues()
        for key, offset in self.offsets.items():
            if key not in self.frozen and offset.any():
                tangents.insert(key, offset)
                self.offsets[key] = np.zeros(len(offset))
        if tangents.size():  # as the estimates were made, so that they are the same to the bit
            self.first = self.first.retract(tangents)

    def freeze(self, keys: Iterable[int]) -> None:
        """Hold the linearisation points of variables where they are."""
        self.frozen.update(keys)

    def rebase(self) -> None:
        """Move all linearisation points to the estimates, the frozen ones too."""
        self.frozen.clear()
        self.relinearize()

    def offset(self, layout: Layout) -> FloatArray:
        """Stacked offset (n,) of the estimates from the linearisation points."""
        parts = [self.offsets[key] for key in layout.dims]
        return np.concatenate(parts) if parts else np.zeros(0)

    def update(self, layout: Layout, delta: FloatArray) -> None:
        """Add an increment (n,) to the tangents at the linearisation points."""
        tangents, moved = gtsam.VectorValues(), self.offset(layout) + delta
        for key, columns in layout.columns.items():
            self.offsets[key] = moved[columns]
        for key, offset in self.offsets.items():
            tangents.insert(key, offset)
        self.estimate = self.first.retract(tangents)

    def moved(self, motion: gtsam.Pose3) -> State:
        """The same state in a world that is moved.

        Args:
            motion: new_T_old of the two worlds; with an IMU a rotation about the vertical, as
                gravity stays.
        """
        other, turn = self.copy(), motion.rotation().matrix()
        for values in (other.first, other.estimate):
            for key in self.offsets:
                letter = letter_and_index(key)[0]
                if letter == "x":
                    values.update(key, motion.compose(values.atPose3(key)))
                elif letter == "v":
                    values.update(key, turn @ values.atVector(key))
                elif letter == "l":
                    values.update(key, motion.transformFrom(values.atPoint3(key)))
        for key, offset in self.offsets.items():  # those of poses are of the body
            if letter_and_index(key)[0] in "vl":
                other.offsets[key] = turn @ offset
        return other

    def nav_state(self, frame: int, stamp_ns: int, covariance: FloatArray | None) -> NavState:
        """The state of a frame that still has its velocity and bias."""
        bias = self.estimate.atConstantBias(B(frame))
        return NavState(
            stamp_ns,
            self.estimate.atPose3(X(frame)),
            np.asarray(self.estimate.atVector(V(frame))),
            accel_bias=np.asarray(bias.accelerometer()),
            gyro_bias=np.asarray(bias.gyroscope()),
            covariance=covariance,
        )


def stacked_poses(values: gtsam.Values, frames: Iterable[int]) -> tuple[FloatArray, FloatArray]:
    """Rotations (F, 3, 3) and positions (F, 3) of the poses of some frames."""
    none = np.zeros((0, 4))
    matrices = np.concatenate([none, *(values.atPose3(X(i)).matrix() for i in frames)])
    matrices = matrices.reshape(-1, 4, 4)
    return matrices[:, :3, :3], matrices[:, :3, 3]


def stacked_points(values: gtsam.Values, features: IntArray) -> FloatArray:
    """Positions (J, 3) of some features.

    Raises:
        KeyError: if one is not among the values.
    """
    if len(features) == 0:
        return np.zeros((0, 3))
    keys = np.array(values.keys())
    first, end = keys.searchsorted((L(0), L(_INDEX_MASK)))
    known = keys[first:end] - L(0)
    places = known.searchsorted(features)
    if len(known) == 0 or (known[np.minimum(places, len(known) - 1)] != features).any():
        raise KeyError(f"not all of the features {features.tolist()} are variables")
    # one by one they would take three times as long; these are all variables of three numbers, in
    # the order of keys
    before = sum(dim(key) == POINT_DIM for key in keys[:first].tolist())
    rows = gtsam.utilities.extractPoint3(values)[before + places]
    return np.ascontiguousarray(rows, dtype=np.float64)


def landmark_keys(ids: IntArray) -> list[int]:
    """Keys of features (J,): GTSAM's symbols have their index in the lowest bits."""
    keys: list[int] = (ids + L(0)).tolist()
    return keys


def dims_of(keys: Iterable[int]) -> Mapping[int, int]:
    """Dimension of each key."""
    return {key: dim(key) for key in keys}
