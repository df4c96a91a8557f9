# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`simulate`: from settings to a simulated sequence.

A simulation needs a rig (EuRoC's stereo rig unless given), a motion (generated or recorded), an
IMU, and a world with landmarks or textures.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets import read_kalibr
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.sensors import Camera, DepthSensor, ImuNoise, Rig, RigCamera
from slam_graph.simulation.imu_simulation import ImuSource, RecordedImu, SimulatedImu
from slam_graph.simulation.landmarks import Landmarks, ahead, moving_box, on_walls
from slam_graph.simulation.motion import Motion, SplineMotion
from slam_graph.simulation.recorded_flight import LEAD_NS, RecordedFlight
from slam_graph.simulation.roads import beside_the_road, kitti_rig
from slam_graph.simulation.simulated_sequence import (
    Flight,
    SimulatedImages,
    SimulatedSequence,
    SimulatedTracks,
)
from slam_graph.simulation.simulation_config import (
    SimulationConfig,
    load_simulation_config,
    random_stream,
)
from slam_graph.simulation.trajectories import fit, fly, stamps_between
from slam_graph.simulation.views import View, camera_groups
from slam_graph.simulation.world import World, room_around, three_rooms

_DEFAULT_DURATION_S = 60.0

_POSITION_PERIOD_NS = 100_000_000
"""Spacing of the positions around which a room is built."""

SIZE = (752, 480)
_LEFT = Camera(
    *(458.654, 457.296, 367.215, 248.375),
    "radtan",
    (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
    *SIZE,
)
_RIGHT = Camera(
    *(457.587, 456.134, 379.999, 255.238),
    "radtan",
    (-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05),
    *SIZE,
)
_BODY_T_LEFT = (
    (0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975),
    (0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768),
    (-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949),
    (0.0, 0.0, 0.0, 1.0),
)
_BODY_T_RIGHT = (
    (0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556),
    (0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024),
    (-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038),
    (0.0, 0.0, 0.0, 1.0),
)


_DEPTH_SENSORS = {
    "none": None,
    "stereo": DepthSensor(scale=5000.0),
    "kinect": DepthSensor.kinect(scale=5000.0),
}
"""With 0.2 mm to a unit, so that rounding does not count."""


def simulate(
    config: SimulationConfig | str | Path | None = None,
    overrides: Iterable[str] = (),
    *,
    diagnostics: Diagnostics | None = None,
    **settings: Any,
) -> SimulatedSequence:
    """A simulated sequence, generated while it is read.

        sequence = simulate(trajectory="rooms", duration_s=60, seed=1, tracks={"loss": 0.02})
        result = run(sequence)
        sequence.save("flight")

    Args:
        config: settings, or the path of a YAML file with settings; the defaults if None.
        overrides: `a.b=value`, as `--set` takes them.
        diagnostics: counts the faults of a recorded trajectory.
        settings: top-level settings by name, laid over `config`.

    Returns:
        The sequence; the same settings give the same bytes.

    Raises:
        ConfigError: if settings are unknown or contradict one another.
        DataError: if a recorded trajectory or calibration is missing or cannot be used.
    """
    config = load_simulation_config(config, overrides, **settings)
    _refuse_contradictions(config)
    diagnostics = diagnostics if diagnostics is not None else Diagnostics()
    flight = _flight(config, diagnostics)
    source = config.trajectory if config.recorded is None else _name(config.recorded)
    name = f"{source}_{config.kind}_{config.seed}"
    if config.kind == "images":
        return SimulatedImages(name, config, flight, diagnostics)
    return SimulatedTracks(name, config, flight, _landmarks(config, flight), diagnostics)


def _refuse_contradictions(config: SimulationConfig) -> None:
    """Refuse settings that contradict one another.

    Raises:
        ConfigError: if some do.
    """
    if config.recorded is None and (config.real_imu or config.start_s > 0):
        raise ConfigError(
            "real_imu and start_s are for recorded trajectories, "
            f"'{config.trajectory}' is a generated one"
        )
    if config.moving_object is not None and config.kind != "images":
        raise ConfigError(
            "moving_object is for images; for tracks set landmarks.moving_points instead"
        )
    if config.trajectory == "car" and config.kind == "images":
        raise ConfigError("trajectory 'car' has tracks only; remove kind, or choose another one")
    if config.real_imu and not config.with_imu:
        raise ConfigError("real_imu is for recordings with an IMU; remove it, or set with_imu")
    if config.gnss.multipath > 0.0 and config.gnss.sigma_m is None:
        raise ConfigError(
            "gnss.multipath (--multipath) is a share of position fixes, and there are none: give "
            "their sigma, gnss.sigma_m (--gnss)"
        )


def euroc_rig() -> Rig:
    """EuRoC's calibrated rig: two cameras 11 cm apart, and an IMU at 200 Hz."""
    cameras = (
        RigCamera(_LEFT, _pose(_BODY_T_LEFT), 0.0, "cam0"),
        RigCamera(_RIGHT, _pose(_BODY_T_RIGHT), 0.0, "cam1"),
    )
    return Rig(cameras, ImuNoise())


def _pose(rows: tuple[tuple[float, ...], ...]) -> gtsam.Pose3:
    matrix = np.array(rows)
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(matrix[:3, :3]), matrix[:3, 3])


def _flight(config: SimulationConfig, diagnostics: Diagnostics) -> Flight:
    if config.recorded is None:
        return _generated(config)
    recording = RecordedFlight.read(config.recorded, config, diagnostics)
    rig = _rig(config, recording.rig)
    smooth = fit(recording.truth)
    motion: Motion = smooth
    imu: ImuSource = SimulatedImu(smooth, rig.imu, config.imu, config.seed)
    if config.real_imu:
        motion = recorded = recording.motion(smooth)
        imu = RecordedImu(recording.samples(recorded), recorded)
    world = room_around(
        recording.truth.positions, config.landmarks.margin_m, config.objects.reach_m
    )
    return Flight(rig, motion, imu, world, _exposures(motion, config), recording.report)


def _generated(config: SimulationConfig) -> Flight:
    rig = _rig(config, None)
    duration_s = config.duration_s if config.duration_s is not None else _DEFAULT_DURATION_S
    motion = _fly(config, rig, config.seed, duration_s)
    imu = SimulatedImu(motion, rig.imu, config.imu, config.seed)
    return Flight(rig, motion, imu, _world(config, rig, motion), _exposures(motion, config))


def _fly(config: SimulationConfig, rig: Rig, seed: int, duration_s: float) -> SplineMotion:
    """A flight along a generated path."""
    rng = np.random.default_rng(random_stream(seed, "trajectory"))
    total_s = duration_s + 2e-9 * LEAD_NS
    return fly(config.trajectory, total_s, rig.cameras[0].body_T_camera, config.flown, rng)


def _world(config: SimulationConfig, rig: Rig, motion: SplineMotion) -> World:
    """The place of a generated flight.

    With a seed of its own it is the room around the flight of that seed, so that it is the same
    for every flight through it.
    """
    if config.trajectory == "rooms":
        return three_rooms()
    if config.trajectory == "car":
        return World(())
    if config.world_seed is not None:
        motion = _fly(config, rig, config.world_seed, _DEFAULT_DURATION_S)
    return room_around(_positions(motion), config.landmarks.margin_m, config.objects.reach_m)


def _landmarks(config: SimulationConfig, flight: Flight) -> Landmarks:
    rng = np.random.default_rng(random_stream(config.place_seed, "landmarks"))
    settings = config.landmarks
    if config.trajectory == "car":
        static = beside_the_road(flight.motion, rng)
    elif settings.kind == "ahead":
        views = [View.of(mounted) for mounted in flight.rig.cameras]
        leaders = [views[group[0]] for group in camera_groups(flight.rig, views)]
        static = ahead(flight.motion, leaders, config.tracks.features, rng)
    else:
        static = on_walls(flight.world, settings.density, rng)
    if settings.moving_points == 0:
        return static
    box = moving_box(_positions(flight.motion), flight.motion.start_ns, settings.moving_points, rng)
    return Landmarks(static.points, static.normals, box, static.reach_m)


def _rig(config: SimulationConfig, recorded: Rig | None) -> Rig:
    """The rig of the settings, or that of the recording, or EuRoC's; with depth as asked for."""
    if config.calibration is not None:
        rig = read_kalibr(config.calibration)
    else:
        own = kitti_rig if config.trajectory == "car" else euroc_rig
        rig = recorded if recorded is not None else own()
    if config.cameras is not None:
        rig = rig.select(config.cameras)
    if config.depth.sensor != "rig":
        rig = replace(rig, depth=_DEPTH_SENSORS[config.depth.sensor])
    if not config.with_imu:
        rig = rig.without_imu()
    if config.shutter_readout_s is None:
        return rig
    readout_s = config.shutter_readout_s
    cameras = (
        replace(c, readout_s=readout_s, rolling_shutter=readout_s > 0, stamped_row="first")
        for c in rig.cameras
    )
    return replace(rig, cameras=tuple(cameras))


def _positions(motion: Motion) -> FloatArray:
    stamps = np.arange(motion.start_ns, motion.end_ns, _POSITION_PERIOD_NS, dtype=np.int64)
    return motion.positions(stamps)


def _exposures(motion: Motion, config: SimulationConfig) -> IntArray:
    start_ns, end_ns = motion.start_ns + LEAD_NS, motion.end_ns - LEAD_NS
    if end_ns < start_ns:
        raise DataError("the trajectory is too short: it needs 0.2 s and the time of one frame")
    if config.duration_s is not None:
        end_ns = min(end_ns, start_ns + round(config.duration_s * 1e9))
    return stamps_between(start_ns, end_ns, config.frame_rate_hz)


def _name(path: Path) -> str:
    """Name of the recording that a path belongs to."""
    path = path.resolve()
    for folder in (path, *path.parents):
        if (folder / "mav0").is_dir():
            return folder.name
    return path.stem
