# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the back end that all algorithms share: noise, gating, triangulation, start-up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from slam_graph.errors import ConfigError
from slam_graph.settings import Settings, expert

if TYPE_CHECKING:
    from slam_graph.sensors import AidingData


class AdaptiveNoiseConfig(Settings):
    """White noise of the IMU that is estimated from how the images correct its predictions."""

    enabled: bool = expert(True)
    """Raise the IMU's noise densities while the images correct its predictions by more than these
    allow, or the accelerometer vibrates. Switch it off to use the densities of the calibration as
    they are, for example for an IMU without vibration whose noise was measured."""

    moved: ClassVar[Mapping[str, str]] = {
        name: f"is a constant now: {constant} in backend/cost/adaptive_imu_noise.py"
        for name, constant in (
            ("whiteness_s", "PERSISTENCE_TIME_S"),
            ("size_s", "SIZE_TIME_S"),
            ("response_s", "RESPONSE_TIME_S"),
            ("max_factor", "MAX_FACTOR"),
        )
    }


class NoiseConfig(Settings):
    """Noise of the sensors."""

    pixel_sigma: float = Field(1.0, gt=0)
    """Standard deviation of a feature observation, in pixels. Raise it for blurred or
    rolling-shutter images or an inaccurate calibration: images then count less, and the gate
    rejects fewer features."""
    imu_scale: float = Field(1.0, gt=0)
    """Factor on all noise densities of the IMU. Raise it (2 to 10) if the calibration has those of
    a data sheet, or if images contradict the state and runs diverge: the IMU then counts less."""
    adaptive: AdaptiveNoiseConfig = AdaptiveNoiseConfig()
    """White noise of the IMU that is estimated from how the images correct its predictions."""
    adaptive_pixels: Literal["never", "larger", "clear", "any"] = expert("clear")
    """Estimate the noise of the observations of each camera from the residuals of tracks, between
    a quarter of `pixel_sigma` and four times that, and not less than their drift makes up. clear:
    take it where it is 1.25 times as large or as small, or more. larger: only where it is so much
    larger. any: always. never: take `pixel_sigma`, as GTSAM's smoothers always do."""
    drift_px: float = expert(0.0, ge=0)
    """How far tracks drift off their points in one frame, in pixels along each axis: √n times as
    far in n frames. It is process noise of the features in the state."""
    adaptive_drift: bool = expert(default=True)
    """Estimate `drift_px` from the residuals of tracks; the setting is then what holds until they
    show it, and always where features are linearised anew in every step (`every_step`). GTSAM's
    smoothers take no drift."""
    gravity: float = expert(9.81, gt=0)
    """Magnitude of gravity where it was recorded, in m/s² (9.78 at the equator, 9.83 at the
    poles)."""
    max_imu_gap_s: float = expert(0.03, gt=0)
    """Time between two IMU samples above which some are taken to be missing; the IMU then counts
    for little between the two frames around. Raise it for an IMU slower than 33 Hz."""

    moved: ClassVar[Mapping[str, str]] = {
        "imu_gap_scale": ("is a constant now: IMU_GAP_SCALE in backend/cost/imu_factor.py"),
    }


class TriangulationConfig(Settings):
    """Which triangulated features are accepted."""

    min_depth_m: float = expert(0.1, gt=0)
    """Smallest accepted depth in any camera, in metres. Raise it to ignore parts of the vehicle
    that the cameras see."""
    max_depth_m: float = Field(75.0, gt=0)
    """Largest accepted depth in the first camera, in metres. Raise it for high flights or open
    country, where otherwise few features are left."""
    min_parallax_rad: float = expert(0.01, ge=0)
    """Smallest accepted angle between two rays to a feature."""

    moved: ClassVar[Mapping[str, str]] = {
        "iterations": "is a constant now: STEPS in kernels/ray_triangulation.py",
    }


