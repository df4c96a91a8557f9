# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A rig: cameras and one IMU, rigidly connected, with their calibration, given or estimated.

The body frame is the IMU frame. `CalibrationEstimate` is the result of online calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.errors import DataError
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.depth import DepthSensor
from slam_graph.sensors.perspective import camera_pose, pose_from_guess

_STAMPED_ROWS = {"first": 0.0, "middle": 0.5, "last": 1.0}
"""Rows of a rolling shutter that a stamp may be the time of, as parts of the height."""

_INTEGRATION_SIGMA = 1e-5
"""Error of the position integration itself, m/√s; it keeps the preintegrated covariance regular."""
_UNIT = np.eye(3)
_INTEGRATION_COVARIANCE = _UNIT * _INTEGRATION_SIGMA**2


@dataclass(frozen=True)
class ImuNoise:
    """Noise of an IMU, as continuous-time densities like those of Kalibr and EuRoC.

    Attributes:
        gyro_noise_density: rad/s/√Hz.
        gyro_random_walk: rad/s²/√Hz.
        accel_noise_density: m/s²/√Hz.
        accel_random_walk: m/s³/√Hz.
        rate_hz: nominal sampling rate.
    """

    gyro_noise_density: float = 1.6968e-4
    gyro_random_walk: float = 1.9393e-5
    accel_noise_density: float = 2.0e-3
    accel_random_walk: float = 3.0e-3
    rate_hz: float = 200.0

    def preintegration_params(
        self,
        gravity: float,
        scale: float = 1.0,
        gyro_scale: float = 1.0,
        accel_scale: float = 1.0,
    ) -> gtsam.PreintegrationCombinedParams:
        """GTSAM's parameters for this IMU.

        Args:
            gravity: magnitude in m/s²; the world's z axis points up.
            scale: factor on all densities.
            gyro_scale: factor on the white noise of the gyroscope.
            accel_scale: factor on that of the accelerometer.
        """
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)
        gyro = scale * gyro_scale * self.gyro_noise_density
        accel = scale * accel_scale * self.accel_noise_density
        params.setGyroscopeCovariance(_UNIT * gyro**2)
        params.setAccelerometerCovariance(_UNIT * accel**2)
        params.setBiasOmegaCovariance(_UNIT * (scale * self.gyro_random_walk) ** 2)
        params.setBiasAccCovariance(_UNIT * (scale * self.accel_random_walk) ** 2)
        params.setIntegrationCovariance(_INTEGRATION_COVARIANCE)
        return params


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera where it is mounted.

    Attributes:
        camera: intrinsics.
        body_T_camera: pose of the camera in the body (IMU) frame.
        time_offset_s: t_imu = t_camera + time_offset_s (Kalibr's `timeshift_cam_imu`).
        name: of the camera in its data set, e.g. ``cam0``.
        rolling_shutter: whether its rows are exposed one after the other. Where `readout_s` is not
            known, the estimator takes them as exposed at one time all the same.
        readout_s: time from the exposure of row 0 to that of a row below the last, which is
            Kalibr's `line_delay` times the height; 0 for a global shutter, or where it is not
            known; negative if the last row is read first.
        stamped_row: the row that is exposed at the stamp of a frame: the first, as with Kalibr and
            most drivers, or the `middle` or the `last` one.
        rotation_known: whether the rotation of `body_T_camera` is calibrated; otherwise it is
            estimated before a start.
    """

    camera: Camera
    body_T_camera: gtsam.Pose3
    time_offset_s: float = 0.0
    name: str = ""
    rolling_shutter: bool = False
    readout_s: float = 0.0
    stamped_row: Literal["first", "middle", "last"] = "first"
    rotation_known: bool = True

    def body_pose(
        self,
        points: FloatArray,
        rays: FloatArray,
        error_px: float,
        least: int = 4,
        tightened: bool = False,
        guess: gtsam.Pose3 | None = None,
    ) -> tuple[gtsam.Pose3, BoolArray] | None:
        """world_T_body by points that this camera sees, and which of them fit it.

        By PnP with RANSAC, or from a guess.

        Args:
            points: (N, 3) in the world, m.
            rays: (N, 2) where the camera sees them, on its plane z = 1.
            error_px: largest error of a point that fits.
            least: how many points must fit.
            tightened: see `camera_pose`.
            guess: world_T_body nearby; see `pose_from_guess`.

        Returns:
            The pose, and (N,) which points are in front of the camera and fit; None without a pose.
        """
        focal_px = float(np.sqrt(self.camera.fx * self.camera.fy))
        error = error_px / focal_px
        if guess is None:
            found = camera_pose(points, rays, error, least, tightened)
        else:
            camera_T_world = guess.compose(self.body_T_camera).inverse()
            found = pose_from_guess(points, rays, error, camera_T_world, least)
        if found is None:
            return None
        camera_T_world, fits = found
        return camera_T_world.inverse().compose(self.body_T_camera.inverse()), fits

    def row_times_s(self, rows: FloatArray) -> FloatArray:
        """Times (N,) of the exposure of rows (N,), in pixels, since the stamp of the frame."""
        return self.row_parts(rows) * self.readout_s

    def row_parts(self, rows: FloatArray) -> FloatArray:
        """The same times (N,) as parts of the readout time."""
        parts: FloatArray = rows / self.camera.height - _STAMPED_ROWS[self.stamped_row]
        return parts

    @property
    def middle_s(self) -> float:
        """Time of the exposure of the middle row since the stamp of the frame."""
        return (0.5 - _STAMPED_ROWS[self.stamped_row]) * self.readout_s

    @property
    def clock_offset_s(self) -> float:
        """From the stamp of a frame to when its middle row is exposed, on the clock of the IMU."""
        return self.time_offset_s + self.middle_s

    @property
    def end_s(self) -> float:
        """Time of the last exposure of a row since the stamp of the frame."""
        start = -_STAMPED_ROWS[self.stamped_row] * self.readout_s
        return max(start, start + self.readout_s)


@dataclass(frozen=True, eq=False)
class Rig:
    """All calibrated sensors of a platform.

    Attributes:
        cameras: in the order of the images of a frame.
        imu: noise of the IMU.
        has_imu: whether there is an IMU; without one, `imu` means nothing.
        depth: what measures the depth of the points that one of the cameras sees; None where
            nothing does.
        has_odometry: whether the odometry of wheels or legs measures how far the body moves.
    """

    cameras: tuple[RigCamera, ...]
    imu: ImuNoise = field(default_factory=ImuNoise)
    has_imu: bool = True
    depth: DepthSensor | None = None
    has_odometry: bool = False

    @property
    def rolling(self) -> bool:
        """Whether any camera has a rolling shutter with a known readout time."""
        return any(mounted.readout_s != 0.0 for mounted in self.cameras)

    @property
    def has_scale(self) -> bool:
        """Whether anything measures lengths: an IMU, a second camera, depth, or odometry."""
        return not self.needs_two_views or self.has_odometry

    @property
    def sees_depth(self) -> bool:
        """Whether the images of one time measure lengths: by a second camera, or depth."""
        return len(self.cameras) > 1 or self.depth is not None

    @property
    def needs_two_views(self) -> bool:
        """Whether a start takes two views of different times: one camera alone, without an IMU."""
        return not (self.has_imu or self.sees_depth)

    @property
    def scaled_camera(self) -> gtsam.Pose3 | None:
        """body_T_camera of the only camera, where nothing measures lengths; else None.

        Its path has a scale of its own then, while its place in the body is in metres.
        """
        return None if self.has_scale else self.cameras[0].body_T_camera

    @property
    def pose_offset_s(self) -> float:
        """Time of the pose of a frame, on the clock of the IMU, since the frame's stamp.

        The pose is that at the exposure of the middle row of the first camera.
        """
        return self.cameras[0].clock_offset_s

    @property
    def end_offset_s(self) -> float:
        """Time of the last exposure of a frame, on the clock of the IMU, since its stamp."""
        return self.cameras[0].time_offset_s + max(c.end_s for c in self.cameras)

    def select(self, count: int) -> Rig:
        """The same rig with its first `count` cameras only."""
        if not 1 <= count <= len(self.cameras):
            raise DataError(f"asked for {count} cameras, the rig has {len(self.cameras)}")
        depth = self.depth if self.depth is None or self.depth.camera < count else None
        return replace(self, cameras=self.cameras[:count], depth=depth)

    def shifted(self, shift_s: float) -> Rig:
        """The same rig if the clock of the IMU were later by some seconds."""
        offsets_s = [mounted.time_offset_s + shift_s for mounted in self.cameras]
        cameras = zip(self.cameras, offsets_s, strict=True)
        return replace(self, cameras=tuple(replace(m, time_offset_s=s) for m, s in cameras))

    def without_imu(self) -> Rig:
        """The same rig without its IMU; the body frame stays where it is."""
        cameras = tuple(replace(mounted, rotation_known=True) for mounted in self.cameras)
        return replace(self, cameras=cameras, has_imu=False)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of a calibration.

    Attributes:
        name: with the camera and the unit, e.g. ``cam0_fx_px``.
        start: calibrated value, from which the estimation started.
        value: estimate.
        sigma: standard deviation of the estimate.
    """

    name: str
    start: float
    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEstimate:
    """An estimate of some parameters of a rig at one time.

    Attributes:
        stamp_ns: time of the estimate on the clock of the IMU.
        nominal: the rig that the estimation started from.
        rig: with the estimated parameters.
        covariances: of each variable that was estimated: `e0` (6, 6) of the pose of camera 0, in
            its tangent (rad and m, camera frame); `k0` (4, 4) of its intrinsics in pixels; `d0`
            (n, n) of the n coefficients of its camera model; `t0` (1, 1) of the time offset and
            `t1` of the readout time in seconds.
        baseline_sigmas_m: standard deviations of the distances from the first camera to each of the
            others, which are known better than the places of all cameras in the body; () if they
            were not asked for.
    """

    stamp_ns: int
    nominal: Rig
    rig: Rig
    covariances: Mapping[str, FloatArray]
    baseline_sigmas_m: Sequence[float] = ()

    def parameters(self) -> list[Parameter]:
        """All parameters that were estimated.

        Rotations are from the calibrated to the estimated camera frame, as a rotation vector in the
        former; positions are those of the camera in the body.
        """
        table: list[Parameter] = []
        for variable, covariance in self.covariances.items():
            names, start, values = self._values(variable)
            if variable.startswith("e"):
                R = self.rig.cameras[int(variable[1:])].body_T_camera.rotation().matrix()
                in_body = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), R]])
                covariance = in_body @ covariance @ in_body.T
            sigmas = np.sqrt(np.diag(covariance))
            table += map(Parameter, names, start.tolist(), values.tolist(), sigmas.tolist())
        return table

    def table(self) -> dict[str, dict[str, float]]:
        """Start, value and standard deviation of each parameter by its name."""
        return {
            parameter.name: {
                "start": parameter.start,
                "value": parameter.value,
                "sigma": parameter.sigma,
            }
            for parameter in self.parameters()
        }

    def _values(self, variable: str) -> tuple[list[str], FloatArray, FloatArray]:
        """Names of a variable's parameters, their calibrated values, and their estimates."""
        kind, c = variable[0], int(variable[1:])
        if variable == "t1":
            readouts = [np.array([rig.cameras[0].readout_s]) for rig in (self.nominal, self.rig)]
            return ["readout_s"], readouts[0], readouts[1]
        before, now = self.nominal.cameras[c], self.rig.cameras[c]
        if kind == "t":
            offsets = [np.array([mounted.time_offset_s]) for mounted in (before, now)]
            return ["time_offset_s"], offsets[0], offsets[1]
        if kind == "e":
            names = [f"rotation_{axis}_rad" for axis in "xyz"]
            names += [f"position_{axis}_m" for axis in "xyz"]
            turn = before.body_T_camera.rotation().between(now.body_T_camera.rotation())
            start = np.concatenate([np.zeros(3), before.body_T_camera.translation()])
            values = np.concatenate([gtsam.Rot3.Logmap(turn), now.body_T_camera.translation()])
        elif kind == "k":
            names = ["fx_px", "fy_px", "cx_px", "cy_px"]
            start, values = before.camera.intrinsics, now.camera.intrinsics
        else:
            names = [f"distortion_{n}" for n in range(len(now.camera.coefficients))]
            start = np.array(before.camera.coefficients)
            values = np.array(now.camera.coefficients)
        return [f"cam{c}_{name}" for name in names], start, values
