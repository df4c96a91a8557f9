# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Online calibration: which parameters of the rig are variables of the state, and their prior.

`E(c)` is the pose body_T_camera of camera c, `K(c)` its (fx, fy, cx, cy), `distortion_key(c, n)`
the n coefficients of its distortion, `T(0)` the time offset t_imu - t_camera in seconds and `T(1)`
the readout time of rolling shutters, one for the rig. They are in the state and in its prior from
the start and are never marginalized.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, K, T

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import CalibrationConfig
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import (
    FrameMotion,
    State,
    dim,
    dims_of,
    distortion_key,
    letter_and_index,
)
from slam_graph.geometry import NavState
from slam_graph.sensors import (
    CalibrationEstimate,
    Camera,
    FeatureFrame,
    ImuBuffer,
    Rig,
    RigCamera,
)

MAX_EARLY_NS = 50_000_000
"""A frame may be taken this much too early where the IMU has no samples yet."""

GRAVITY = np.array([0.0, 0.0, -9.81])
"""m/s², in the world; over a readout its last digits do not count."""

_SHORTEST_SPAN_S = 0.02
"""Angular rates are fitted to the samples of at least this time around a frame."""

_LARGE_STEP_SIGMAS = 0.3
"""A step that moves the parameters by more standard deviations (root mean square) is repeated, with
the residuals linearised at the new parameters."""