class GatingConfig(Settings):
    """Outlier rejection inside the back end."""

    confidence: float = expert(0.95, gt=0, lt=1)
    """Share of the correct features that the χ² gate (Mahalanobis distance) accepts. Lower it if
    moving objects disturb the estimate; more correct features are then lost as well."""
    robust_loss: Literal["none", "huber", "cauchy"] | None = None
    """Loss that reduces the weight of large reprojection residuals. `cauchy` lets that of outliers
    vanish, but needs a better start; `none` is for data without outliers, such as simulations.
    Not given: `cauchy` with stereo and RGB-D without an IMU, else `huber`."""

    @property
    def loss(self) -> Literal["none", "huber", "cauchy"]:
        """The robust loss that is given, else `huber`; `Dynamics.of` gives what sensors ask for."""
        return self.robust_loss or "huber"

    moved: ClassVar[Mapping[str, str]] = {
        "robust_width": "is a constant now: WIDTH_2D in backend/cost/robust_loss.py",
    }


class ZeroVelocityConfig(Settings):
    """Zero-velocity updates while the platform stands still."""

    enabled: bool = True
    """Detect standstill and use it. Switch it off for platforms that can move evenly before a scene
    without features nearby: slow even motion may be taken for standstill."""
    max_disparity_px: float = Field(1.0, gt=0)
    """Largest median motion of the features at a standstill, in pixels, between two frames and over
    the window, beyond the noise of the tracks, which is measured. Raise it if standstill is not
    found, lower it if slow motion is taken for standstill. Where many features are on something
    that moves, the limit is a third of this, for the third of the features that moves least."""
    window_s: float = expert(1.0, gt=0)
    """Length of the window over which nothing may have moved."""
    max_gyro_std: float = expert(0.2, gt=0)
    """Largest standard deviation of the angular rate at a standstill, rad/s."""
    max_accel_std: float = expert(2.5, gt=0)
    """Largest standard deviation of the specific force at a standstill, m/s²."""

    moved: ClassVar[Mapping[str, str]] = {
        f"{name}_sigma": (
            f"is a constant now: {name.upper()}_SIGMA in backend/cost/zero_velocity.py"
        )
        for name in ("velocity", "position", "rotation")
    }


class PriorConfig(Settings):
    """Standard deviations of the first state where the data do not determine it."""

    attitude_rad: float = expert(0.0025, gt=0)
    """Roll and pitch, as far as neither bias nor scatter of the accelerometer explains their error:
    0.025 m/s² in the mean of a platform that is taken to stand still."""
    yaw_rad: float = expert(1e-3, gt=0)
    """Yaw, which defines the world frame."""
    position_m: float = expert(1e-3, gt=0)
    """Position, which defines the world frame."""
    velocity: float = expert(0.05, gt=0)
    """Velocity, m/s."""
    gyro_bias: float = expert(0.01, gt=0)
    """Gyroscope bias, rad/s."""
    accel_bias: float = expert(0.1, gt=0)
    """Accelerometer bias, m/s²."""


UnknownScale = Literal["wait", "go_on"]
"""What a start with one camera does as long as the scale is not known."""


class InitializationConfig(Settings):
    """How the first state is found."""

    mode: Literal["auto", "static", "motion", "given", "groundtruth"] = "auto"
    """auto: the state that comes with the data, unless the scale is unknown, or else a start from
    standstill or in motion, whichever is possible first. static, motion: only that one. given: only
    the state that comes with the data. groundtruth: the true state, to compare algorithms without
    their starts."""
    motion_window_s: float = expert(1.5, gt=0)
    """Length of the window from which a start in motion is computed, in seconds. Raise it for slow
    or even motion, which determines scale and gravity only after a while: the start comes later,
    but is more accurate."""
    static_window_s: float = expert(1.0, gt=0)
    """How long the platform must stand still for a static start."""
    unknown_scale: UnknownScale = expert("wait")
    """With one camera, as long as motion does not show the scale to 5 %. wait: no state. go_on:
    begin as soon as it is known to 50 %, which the covariances say; when later motion shows it to
    5 % and contradicts the estimate, begin again in another world."""
    prior: PriorConfig = PriorConfig()
    """Uncertainty of the first state of a static start."""
    fix_gauge: bool = expert(True)
    """Take the position and yaw of the first state as the definition of the world frame, so that
    covariances do not contain their uncertainty."""

    check_calibration: bool = expert(True)
    """Compare the camera's rotation with the gyroscope in the first motion, and take over a
    camera-IMU time offset (up to 0.12 s) that clearly contradicts the calibration; later, correct
    a clock that changes. Switch it off to believe the calibration whatever the data say."""

    moved: ClassVar[Mapping[str, str]] = {
        name: f"is a constant now: {constant} in backend/initialization/{file}.py"
        for name, constant, file in (
            ("static_disparity_px", "STATIC_DISPARITY_PX", "initializer"),
            ("frame_spacing_s", "FRAME_SPACING_S", "initializer"),
            ("retry_s", "RETRY_S", "initializer"),
            ("features", "MAX_FEATURES", "dynamic_refinement"),
            ("min_features", "MIN_FEATURES", "start_diagnosis"),
            ("max_normalized_cost", "MAX_NORMALIZED_COST", "dynamic_refinement"),
            ("max_velocity_sigma", "MAX_VELOCITY_SIGMA", "dynamic_refinement"),
            ("max_scale_sigma", "MAX_SCALE_SIGMA", "dynamic_refinement"),
            ("motion_prior", "MOTION_PRIOR", "dynamic_refinement"),
        )
    }


