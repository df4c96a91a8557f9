# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the back end that all algorithms share: noise, gating, triangulation, start-up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from slam_graph.settings.base import Settings


class AdaptiveNoiseConfig(Settings):
    """White noise of the IMU that follows what the images say of it."""

    enabled: bool = True
    """Whether densities are raised while the images correct the IMU more than they should."""
    whiteness_s: float = Field(0.5, gt=0)
    """Time over which corrections are averaged to see whether they keep their direction."""
    size_s: float = Field(2.0, gt=0)
    """Time over which their squares are averaged."""
    response_s: float = Field(1.0, gt=0)
    """Time in which a variance grows e-fold if squares are twice what they should be."""
    max_factor: float = Field(30.0, ge=1)
    """Largest factor on a density."""


class NoiseConfig(Settings):
    """Noise of the sensors, where the calibration does not say it."""

    pixel_sigma: float = Field(1.0, gt=0)
    """Standard deviation of a feature observation, in pixels."""
    imu_scale: float = Field(1.0, gt=0)
    """Factor on all IMU noise densities of the calibration."""
    adaptive: AdaptiveNoiseConfig = AdaptiveNoiseConfig()
    """Noise of the IMU that follows what the images say of it."""
    gravity: float = Field(9.81, gt=0)
    """Magnitude of gravity in m/s²."""
    max_imu_gap_s: float = Field(0.03, gt=0)
    """Longest time without IMU samples that is bridged as if there were none missing."""
    imu_gap_scale: float = Field(1000.0, ge=1)
    """Factor on the IMU noise between two frames with a longer gap."""


class TriangulationConfig(Settings):
    """When a triangulated feature can be trusted."""

    iterations: int = Field(5, ge=1)
    """Gauss-Newton steps that refine the linear solution."""
    min_depth_m: float = Field(0.1, gt=0)
    """Nearest accepted depth in any camera."""
    max_depth_m: float = Field(75.0, gt=0)
    """Farthest accepted depth in the first camera."""
    min_parallax_rad: float = Field(0.01, ge=0)
    """Smallest accepted angle between two rays to a feature."""


class GatingConfig(Settings):
    """Outlier rejection inside the back end."""

    confidence: float = Field(0.95, gt=0, lt=1)
    """Quantile of the χ² distribution beyond which a feature is rejected (Mahalanobis gate)."""
    robust_loss: Literal["none", "huber", "cauchy"] = "huber"
    """Loss that weighs down large reprojection residuals."""

    moved: ClassVar[Mapping[str, str]] = {
        "robust_width": "is a constant now: WIDTH_2D in slam_graph/backend/cost/robust_loss.py",
    }


class ZeroVelocityConfig(Settings):
    """Zero-velocity updates while the platform stands still."""

    enabled: bool = True
    """Whether standing still is detected and used."""
    window_s: float = Field(1.0, gt=0)
    """Length of the window over which nothing may have moved."""
    max_gyro_std: float = Field(0.2, gt=0)
    """Largest standard deviation of the angular rate, rad/s."""
    max_accel_std: float = Field(2.5, gt=0)
    """Largest standard deviation of the specific force, m/s²."""
    max_disparity_px: float = Field(1.0, gt=0)
    """Largest median motion of the features over the window, and between two frames; or three times
    that of the third which moves least, as the others may be on something that moves."""
    velocity_sigma: float = Field(0.01, gt=0)
    """How still a still platform is: standard deviation of its velocity, m/s."""
    position_sigma: float = Field(1e-3, gt=0)
    """Standard deviation of its motion between two frames, m."""
    rotation_sigma: float = Field(1e-3, gt=0)
    """Standard deviation of its rotation between two frames, rad."""


