# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of a simulation: with the seed in them, they determine every byte that comes out."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from slam_graph.settings.base import Settings

SHAPES = ("figure8", "rooms", "random")
"""Names of the made-up trajectories; any other text is the path of a recorded one."""


class FlightConfig(Settings):
    """How a made-up trajectory is flown."""

    speed: float = Field(1.0, gt=0)
    """Mean speed while moving, m/s."""
    hover_s: float = Field(1.0, ge=0)
    """How long to stand still at the start, and again from time to time; 0 starts in motion."""
    hover_every_s: float = Field(30.0, gt=0)
    """Time from one standstill to the next."""
    wobble_rad: float = Field(0.1, ge=0)
    """How far the platform rolls and pitches on its way."""


class SimulatedImuConfig(Settings):
    """The simulated IMU; its noise densities are those of the rig."""

    rate_hz: float | None = Field(None, gt=0)
    """Sampling rate; that of the rig if not said."""
    noise_scale: float = Field(1.0, ge=0)
    """Factor on white noise and random walk; 0 for a perfect IMU."""
    gyro_bias_sigma: float = Field(0.01, ge=0)
    """Standard deviation from which the first gyroscope bias is drawn, rad/s."""
    accel_bias_sigma: float = Field(0.05, ge=0)
    """Standard deviation from which the first accelerometer bias is drawn, m/s²."""


class LandmarkConfig(Settings):
    """The points of the world."""

    kind: Literal["walls", "ahead"] = "walls"
    """walls: on floor, ceiling and walls of a room; ahead: at a random depth in front of the
    cameras wherever they see too few."""
    density: float = Field(30.0, gt=0)
    """Points on a square metre of wall."""
    margin_m: float = Field(2.5, gt=0)
    """Distance of the walls of the room from the trajectory."""
    ahead_depth_m: tuple[float, float] = (2.0, 8.0)
    """Nearest and farthest depth of points ahead."""
    moving_points: int = Field(0, ge=0)
    """Points on a box that flies around in the room, to mislead whoever takes it for a wall."""


class TrackConfig(Settings):
    """The simulated front end."""

    features: int = Field(150, ge=1)
    """Most features in an image."""
    pixel_sigma: float = Field(1.0, ge=0)
    """Standard deviation of the noise of each pixel coordinate."""
    loss: float = Field(0.0, ge=0, lt=1)
    """Probability that a track is lost from one frame to the next."""
    outliers: float = Field(0.0, ge=0, lt=1)
    """Share of observations that are wrong: the pixel of another feature of the same image."""
    max_length: int | None = Field(None, ge=1)
    """Most frames that a track may last."""
    keep_ids: bool = False
    """Whether a landmark that is seen again has its old id; otherwise it gets a new one."""
    min_depth_m: float = Field(0.3, gt=0)
    """Nearest visible depth."""
    max_depth_m: float = Field(40.0, gt=0)
    """Farthest visible depth."""
    border_px: float = Field(8.0, ge=0)
    """Nothing is seen nearer to the border of the image than this."""
    descriptors: bool = False
    """Whether features come with binary descriptors of 256 bits, so that places are recognised."""
    descriptor_noise: float = Field(0.08, ge=0, lt=0.5)
    """Probability that a bit of a descriptor is wrong."""
    descriptor_looks: int = Field(2000, ge=1)
    """How many different looks there are; landmarks that share one are told apart by place only."""


class ImageConfig(Settings):
    """The rendered images."""

    texel_m: float = Field(0.006, gt=0)
    """Size of a texel of the walls."""
    noise_sigma: float = Field(1.5, ge=0)
    """Standard deviation of the noise of a pixel, in grey levels."""
    exposure_change: float = Field(0.0, ge=0, lt=1)
    """How much the brightness goes up and down: 0.3 for ±30 %."""
    exposure_period_s: float = Field(7.0, gt=0)
    """Period of the changes of brightness."""
    exposure_s: float = Field(0.0, ge=0)
    """Time of exposure, over which motion blurs the image; 0 for sharp images."""
    blur_samples: int = Field(5, ge=2)
    """How many sharp images are averaged to a blurred one."""