class CalibrationVariables:
    """Which parameters of a rig are variables.

    Attributes:
        nominal: the rig as it was calibrated before.
        keys: of the variables, camera by camera, the time offset last; empty if there are none.
        estimates_offset: whether the time offset is one of them.
        estimates_readout: whether the readout time is one of them.
        rolling: whether a shutter rolls.
    """

    def __init__(self, nominal: Rig, config: CalibrationConfig) -> None:
        self.nominal = nominal
        self.config = config
        self.estimates_offset = config.time_offset
        self.estimates_readout = config.readout
        self.rolling = nominal.rolling or config.readout
        self.keys = tuple(self._keys())

    @property
    def extrinsics(self) -> tuple[int, ...]:
        """Keys of the mountings, camera by camera, as far as they are variables."""
        return tuple(key for key in self.keys if letter_and_index(key)[0] == "e")

    def _keys(self) -> Iterator[int]:
        for c, mounted in enumerate(self.nominal.cameras):
            if self.config.extrinsics:
                yield E(c)
            if self.config.intrinsics:
                yield K(c)
            if self.config.distortion and mounted.camera.coefficients:
                yield distortion_key(c, len(mounted.camera.coefficients))
        if self.config.time_offset:
            yield T(0)
        if self.config.readout:
            yield T(1)

    # --- prior ------------------------------------------------------------------------------------

    def enter(self, state: State, prior: SquareRootInformation) -> SquareRootInformation:
        """Add the parameters to a state, at their nominal values.

        Args:
            state: gets the parameters.
            prior: on the variables that are in the state.

        Returns:
            The prior on the state, extended by that on the parameters.
        """
        if not self.keys:
            return prior
        state.insert(self._nominal_values())
        state.freeze(self.keys)
        sigmas = np.concatenate([self._sigmas(key) for key in self.keys])
        n = prior.layout.size
        rows = np.zeros((len(sigmas), n + len(sigmas) + 1))
        rows[:, n:-1] = np.diag(1.0 / sigmas)
        return prior.extended(dims_of(self.keys)).updated(rows)

    def _nominal_values(self) -> gtsam.Values:
        values = gtsam.Values()
        for key in self.keys:
            kind, c = letter_and_index(key)
            if kind == "t":
                first = self.nominal.cameras[0]
                values.insert(key, np.array([first.readout_s if c else first.time_offset_s]))
                continue
            mounted = self.nominal.cameras[c]
            if kind == "e":
                values.insert(key, mounted.body_T_camera)
            elif kind == "k":
                values.insert(key, mounted.camera.intrinsics)
            else:
                values.insert(key, np.array(mounted.camera.coefficients))
        return values

    def _sigmas(self, key: int) -> FloatArray:
        """Prior standard deviations (dim,) of a variable, in its tangent."""
        kind, c = letter_and_index(key)
        if kind == "t" and c:
            return np.array([self.config.readout_sigma_s])
        return prior_sigmas(kind, self.nominal.cameras[c].camera, self.config)

    def moved_far(self, posterior: SquareRootInformation, delta: FloatArray) -> bool:
        """Whether a step (n,) moved the parameters far, compared to their standard deviations.

        Over such a step the residuals are not linear in the parameters.
        """
        step = delta[posterior.layout.indices(self.keys)]
        covariance = posterior.covariance_of(self.keys)
        return float(step @ np.linalg.solve(covariance, step)) > _LARGE_STEP_SIGMAS**2 * len(step)

    # --- estimate ---------------------------------------------------------------------------------

    def rig(self, values: gtsam.Values) -> Rig:
        """The rig with the parameters that are in `values`."""
        shift_s = self._shift_s(values)
        cameras = (
            self._camera(c, mounted, values, shift_s)
            for c, mounted in enumerate(self.nominal.cameras)
        )
        return replace(self.nominal, cameras=tuple(cameras))

    def _shift_s(self, values: gtsam.Values) -> float:
        """Difference of the estimated time offset from the nominal one, in seconds."""
        if not self.estimates_offset:
            return 0.0
        return float(values.atVector(T(0))[0]) - self.nominal.cameras[0].time_offset_s

    def _camera(
        self, c: int, mounted: RigCamera, values: gtsam.Values, shift_s: float
    ) -> RigCamera:
        camera, body_T_camera = mounted.camera, mounted.body_T_camera
        if E(c) in self.keys:
            body_T_camera = values.atPose3(E(c))
        if K(c) in self.keys:
            fx, fy, cx, cy = values.atVector(K(c)).tolist()
            camera = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)
        distortion = distortion_key(c, len(camera.coefficients))
        if distortion in self.keys:
            camera = replace(camera, coefficients=tuple(values.atVector(distortion).tolist()))
        readout_s = mounted.readout_s
        if self.estimates_readout:
            readout_s += float(values.atVector(T(1))[0]) - self.nominal.cameras[0].readout_s
        return replace(
            mounted,
            camera=camera,
            body_T_camera=body_T_camera,
            time_offset_s=mounted.time_offset_s + shift_s,
            readout_s=readout_s,
        )

    def estimate(
        self, stamp_ns: int, state: State, information: SquareRootInformation
    ) -> CalibrationEstimate:
        """Values and standard deviations now.

        Args:
            stamp_ns: time of the estimate.
            state: its parameters are at the estimate.
            information: about an increment of the estimates, in the tangents at the first ones.
        """
        covariance = information.covariance_of(self.keys)
        blocks, start = {}, 0
        for key in self.keys:
            stop = start + dim(key)
            block = covariance[start:stop, start:stop]
            letter, c = letter_and_index(key)
            if letter == "e":  # from the first estimate's tangent to this one's
                turn = gtsam.Pose3.ExpmapDerivative(state.offset_of(key))
                block = turn @ block @ turn.T
            blocks[f"{letter}{c}"] = block
            start = stop
        return CalibrationEstimate(stamp_ns, self.nominal, self.rig(state.frames), blocks)

    # --- time offset ------------------------------------------------------------------------------

    def stamp(self, frame_ns: int, state: State | None, imu: ImuBuffer) -> int:
        """Time of a frame on the clock of the IMU, by the current estimate of the time offset.

        Of a rolling shutter it is that of the middle row. The frame may be later than the last IMU
        sample that came with it. Then the time of the last sample is taken, and the projection
        bridges the rest of the offset by the velocity of the body (see `note_motion`).
        Extrapolating the IMU instead would leave an error in the dynamics that no later sample
        corrects.
        """
        offset_s = self.nominal.pose_offset_s
        if state is None or not (self.estimates_offset or self.rolling):
            return frame_ns + round(offset_s * 1e9)
        if self.estimates_offset:
            offset_s = float(state.frames.atVector(T(0))[0]) + self.nominal.cameras[0].middle_s
        stamp_ns = frame_ns + round(offset_s * 1e9)
        beyond_ns = stamp_ns - imu.newest_ns()
        return stamp_ns - beyond_ns if 0 < beyond_ns <= MAX_EARLY_NS else stamp_ns

    def note_motion(
        self, state: State, frame: int, stamp_ns: int, frame_ns: int, imu: ImuBuffer
    ) -> None:
        """Store the velocity of the body at a frame.

        It shifts the pose when the offset changes, and gives the place of each row of a rolling
        shutter.

        Args:
            state: has the pose, velocity and bias of the frame.
            frame: index of the frame.
            stamp_ns: time of its pose on the clock of the IMU.
            frame_ns: its stamp on the clock of the cameras.
            imu: samples up to the frame.
        """
        if self.rolling:
            now = state.nav_state(frame, stamp_ns, None)
            state.motions[frame] = rolling_motion(now, frame_ns, imu, self.nominal)
            return
        if not self.estimates_offset:
            return
        now = state.nav_state(frame, stamp_ns, None)
        gyro = imu.between(stamp_ns, stamp_ns).gyro[0] - now.gyro_bias
        velocity = now.world_T_body.rotation().unrotate(now.velocity)
        state.motions[frame] = FrameMotion(
            np.concatenate([gyro, velocity]), (stamp_ns - frame_ns) * 1e-9
        )

    def turning(
        self, stamps_ns: Sequence[int], frames: Sequence[FeatureFrame], imu: ImuBuffer
    ) -> dict[int, FrameMotion]:
        """The rotation alone of the body at frames, before there is a state; for rolling shutters.

        Args:
            stamps_ns: times of the poses of frames 0, 1, … on the clock of the IMU.
            frames: the frames.
            imu: samples around them.
        """
        motions: dict[int, FrameMotion] = {}
        for k, (stamp_ns, frame) in enumerate(zip(stamps_ns, frames, strict=True)):
            if self.rolling:
                gyro, slope, _ = imu.trend(stamp_ns, _around_ns(self.nominal))
                rate, change = (np.concatenate([x, np.zeros(3)]) for x in (gyro, slope))
                motions[k] = FrameMotion(rate, (stamp_ns - frame.stamp_ns) * 1e-9, change)
        return motions

    def refine_motion(self, state: State, frame: int, stamp_ns: int, imu: ImuBuffer) -> None:
        """Store the velocity anew, by the estimate after a step; for rolling shutters only.

        It does not depend on the world's origin and heading, so that the frame's observations may
        be linearised at another velocity than before (see `reprojection`).

        Args:
            state: has the pose, velocity and bias of the frame.
            frame: index of the frame.
            stamp_ns: time of its pose on the clock of the IMU.
            imu: samples up to the frame.
        """
        if self.rolling and frame in state.motions:
            lead_ns = round(state.motions[frame].time_offset_s * 1e9)
            self.note_motion(state, frame, stamp_ns, stamp_ns - lead_ns, imu)