class CalibrationConfig(Settings):
    """Which parameters of the rig are estimated with the states, and how well they are known.

    Sigmas are standard deviations of the calibration that comes with the data, for each component.
    """

    extrinsics: bool = False
    """Estimate where each camera is mounted on the body. Use it if the mounting was measured by
    hand or has changed since the calibration; it needs rotation about several axes."""
    time_offset: bool = False
    """Estimate the offset from the clock of the cameras to that of the IMU, one for all cameras.
    Use it for cameras without hardware synchronisation; it needs fast motion."""
    intrinsics: bool = False
    """Estimate focal lengths and principal point of each camera. Use it if lens or focus have
    changed since the calibration."""
    distortion: bool = False
    """Estimate the distortion coefficients of each camera. Use it with `intrinsics`, and if
    features cover the whole image."""
    readout: bool = expert(False)
    """Estimate the readout time of rolling shutters, one for all cameras. Use it where it is known
    to some milliseconds only; it needs fast turns."""
    readout_sigma_s: float = expert(0.005, gt=0)
    """Readout time."""
    rotation_sigma_rad: float = expert(0.02, gt=0)
    """Rotation of a camera."""
    position_sigma_m: float = expert(0.02, gt=0)
    """Position of a camera."""
    time_offset_sigma_s: float = expert(0.01, gt=0)
    """Time offset."""
    focal_length_sigma: float = expert(0.01, gt=0)
    """Focal lengths, as a share of them."""
    principal_point_sigma_px: float = expert(5.0, gt=0)
    """Principal point."""
    distortion_sigma: float = expert(0.01, gt=0)
    """Distortion coefficients."""

    @property
    def anything(self) -> bool:
        """Whether any parameter is estimated."""
        lens = self.intrinsics or self.distortion
        return self.extrinsics or self.time_offset or self.readout or lens


class DynamicsConfig(Settings):
    """What predicts the state from frame to frame."""

    model: Literal["auto", "imu", "constant_velocity"] = expert("auto")
    """imu: gyroscope and accelerometer. constant_velocity: linear and angular acceleration are
    white noise, and an IMU is not used. auto: the IMU if the recording has one."""
    accel_density: float = expert(3.0, gt=0)
    """Noise density of the acceleration of `constant_velocity`, m/s²/√Hz: after a time t the
    velocity has changed by this times √t. It is raised where the images show more. Lower it for
    slow platforms."""
    angular_accel_density: float = expert(4.0, gt=0)
    """The same for the angular acceleration, rad/s²/√Hz."""
    median_depth: float = expert(4.0, gt=0)
    """The unit of length of one camera without an IMU, which measures none: the features that both
    views of its start see have this median depth. If it is near the true one, in metres, densities
    and other settings in metres mean what they say."""
    min_points: int = expert(10, ge=4)
    """Fewest points of a known depth that tell the motion between two images."""
    start_at_images: bool = expert(default=True)
    """Whether `constant_velocity`, and an IMU of which samples are missing, begin the steps of a
    frame at the pose that its images show."""

    def uses_imu(self, has_imu: bool) -> bool:
        """Whether an IMU predicts the states, of a rig that has one or not.

        Raises:
            ConfigError: if it is to, and there is none.
        """
        if self.model == "imu" and not has_imu:
            raise ConfigError(
                "backend.dynamics.model is 'imu', and the recording has no IMU; "
                "use constant_velocity, or auto"
            )
        return has_imu and self.model != "constant_velocity"