class PriorConfig(Settings):
    """How uncertain the first state is where nothing better is known (standard deviations)."""

    attitude_rad: float = Field(0.05, gt=0)
    """Roll and pitch."""
    yaw_rad: float = Field(1e-3, gt=0)
    """Yaw, which is free to choose."""
    position_m: float = Field(1e-3, gt=0)
    """Position, which is free to choose."""
    velocity: float = Field(0.05, gt=0)
    """Velocity, m/s."""
    gyro_bias: float = Field(0.01, gt=0)
    """Gyroscope bias, rad/s."""
    accel_bias: float = Field(0.1, gt=0)
    """Accelerometer bias, m/s²."""


class InitializationConfig(Settings):
    """How the first state is found."""

    mode: Literal["auto", "static", "motion", "given", "groundtruth"] = "auto"
    """auto: from the state that the data brings, else from standing still, else in motion."""
    static_window_s: float = Field(1.0, gt=0)
    """How long the platform must stand still for a static start."""
    static_disparity_px: float = Field(1.5, gt=0)
    """zero_velocity.max_disparity_px of a static start; running motors shake the picture."""
    motion_window_s: float = Field(1.5, gt=0)
    """Length of the visual-inertial alignment of a start in motion."""
    frame_spacing_s: float = Field(0.15, gt=0)
    """Time between the frames that the alignment uses."""
    retry_s: float = Field(0.2, ge=0)
    """Time between two attempts to start in motion."""
    features: int = Field(150, ge=10)
    """How many features the alignment uses at most (the longest tracks)."""
    min_features: int = Field(10, ge=5)
    """How many features must fit the solution of a start in motion."""
    max_normalized_cost: float = Field(3.0, gt=0)
    """Largest mean squared residual of a start in motion, in squared standard deviations."""
    max_velocity_sigma: float = Field(0.1, gt=0)
    """How well a start in motion must know the velocity, m/s."""
    max_scale_sigma: float = Field(0.15, gt=0)
    """How well a start in motion must know the scale, relative to it."""
    prior: PriorConfig = PriorConfig()
    """Uncertainty of the first state of a static start."""
    motion_prior: PriorConfig = PriorConfig(attitude_rad=0.3, velocity=10.0, gyro_bias=0.05)
    """Uncertainty of the guess that a start in motion refines."""
    fix_gauge: bool = True
    """Take the position and yaw of the first state as the definition of the world frame."""


class CalibrationConfig(Settings):
    """Which parameters of the rig are estimated with the states, and how well they are known.

    Sigmas are standard deviations of the calibration that the data brings, for each component.
    """

    extrinsics: bool = False
    """Estimate where each camera is mounted on the body."""
    time_offset: bool = False
    """Estimate the offset from the clock of the cameras to that of the IMU, one for all cameras."""
    intrinsics: bool = False
    """Estimate focal lengths and principal point of each camera."""
    distortion: bool = False
    """Estimate the distortion coefficients of each camera."""
    rotation_sigma_rad: float = Field(0.02, gt=0)
    """Rotation of a camera."""
    position_sigma_m: float = Field(0.02, gt=0)
    """Position of a camera."""
    time_offset_sigma_s: float = Field(0.01, gt=0)
    """Time offset."""
    focal_length_sigma: float = Field(0.01, gt=0)
    """Focal lengths, as a share of them."""
    principal_point_sigma_px: float = Field(5.0, gt=0)
    """Principal point."""
    distortion_sigma: float = Field(0.01, gt=0)
    """Distortion coefficients."""

    @property
    def anything(self) -> bool:
        """Whether any parameter is estimated."""
        return self.extrinsics or self.time_offset or self.intrinsics or self.distortion


class BackendConfig(Settings):
    """Settings of the back end that do not depend on the algorithm."""

    noise: NoiseConfig = NoiseConfig()
    """Noise of the sensors."""
    triangulation: TriangulationConfig = TriangulationConfig()
    """When a triangulated feature can be trusted."""
    gating: GatingConfig = GatingConfig()
    """Outlier rejection."""
    zero_velocity: ZeroVelocityConfig = ZeroVelocityConfig()
    """Standing still."""
    initialization: InitializationConfig = InitializationConfig()
    """Start-up."""
    calibration: CalibrationConfig = CalibrationConfig()
    """Online calibration."""
