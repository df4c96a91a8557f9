# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of a simulation: together with the seed they determine every byte of the output."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from slam_graph.errors import ConfigError
from slam_graph.settings import ConfigTree, Settings, expert

TRAJECTORIES = ("figure8", "rooms", "random", "car")
"""Names of the generated trajectories; any other text is the path of a recorded one."""


class FlightConfig(Settings):
    """How a generated trajectory is flown."""

    moved: ClassVar[Mapping[str, str]] = {
        "wobble_rad": "is a constant now: WOBBLE_RAD in slam_graph/simulation/trajectories.py"
    }

    speed: float = expert(1.0, gt=0)
    """Mean speed while moving, m/s."""
    hover_s: float = expert(1.0, ge=0)
    """How long to stand still at the start and at every later stop; 0 starts in motion."""
    hover_every_s: float = expert(30.0, gt=0)
    """Time in motion between two stops."""


class SimulatedImuConfig(Settings):
    """The simulated IMU; its noise densities are those of the rig."""

    rate_hz: float | None = expert(None, gt=0)
    """Sampling rate; that of the rig if not given."""
    noise_scale: float = expert(1.0, ge=0)
    """Factor on white noise and random walk; 0 for a perfect IMU."""
    gyro_bias_sigma: float = expert(0.01, ge=0)
    """Standard deviation from which the initial gyroscope bias is drawn, rad/s."""
    accel_bias_sigma: float = expert(0.05, ge=0)
    """Standard deviation from which the initial accelerometer bias is drawn, m/s²."""


class LandmarkConfig(Settings):
    """The landmarks of the world."""

    moved: ClassVar[Mapping[str, str]] = {
        "ahead_depth_m": "is a constant now: AHEAD_DEPTH_M in slam_graph/simulation/landmarks.py"
    }

    kind: Literal["walls", "ahead"] = expert("walls")
    """walls: on floor, ceiling and walls of a room; ahead: at random depths in front of the
    cameras wherever they see too few."""
    density: float = expert(30.0, gt=0)
    """Landmarks per square metre of wall."""
    margin_m: float = expert(2.5, gt=0)
    """Distance of the walls of the room from the trajectory."""
    moving_points: int = expert(0, ge=0)
    """Number of landmarks on a box that flies around in the room (dynamic features)."""


class TrackConfig(Settings):
    """The simulated front end."""

    moved: ClassVar[Mapping[str, str]] = {
        "min_depth_m": "is a constant now: MIN_DEPTH_M in slam_graph/simulation/views.py",
        "max_depth_m": "is a constant now: MAX_DEPTH_M in slam_graph/simulation/views.py",
        "border_px": "is a constant now: BORDER_PX in slam_graph/simulation/views.py",
        "descriptor_looks": "is now tracks.distinct_descriptors",
        "descriptor_noise": "is a constant now: BIT_FLIP_PROBABILITY in "
        "slam_graph/simulation/track_simulation.py",
    }

    features: int = Field(150, ge=1)
    """Most features in an image. More make the estimate better and the run slower."""
    pixel_sigma: float = Field(1.0, ge=0)
    """Standard deviation of the noise of each pixel coordinate. A run on the recording should
    assume the same value (`backend.noise.pixel_sigma`), or its covariances are wrong."""
    loss: float = expert(0.0, ge=0, lt=1)
    """Probability that a track is lost from one frame to the next."""
    outliers: float = expert(0.0, ge=0, lt=1)
    """Share of wrong observations: the pixel is that of another feature of the same image."""
    max_length: int | None = expert(None, ge=1)
    """Most frames that a track may last."""
    keep_ids: bool = expert(False)
    """Whether a landmark that is seen again has its old id; otherwise it gets a new one."""
    descriptors: bool = expert(False)
    """Whether features come with binary descriptors of 256 bits, for place recognition."""
    distinct_descriptors: int = expert(2000, ge=1)
    """Number of distinct descriptors; landmarks that share one can be told apart only by where
    they are."""