class MovingObjectConfig(Settings):
    """A textured board that moves before the cameras and hides what is behind it.

    By default it covers a third of the view of EuRoC's cameras.
    """

    width_m: float = Field(0.85, gt=0)
    """Its width."""
    height_m: float = Field(2.4, gt=0)
    """Its height."""
    texel_m: float = Field(0.002, gt=0)
    """Size of a texel: finer than that of the walls by default, as it is nearer than they are."""
    distance_m: float = Field(1.5, gt=0)
    """How far it keeps ahead of the first camera, whose path it follows smoothly."""
    sway_m: float = Field(0.4, gt=0)
    """How far it goes to either side on its way."""
    speed: float = Field(0.5, gt=0)
    """Largest speed to the side, m/s."""
    since_s: float = Field(0.0, ge=0)
    """When it has come in from the side; by default it is there in the first frame."""


class StartConfig(Settings):
    """The start state that comes with the data, and how well it is said to be known."""

    error: bool = False
    """Whether an error is drawn from the covariance; otherwise the start is the exact truth."""
    rotation_rad: float = Field(2e-3, gt=0)
    """Standard deviation of the rotation on each axis."""
    position_m: float = Field(1e-3, gt=0)
    """Standard deviation of the position on each axis."""
    velocity: float = Field(0.02, gt=0)
    """Standard deviation of the velocity, m/s."""
    accel_bias: float = Field(0.02, gt=0)
    """Standard deviation of the accelerometer bias, m/s²."""
    gyro_bias: float = Field(2e-3, gt=0)
    """Standard deviation of the gyroscope bias, rad/s."""


REAL_START = StartConfig(
    rotation_rad=0.01, position_m=0.01, velocity=0.05, accel_bias=0.05, gyro_bias=0.01
)
"""How well the truth of a real flight is known, unless the settings say otherwise."""


class SimulationConfig(Settings):
    """All settings of a simulation."""

    kind: Literal["tracks", "images"] = "tracks"
    """Feature tracks, or rendered images."""
    trajectory: str = "figure8"
    """figure8, rooms, random, or the path of a recorded one (a ground truth or EuRoC folder)."""
    real_imu: bool = False
    """Take the IMU that was recorded with the trajectory, instead of a simulated one."""
    calibration: Path | None = None
    """Kalibr camera chain of the rig; else that of the recorded trajectory, else EuRoC's."""
    cameras: int | None = Field(None, ge=1)
    """How many cameras of the rig to use; all if not said."""
    start_s: float = Field(0.0, ge=0)
    """Where in a recorded trajectory to start."""
    duration_s: float | None = Field(None, gt=0)
    """How long the frames go on; a minute, or to the end of a recorded trajectory, if not said."""
    rate_hz: float = Field(20.0, gt=0)
    """Frames in a second."""
    seed: int = Field(0, ge=0)
    """Seed of all random numbers."""
    flight: FlightConfig = FlightConfig()
    """How a made-up trajectory is flown."""
    imu: SimulatedImuConfig = SimulatedImuConfig()
    """The simulated IMU."""
    landmarks: LandmarkConfig = LandmarkConfig()
    """The points of the world."""
    tracks: TrackConfig = TrackConfig()
    """The simulated front end."""
    images: ImageConfig = ImageConfig()
    """The rendered images."""
    moving_object: MovingObjectConfig | None = None
    """A board that moves before the cameras, in rendered images; none if not said."""
    start: StartConfig | None = None
    """The start state that comes with the data; with a real IMU it is less certain by default."""

    @property
    def known_start(self) -> StartConfig:
        """How the start state is made."""
        if self.start is not None:
            return self.start
        return REAL_START if self.real_imu else StartConfig()

    @property
    def recorded(self) -> Path | None:
        """Path of the recorded trajectory, or None for one that is made up."""
        return None if self.trajectory in SHAPES else Path(self.trajectory)


def random_stream(seed: int, purpose: str, *index: int) -> list[int]:
    """What to seed the generator of one purpose with, so that no two share their numbers.

    Args:
        seed: of the simulation.
        purpose: e.g. ``imu``.
        index: numbers of frame, camera, block, …
    """
    return [seed, int.from_bytes(purpose.encode()), *index]