def prior_sigmas(letter: str, lens: Camera, config: CalibrationConfig) -> FloatArray:
    """Prior standard deviations of a variable, in its tangent.

    Args:
        letter: `e` for a mounting (6,), rad and m; `k` for focal lengths and principal point (4,),
            pixels; `d` for the n coefficients of the distortion; `t` for the time offset (1,), s.
        lens: of the camera.
        config: settings.
    """
    if letter == "e":
        return np.repeat([config.rotation_sigma_rad, config.position_sigma_m], 3)
    if letter == "k":
        focal = config.focal_length_sigma * lens.intrinsics[:2]
        return np.append(focal, np.repeat(config.principal_point_sigma_px, 2))
    if letter == "d":
        return np.full(len(lens.coefficients), config.distortion_sigma)
    return np.array([config.time_offset_sigma_s])


def rolling_motion(now: NavState, frame_ns: int, imu: ImuBuffer, rig: Rig) -> FrameMotion:
    """How the body moves while the rows of a frame are exposed, by its state and the IMU.

    Args:
        now: state at the frame's pose.
        frame_ns: stamp of the frame on the clock of the cameras.
        imu: samples around the frame.
        rig: with a rolling shutter.
    """
    gyro, slope, force = imu.trend(now.stamp_ns, _around_ns(rig))
    body_R_world = now.world_T_body.rotation().inverse()
    velocity = body_R_world.rotate(now.velocity)
    acceleration = force - now.accel_bias
    if rig.has_imu:
        acceleration = acceleration + body_R_world.rotate(GRAVITY)
    return FrameMotion(
        np.concatenate([gyro - now.gyro_bias, velocity]),
        (now.stamp_ns - frame_ns) * 1e-9,
        np.concatenate([slope, acceleration]),
        now.stamp_ns,
    )


def _around_ns(rig: Rig) -> int:
    """How far before and after a pose the samples count that tell the motion between rows."""
    span_s = max(abs(mounted.readout_s) for mounted in rig.cameras)
    return round(0.5e9 * max(span_s, _SHORTEST_SPAN_S))