class ImageConfig(Settings):
    """The rendered images."""

    moved: ClassVar[Mapping[str, str]] = {
        "blur_samples": "is a constant now: BLUR_SAMPLES in slam_graph/simulation/rendering.py"
    }

    texel_m: float = expert(0.006, gt=0)
    """Size of a texel of the walls."""
    noise_sigma: float = expert(1.5, ge=0)
    """Standard deviation of the noise of a pixel, in grey levels."""
    exposure_change: float = expert(0.0, ge=0, lt=1)
    """Amplitude of the changes of brightness: 0.3 for ±30 %."""
    exposure_period_s: float = expert(7.0, gt=0)
    """Period of the changes of brightness."""
    exposure_s: float = expert(0.0, ge=0)
    """Exposure time, over which motion blurs the image; 0 for sharp images."""


class DepthConfig(Settings):
    """The simulated depth of what a camera sees."""

    sensor: Literal["none", "stereo", "kinect", "rig"] = Field("rig")
    """none; stereo: a small depth camera of two infrared images, such as RealSense D435; kinect:
    structured light, such as Microsoft's first Kinect; rig: what the calibration has."""
    noise_scale: float = expert(1.0, ge=0)
    """Factor on the noise of the sensor; 0 for the exact depth. The calibration that comes with the
    data does not know of it."""


class MovingObjectConfig(Settings):
    """A textured board that moves in front of the cameras and hides what is behind it.

    By default it covers a third of the view of EuRoC's cameras.
    """

    width_m: float = expert(0.85, gt=0)
    """Its width."""
    height_m: float = expert(2.4, gt=0)
    """Its height."""
    texel_m: float = expert(0.002, gt=0)
    """Size of a texel; finer than that of the walls by default, as it is nearer than they are."""
    distance_m: float = expert(1.5, gt=0)
    """Its distance ahead of the first camera, whose smoothed path it follows."""
    sway_m: float = expert(0.4, gt=0)
    """Amplitude of its motion to either side."""
    speed: float = expert(0.5, gt=0)
    """Largest speed of that motion, m/s."""
    since_s: float = expert(0.0, ge=0)
    """Time at which it has come into view from the side; 0: it is there in the first frame."""


class SimulatedGnssConfig(Settings):
    """Simulated position fixes; their world is that of the ground truth."""

    sigma_m: float | None = expert(None, gt=0)
    """Standard deviation of a fix on each axis, in metres; no fixes if not given."""
    rate_hz: float = expert(1.0, gt=0)
    """Fixes per second."""
    multipath: float = expert(0.0, ge=0, lt=1)
    """Share of fixes that are off by reflections."""
    multipath_m: float = expert(10.0, ge=0)
    """How far they are off, in any horizontal direction, in metres."""
    lever_arm_m: tuple[float, float, float] = expert((0.0, 0.0, 0.0))
    """Position of the antenna in the body frame, in metres; a run must be told the same
    (`backend.gnss.lever_arm_m`)."""
    late_s: float = expert(0.0, ge=-10, le=10)
    """How much later the fixes are stamped than they were measured, in seconds."""


class SimulatedPosesConfig(Settings):
    """Simulated known poses of a sensor on the body; their world is that of the ground truth."""

    position_sigma_m: float | None = expert(None, gt=0)
    """Standard deviation of the position on each axis, in metres; not measured if not given."""
    rotation_sigma_rad: float | None = expert(None, gt=0)
    """The same of the orientation about each axis, in rad."""
    rate_hz: float = expert(5.0, gt=0)
    """Poses per second."""
    outliers: float = expert(0.0, ge=0, lt=1)
    """Share of poses that are off by a metre, and by a rad, in any direction."""
    lever_arm_m: tuple[float, float, float] = expert((0.0, 0.0, 0.0))
    """Position of the sensor in the body frame, in metres; a run must be told the same."""
    quaternion: tuple[float, float, float, float] = expert((0.0, 0.0, 0.0, 1.0))
    """Orientation of the sensor in the body frame, x y z w; a run must be told the same."""


class SimulatedOdometryConfig(Settings):
    """Simulated odometry, which drifts."""

    enabled: bool = expert(False)
    """Whether the recording has odometry."""
    rate_hz: float = expert(50.0, gt=0)
    """Samples per second."""
    position_noise: float = expert(0.02, ge=0)
    """Standard deviation of the position on each axis after one metre, m/√m."""
    rotation_noise: float = expert(0.003, ge=0)
    """Standard deviation of the rotation about each axis after one metre, rad/√m."""


