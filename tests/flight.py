# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A made-up flight through a room of points, in closed form: the truth for tests of the back end.

Position and Euler angles are sinusoids, so that rates, specific forces and pixels are exact.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations
from slam_graph.backend.cost.reprojection import Geometry
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData, Packet
from slam_graph.sensors.rig import ImuNoise, Rig, RigCamera

GRAVITY = np.array([0.0, 0.0, -9.81])
NS_PER_S = 1_000_000_000
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""body_R_camera of a camera that looks along the x axis of the body."""

RADTAN = Camera(458.0, 457.0, 367.0, 248.0, "radtan", (-0.28, 0.07, 2e-4, 2e-5), 752, 480)
FISHEYE = Camera(190.0, 191.0, 254.0, 256.0, "equidistant", (3e-3, 7e-4, -2e-3, 2e-4), 512, 512)


def rig(cameras: int = 1, camera: Camera = RADTAN) -> Rig:
    """A rig of cameras side by side, tilted a little against one another."""
    mounted = []
    for number in range(cameras):
        tilt = Rotation.from_euler("xyz", [0.01 * number, -0.02, 0.015 * number]).as_matrix()
        place = np.array([0.05, 0.055 - 0.11 * number, 0.02])
        mounted.append(RigCamera(camera, gtsam.Pose3(gtsam.Rot3(FORWARD @ tilt), place)))
    return Rig(tuple(mounted), ImuNoise())


@dataclass(frozen=True)
class Flight:
    """Sinusoids: `amplitude * sin(rate * t + phase)` for each axis."""

    position: FloatArray = field(default_factory=lambda: np.array([1.2, 0.9, 0.5]))
    position_rate: FloatArray = field(default_factory=lambda: np.array([1.1, 1.7, 2.3]))
    angles: FloatArray = field(default_factory=lambda: np.array([0.25, 0.2, 0.8]))
    angle_rate: FloatArray = field(default_factory=lambda: np.array([1.9, 1.3, 0.7]))
    gyro_bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    accel_bias: FloatArray = field(default_factory=lambda: np.zeros(3))

    def rotation(self, t_s: FloatArray) -> Rotation:
        """world_R_body at times (N,)."""
        angles = self.angles * np.sin(np.outer(t_s, self.angle_rate) + 0.3)
        return Rotation.from_euler("ZYX", angles[:, ::-1])

    def positions(self, t_s: FloatArray) -> FloatArray:
        """(N, 3) in the world."""
        moved: FloatArray = self.position * np.sin(np.outer(t_s, self.position_rate) + 0.5)
        return moved

    def velocities(self, t_s: FloatArray) -> FloatArray:
        """(N, 3) in the world."""
        slope = self.position * self.position_rate
        rates: FloatArray = slope * np.cos(np.outer(t_s, self.position_rate) + 0.5)
        return rates

    def rates(self, t_s: FloatArray) -> FloatArray:
        """True angular rates (N, 3) in the body."""
        roll, pitch, _ = (self.angles * np.sin(np.outer(t_s, self.angle_rate) + 0.3)).T
        slope = self.angles * self.angle_rate
        d_roll, d_pitch, d_yaw = (slope * np.cos(np.outer(t_s, self.angle_rate) + 0.3)).T
        return np.stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * np.cos(roll) + d_yaw * np.sin(roll) * np.cos(pitch),
                -d_pitch * np.sin(roll) + d_yaw * np.cos(roll) * np.cos(pitch),
            ],
            axis=1,
        )

    def specific_forces(self, t_s: FloatArray) -> FloatArray:
        """True specific forces (N, 3) in the body."""
        acceleration = -self.positions(t_s) * self.position_rate**2
        force: FloatArray = self.rotation(t_s).inv().apply(acceleration - GRAVITY)
        return force

    def imu(
        self,
        start_s: float,
        end_s: float,
        rate_hz: float = 200.0,
        rng: np.random.Generator | None = None,
    ) -> ImuData:
        """Samples with bias, and with the noise of the rig's IMU where `rng` is given."""
        stamps_ns = np.round(np.arange(start_s, end_s + 1e-9, 1.0 / rate_hz) * NS_PER_S)
        t_s = stamps_ns * 1e-9
        gyro, accel = self.rates(t_s) + self.gyro_bias, self.specific_forces(t_s) + self.accel_bias
        if rng is not None:
            noise, root = ImuNoise(), np.sqrt(rate_hz)
            gyro = gyro + rng.normal(0.0, noise.gyro_noise_density * root, gyro.shape)
            accel = accel + rng.normal(0.0, noise.accel_noise_density * root, accel.shape)
        return ImuData(stamps_ns.astype(np.int64), gyro, accel)

    def nav_state(self, t_s: float, sigmas: FloatArray | None = None) -> NavState:
        """The true state, with a diagonal covariance where five standard deviations are given."""
        at = np.array([t_s])
        return NavState(
            round(t_s * NS_PER_S),
            gtsam.Pose3(gtsam.Rot3(self.rotation(at).as_matrix()[0]), self.positions(at)[0]),
            self.velocities(at)[0],
            accel_bias=self.accel_bias,
            gyro_bias=self.gyro_bias,
            covariance=None if sigmas is None else np.diag(np.repeat(sigmas, 3) ** 2),
        )