class GnssConfig(Settings):
    """Position fixes, of GNSS or any other kind."""

    enabled: bool = expert(True)
    """Use the fixes of the recording, and report the trajectory in their world: east, north, up
    from the datum. Switch it off to compare."""
    lever_arm_m: tuple[float, float, float] = expert((0.0, 0.0, 0.0))
    """Position of the antenna in the body frame, in metres."""
    lever_arm_sigma_m: float = expert(0.0, ge=0, le=10)
    """How well that position is known on each axis, in metres. Above zero it is estimated with the
    states; it needs turns. Not with GTSAM's smoothers."""
    time_offset_s: float = expert(0.0, ge=-10, le=10)
    """Added to the times of the fixes to get them on the clock of the IMU, or of the cameras where
    there is no IMU."""
    time_offset_sigma_s: float = expert(0.0, ge=0, le=1)
    """How well that offset is known, in seconds. Above zero it is estimated from the path, together
    with the world of the fixes, and with the states from then on."""


class KnownPosesConfig(Settings):
    """Known poses: of a motion-capture system, another estimator, or fiducial tags."""

    enabled: bool = expert(True)
    """Use the known poses of the recording, and report the trajectory in their world. Switch it off
    to compare."""
    lever_arm_m: tuple[float, float, float] = expert((0.0, 0.0, 0.0))
    """Position in the body frame of the sensor whose poses are known, in metres."""
    quaternion: tuple[float, float, float, float] = expert((0.0, 0.0, 0.0, 1.0))
    """Orientation of that sensor in the body frame, body_R_sensor as x y z w."""
    time_offset_s: float = expert(0.0, ge=-10, le=10)
    """Added to the times of the poses to get them on the clock of the IMU, or of the cameras where
    there is no IMU."""


class OdometryConfig(Settings):
    """Odometry of wheels or legs: the motion of the body from frame to frame."""

    enabled: bool = expert(True)
    """Use the odometry of the recording. Switch it off if wheels slip much."""
    position_noise: float = expert(0.02, gt=0)
    """Standard deviation of the position on each axis after one metre, m/√m."""
    position_noise_per_rad: float = expert(0.01, ge=0)
    """What a turn adds to it, m/rad."""
    rotation_noise: float = expert(0.01, gt=0)
    """Standard deviation of the rotation about each axis after one metre, rad/√m. Odometry of
    wheels knows neither roll nor pitch: on uneven ground raise it."""
    rotation_noise_per_rad: float = expert(0.02, ge=0)
    """What a turn adds to it, rad/rad."""


class BackendConfig(Settings):
    """Settings of the back end that do not depend on the algorithm."""

    dynamics: DynamicsConfig = DynamicsConfig()
    """What predicts the state from frame to frame."""
    gnss: GnssConfig = GnssConfig()
    """Position fixes."""
    known_poses: KnownPosesConfig = KnownPosesConfig()
    """Known poses."""
    odometry: OdometryConfig = OdometryConfig()
    """Odometry of wheels or legs."""
    noise: NoiseConfig = NoiseConfig()
    """Noise of the sensors."""
    triangulation: TriangulationConfig = TriangulationConfig()
    """Which triangulated features are accepted."""
    gating: GatingConfig = GatingConfig()
    """Outlier rejection."""
    zero_velocity: ZeroVelocityConfig = ZeroVelocityConfig()
    """Zero-velocity updates."""
    initialization: InitializationConfig = InitializationConfig()
    """Start-up."""
    calibration: CalibrationConfig = CalibrationConfig()
    """Online calibration."""

    def on_the_clock(self, data: AidingData) -> AidingData:
        """Fixes and known poses that are used, with the time offsets of their sources added."""
        if not self.gnss.enabled:
            data = data.without_fixes()
        if not self.known_poses.enabled:
            data = data.without_poses()
        offsets = self.gnss.time_offset_s, self.known_poses.time_offset_s
        return data.shifted(*(round(offset * 1e9) for offset in offsets))