class SimulatedObjectsConfig(Settings):
    """Rigid objects that move in front of the cameras, whose true poses come with the data."""

    count: int = Field(0, ge=0, le=8)
    """How many there are. Three or more pass in front of one another."""
    motion: Literal["straight", "turning", "tumbling", "stop_and_go", "mixed"] = expert("turning")
    """straight: it sways without turning; turning: about the vertical; tumbling: about any axis;
    stop_and_go: it moves for 2 s and stands for 1.5 s; mixed: one of each."""
    shape: Literal["box", "l_shape", "people"] = expert("box")
    """people: three boxes that move a little against one another, which no rigid motion fits."""
    size_m: float = expert(1.0, gt=0)
    """Length of the longest side."""
    distance_m: float = expert(3.5, gt=0)
    """How far ahead of the first camera the first one is."""
    speed: float = expert(0.6, gt=0)
    """Largest speed of the sway, m/s; the motion of the cameras, which it follows, comes on top."""
    sway_m: float = expert(0.5, gt=0)
    """Amplitude of the sway."""
    since_s: float = expert(0.0, ge=0)
    """Time at which they have come into view from the side; 0: they are there at first."""
    points: int = expert(100, ge=1)
    """Landmarks on each of them, in track simulations; of which a quarter is seen at a time."""
    masks: bool = expert(default=False)
    """Whether the data say which features, or pixels of the images, are on which object."""
    texel_m: float = expert(0.003, gt=0)
    """Size of a texel, in rendered images."""

    @property
    def reach_m(self) -> float:
        """How far from the cameras an object may be; 0 without objects."""
        if self.count == 0:
            return 0.0
        return self.distance_m + self.sway_m + 0.5 * (self.count + 2) * self.size_m


class StartConfig(Settings):
    """The start state that comes with the data, and its standard deviations."""

    error: bool = expert(False)
    """Whether an error is drawn from the covariance; otherwise the start is the exact truth."""
    rotation_rad: float = expert(2e-3, gt=0)
    """Standard deviation of the rotation about each axis."""
    position_m: float = expert(1e-3, gt=0)
    """Standard deviation of the position on each axis."""
    velocity: float = expert(0.02, gt=0)
    """Standard deviation of the velocity, m/s."""
    accel_bias: float = expert(0.02, gt=0)
    """Standard deviation of the accelerometer bias, m/s²."""
    gyro_bias: float = expert(2e-3, gt=0)
    """Standard deviation of the gyroscope bias, rad/s."""


_REAL_START = StartConfig(
    rotation_rad=0.01, position_m=0.01, velocity=0.05, accel_bias=0.05, gyro_bias=0.01
)
"""Uncertainty of the ground truth of a real flight, used with `real_imu` unless `start` is set."""

_CAR_SPEED, _CAR_RATE_HZ = 10.0, 10.0
"""Speed of a car (m/s), and frames per second of its cameras."""


