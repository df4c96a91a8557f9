# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""From settings to a simulated sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.sensors.kalibr_calibration import read_kalibr
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.imu_simulation import ImuSource, RecordedImu, SimulatedImu
from slam_graph.simulation.landmarks import Landmarks, ahead, moving_box, on_walls
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.recorded_flight import LEAD_NS, RecordedFlight
from slam_graph.simulation.rigs import euroc_rig
from slam_graph.simulation.simulated_sequence import (
    Flight,
    SimulatedImages,
    SimulatedSequence,
    SimulatedTracks,
)
from slam_graph.simulation.simulation_config import SimulationConfig, random_stream
from slam_graph.simulation.splines import fit, stamps_between
from slam_graph.simulation.trajectories import fly
from slam_graph.simulation.views import View, camera_groups
from slam_graph.simulation.world import room_around, three_rooms

DEFAULT_DURATION_S = 60.0
LOOK_PERIOD_NS = 100_000_000


def simulate(config: SimulationConfig, diagnostics: Diagnostics | None = None) -> SimulatedSequence:
    """A sequence that is simulated while it is read.

    Args:
        config: all settings; the same ones give the same bytes.
        diagnostics: where faults are counted.

    Raises:
        ConfigError: if settings contradict one another.
        DataError: if a recorded trajectory or calibration is missing or cannot be used.
    """
    if config.recorded is None and (config.real_imu or config.start_s > 0):
        raise ConfigError(
            f"real_imu and start_s are for recorded trajectories, '{config.trajectory}' is made up"
        )
    if config.moving_object is not None and config.kind != "images":
        raise ConfigError("moving_object is for images; tracks have landmarks.moving_points")
    diagnostics = diagnostics if diagnostics is not None else Diagnostics()
    flight = _flight(config, diagnostics)
    source = config.trajectory if config.recorded is None else _name(config.recorded)
    name = f"{source}_{config.kind}_{config.seed}"
    if config.kind == "images":
        return SimulatedImages(name, config, flight, diagnostics)
    return SimulatedTracks(name, config, flight, _landmarks(config, flight), diagnostics)


def _flight(config: SimulationConfig, diagnostics: Diagnostics) -> Flight:
    if config.recorded is None:
        return _made_up(config)
    recording = RecordedFlight.read(config.recorded, config, diagnostics)
    rig = _rig(config, recording.rig)
    smooth = fit(recording.truth)
    motion: Motion = smooth
    imu: ImuSource = SimulatedImu(smooth, rig.imu, config.imu, config.seed)
    if config.real_imu:
        motion = recorded = recording.motion(smooth)
        imu = RecordedImu(recording.samples(recorded), recorded)
    world = room_around(recording.truth.positions, config.landmarks.margin_m)
    return Flight(rig, motion, imu, world, _exposures(motion, config))


def _made_up(config: SimulationConfig) -> Flight:
    rig = _rig(config, None)
    duration_s = config.duration_s if config.duration_s is not None else DEFAULT_DURATION_S
    rng = np.random.default_rng(random_stream(config.seed, "trajectory"))
    whole_s = duration_s + 2e-9 * LEAD_NS
    motion = fly(config.trajectory, whole_s, rig.cameras[0].body_T_camera, config.flight, rng)
    imu = SimulatedImu(motion, rig.imu, config.imu, config.seed)
    world = three_rooms()
    if config.trajectory != "rooms":
        world = room_around(_positions(motion), config.landmarks.margin_m)
    return Flight(rig, motion, imu, world, _exposures(motion, config))


def _landmarks(config: SimulationConfig, flight: Flight) -> Landmarks:
    rng = np.random.default_rng(random_stream(config.seed, "landmarks"))
    settings = config.landmarks
    if settings.kind == "ahead":
        views = [View.of(mounted, config.tracks) for mounted in flight.rig.cameras]
        leaders = [views[group[0]] for group in camera_groups(flight.rig, views)]
        still = ahead(flight.motion, leaders, config.tracks.features, settings, rng)
    else:
        still = on_walls(flight.world, settings.density, rng)
    if settings.moving_points == 0:
        return still
    box = moving_box(_positions(flight.motion), flight.motion.start_ns, settings.moving_points, rng)
    return Landmarks(still.points, still.normals, box)


def _rig(config: SimulationConfig, recorded: Rig | None) -> Rig:
    """The rig that is asked for, or that of the recording, or EuRoC's."""
    if config.calibration is not None:
        rig = read_kalibr(config.calibration)
    else:
        rig = recorded if recorded is not None else euroc_rig()
    return rig if config.cameras is None else rig.select(config.cameras)


def _positions(motion: Motion) -> FloatArray:
    stamps = np.arange(motion.start_ns, motion.end_ns, LOOK_PERIOD_NS, dtype=np.int64)
    return motion.positions(stamps)


def _exposures(motion: Motion, config: SimulationConfig) -> IntArray:
    start_ns, end_ns = motion.start_ns + LEAD_NS, motion.end_ns - LEAD_NS
    if end_ns < start_ns:
        raise DataError("the trajectory is too short: it needs 0.2 s and the time of one frame")
    if config.duration_s is not None:
        end_ns = min(end_ns, start_ns + round(config.duration_s * 1e9))
    return stamps_between(start_ns, end_ns, config.rate_hz)


def _name(path: Path) -> str:
    """Name of the recording that a path belongs to."""
    path = path.resolve()
    for folder in (path, *path.parents):
        if (folder / "mav0").is_dir():
            return folder.name
    return path.stem