AT_REST = Flight(position=np.zeros(3), angles=np.array([0.1, 0.07, 0.0]), angle_rate=np.zeros(3))
"""A platform that stands still, a little tilted."""


def room(count: int, rng: np.random.Generator) -> FloatArray:
    """Points (count, 3) on the walls of a room around the flight."""
    points = rng.uniform([-5.0, -5.0, -2.0], [5.0, 5.0, 2.0], (count, 3))
    wall = rng.integers(0, 2, count)
    points[np.arange(count), wall] = 5.0 * rng.choice([-1.0, 1.0], count)
    return points


def features(
    flight: Flight,
    rig: Rig,
    points: FloatArray,
    t_s: float,
    rng: np.random.Generator | None = None,
    sigma_px: float = 1.0,
) -> FeatureFrame:
    """What the cameras see of the points, with noise where `rng` is given."""
    at = np.array([t_s])
    R, p = flight.rotation(at).as_matrix()[0], flight.positions(at)[0]
    return features_from(R, p, rig, points, round(t_s * NS_PER_S), rng, sigma_px)


def features_from(
    R: FloatArray,
    p: FloatArray,
    rig: Rig,
    points: FloatArray,
    stamp_ns: int,
    rng: np.random.Generator | None = None,
    sigma_px: float = 1.0,
) -> FeatureFrame:
    """What the cameras see of the points from a pose of the body, world_R_body and position."""
    in_body = (points - p) @ R
    cameras = []
    for mounted in rig.cameras:
        matrix = mounted.body_T_camera.matrix()
        in_camera = (in_body - matrix[:3, 3]) @ matrix[:3, :3]
        camera = mounted.camera
        plane = in_camera[:, :2] / np.where(in_camera[:, 2:] > 0.3, in_camera[:, 2:], np.inf)
        pixels = camera.distort(plane)[0]
        seen = (
            (in_camera[:, 2] > 0.3)
            & (np.hypot(*plane.T) < 1.0)
            & np.all((pixels > 5) & (pixels < (camera.width - 5, camera.height - 5)), axis=1)
        )
        ids = np.flatnonzero(seen).astype(np.int64)
        noisy = pixels[ids]
        if rng is not None:
            noisy = noisy + rng.normal(0.0, sigma_px, noisy.shape)
        cameras.append(FeatureObservations(ids, noisy, camera.undistort(noisy)))
    return FeatureFrame(stamp_ns, tuple(cameras))


def packets(
    flight: Flight,
    rig: Rig,
    points: FloatArray,
    duration_s: float,
    rng: np.random.Generator | None = None,
    frame_rate_hz: float = 10.0,
    sigma_px: float = 1.0,
) -> Iterator[Packet]:
    """The flight as a stream; the first frame is at zero, the first sample 0.1 s before."""
    imu = flight.imu(-0.1, duration_s, 200.0, rng)
    given = 0
    for t_s in np.arange(0.0, duration_s + 1e-9, 1.0 / frame_rate_hz).tolist():
        frame = features(flight, rig, points, t_s, rng, sigma_px)
        until = int(np.searchsorted(imu.stamps_ns, frame.stamp_ns)) + 1
        yield Packet(imu[given:until], frame)
        given = until


def scene(
    flight: Flight,
    rig: Rig,
    points: FloatArray,
    times_s: FloatArray,
    rng: np.random.Generator | None = None,
    sigma_px: float = 1.0,
    min_frames: int = 2,
) -> tuple[Observations, Geometry]:
    """The observations from some times, and the true poses and points that go with them."""
    window = FeatureTracks()
    for number, t_s in enumerate(times_s.tolist()):
        window.add(number, features(flight, rig, points, t_s, rng, sigma_px))
    ids, lengths = window.lengths()
    obs = window.observations(ids[lengths >= min_frames])
    rotations = flight.rotation(times_s).as_matrix()
    return obs, Geometry(rotations, flight.positions(times_s), points[obs.ids])