class SimulationConfig(Settings):
    """All settings of a simulation.

    Attributes:
        TRAJECTORIES: names of the generated trajectories; any other text is the path of a recorded
            one.
    """

    TRAJECTORIES: ClassVar[tuple[str, ...]] = TRAJECTORIES

    kind: Literal["tracks", "images"] = Field("tracks")
    """tracks: feature tracks, made in seconds, for questions about the back end; images: rendered
    images, some 0.1 s each, for questions about the front end."""
    trajectory: str = Field("figure8")
    """figure8, rooms (through three rooms and back, for loop closure), random, car (on plane roads
    at 10 m/s, with the cameras of KITTI at 10 Hz; tracks only), or the path of a recorded
    trajectory (a ground-truth file or EuRoC folder)."""
    real_imu: bool = Field(False)
    """Use the IMU samples recorded with the trajectory, with their vibration, instead of simulated
    ones. Needs an EuRoC folder as `trajectory`."""
    calibration: Path | None = expert(None)
    """Kalibr camera chain; if not given that of the recorded trajectory, else EuRoC's."""
    cameras: int | None = Field(None, ge=1)
    """Number of cameras of the rig to use; all if not given."""
    shutter_readout_s: float | None = expert(None, ge=0, le=0.1)
    """Time that rolling shutters take from the first row to the last; 0 for global shutters, that
    of the rig if not given. Frames are stamped at the first row, and the ground truth is that of
    the middle row."""
    with_imu: bool = Field(default=True)
    """Whether the recording has an IMU."""
    start_s: float = expert(0.0, ge=0)
    """Where in a recorded trajectory to start."""
    duration_s: float | None = Field(None, gt=0)
    """Length of the recording; 60 s, or to the end of a recorded trajectory, if not given."""
    rate_hz: float = expert(20.0, gt=0)
    """Frames per second."""
    seed: int = Field(0, ge=0)
    """Seed of all random numbers. The same settings and seed give the same bytes."""
    world_seed: int | None = Field(None, ge=0)
    """Seed of the place: landmarks, their descriptors, textures, and the room; that of the flight
    if not given. Give several flights one world seed and different seeds for flights through one
    place."""
    flight: FlightConfig = FlightConfig()
    """How a generated trajectory is flown."""
    imu: SimulatedImuConfig = SimulatedImuConfig()
    """The simulated IMU."""
    landmarks: LandmarkConfig = LandmarkConfig()
    """The landmarks of the world."""
    tracks: TrackConfig = TrackConfig()
    """The simulated front end."""
    images: ImageConfig = ImageConfig()
    """The rendered images."""
    depth: DepthConfig = DepthConfig()
    """The depth of what the first camera sees, as images or with the features."""
    moving_object: MovingObjectConfig | None = expert(None)
    """A board that moves in front of the cameras, in rendered images; none if not given."""
    gnss: SimulatedGnssConfig = SimulatedGnssConfig()
    """Position fixes."""
    known_poses: SimulatedPosesConfig = SimulatedPosesConfig()
    """Known poses."""
    odometry: SimulatedOdometryConfig = SimulatedOdometryConfig()
    """Odometry of wheels."""
    objects: SimulatedObjectsConfig = SimulatedObjectsConfig()
    """Rigid objects that move, and their true poses."""
    start: StartConfig | None = expert(None)
    """The start state that comes with the data; with a real IMU it is less certain by default."""

    @property
    def known_start(self) -> StartConfig:
        """The settings of the start state, with the default that fits the kind of IMU."""
        if self.start is not None:
            return self.start
        return _REAL_START if self.real_imu else StartConfig()

    @property
    def flown(self) -> FlightConfig:
        """How the trajectory is flown, with the defaults of a car for a car."""
        if self.trajectory != "car":
            return self.flight
        given = {name: getattr(self.flight, name) for name in self.flight.model_fields_set}
        return FlightConfig(**({"speed": _CAR_SPEED, "hover_s": 0.0} | given))

    @property
    def frame_rate_hz(self) -> float:
        """Frames per second, with the default of a car for a car."""
        slow = self.trajectory == "car" and "rate_hz" not in self.model_fields_set
        return _CAR_RATE_HZ if slow else self.rate_hz

    @property
    def place_seed(self) -> int:
        """Seed of what belongs to the place and not to the flight."""
        return self.seed if self.world_seed is None else self.world_seed

    @property
    def recorded(self) -> Path | None:
        """Path of the recorded trajectory, or None for a generated one."""
        return None if self.trajectory in TRAJECTORIES else Path(self.trajectory)


def load_simulation_config(
    config: SimulationConfig | str | Path | None = None,
    overrides: Iterable[str] = (),
    **settings: Any,
) -> SimulationConfig:
    """The settings of a simulation: file under keyword settings under overrides.

    Args:
        config: YAML file, or settings to start from; the defaults if None.
        overrides: `a.b=value`, as `--set` takes them.
        settings: top-level settings by name; a dictionary changes some values of a table
            (`tracks={"loss": 0.02}`). None leaves a setting as it is.

    Raises:
        ConfigError: one line that names the file and line, the option or the override at fault.
    """
    tree = ConfigTree()
    if isinstance(config, SimulationConfig):
        tree.merge(ConfigTree(config.model_dump(exclude_unset=True)))
    elif config in TRAJECTORIES:
        raise ConfigError(f"'{config}' is no file of settings; write trajectory='{config}'")
    elif config is not None:
        tree.merge(ConfigTree.read(Path(config)))
    given = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in settings.items()
        if value is not None
    }
    tree.merge(ConfigTree(given, {(name,): f"option {name}" for name in given}))
    for text in overrides:
        tree.merge(ConfigTree.override(text))
    return tree.validated(SimulationConfig)


def random_stream(seed: int, purpose: str, *index: int) -> list[int]:
    """Seed of the random generator of one purpose; no two purposes share random numbers.

    Args:
        seed: of the simulation.
        purpose: e.g. ``imu``.
        index: numbers of frame, camera, block, …
    """
    return [seed, int.from_bytes(purpose.encode()), *index]
