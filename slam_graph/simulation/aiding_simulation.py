# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated position fixes with multipath, known poses, and odometry that drifts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.sensors import AidingData
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.simulation_config import (
    SimulatedGnssConfig,
    SimulatedOdometryConfig,
    SimulatedPosesConfig,
    SimulationConfig,
    random_stream,
)
from slam_graph.simulation.trajectories import stamps_between


def simulated_aiding(
    motion: Motion, span_ns: tuple[int, int], config: SimulationConfig
) -> AidingData:
    """What the sensors measure; nothing of one that is switched off.

    Args:
        motion: of the platform.
        span_ns: first and last time.
        config: noise and rates, and the seed of the simulation.
    """
    data, seed = AidingData.empty(), config.seed
    gnss, poses, odometry = config.gnss, config.known_poses, config.odometry
    if gnss.sigma_m is not None:
        data = AidingData.of_fixes(
            *_fixes(motion, stamps_between(*span_ns, gnss.rate_hz), gnss, seed)
        )
    if poses.position_sigma_m is not None or poses.rotation_sigma_rad is not None:
        stamps = stamps_between(*span_ns, poses.rate_hz)
        data = data.with_poses(stamps, *_known_poses(motion, stamps, poses, seed))
    if odometry.enabled:
        stamps = stamps_between(*span_ns, odometry.rate_hz)
        data = data.with_odometry(stamps, *_drifting(motion, stamps, odometry, seed))
    return data


def _known_poses(
    motion: Motion, stamps: IntArray, config: SimulatedPosesConfig, seed: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions (N, 3) and quaternions (N, 4) of the sensor, and their sigmas (N, 6)."""
    rng = np.random.default_rng(random_stream(seed, "known_poses"))
    turns, shape = motion.rotations(stamps), (len(stamps), 3)
    metres, radians = config.position_sigma_m, config.rotation_sigma_rad
    positions = motion.positions(stamps) + turns.apply(config.lever_arm_m)
    wrong = (rng.random(len(stamps)) < config.outliers)[:, None]
    directions = rng.normal(size=(2, *shape))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    positions += (metres or 0.0) * rng.normal(size=shape) + wrong * directions[0]
    off = (radians or 0.0) * rng.normal(size=shape) + wrong * directions[1]
    turned = Rotation.from_rotvec(off) * turns * Rotation.from_quat(config.quaternion)
    sigmas = np.repeat([metres or np.inf, radians or np.inf], 3)
    return positions, turned.as_quat(), np.tile(sigmas, (len(stamps), 1))


def _fixes(
    motion: Motion, stamps: IntArray, config: SimulatedGnssConfig, seed: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Times, positions of the antenna and the covariances that the receiver says."""
    assert config.sigma_m is not None
    rng = np.random.default_rng(random_stream(seed, "gnss"))
    exact = motion.positions(stamps) + motion.rotations(stamps).apply(config.lever_arm_m)
    fixes = exact + config.sigma_m * rng.normal(size=exact.shape)
    angles = rng.uniform(0.0, 2.0 * np.pi, len(stamps))
    reflected = rng.random(len(stamps)) < config.multipath
    offsets = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(stamps))])
    fixes += reflected[:, None] * config.multipath_m * offsets
    stamps = stamps + round(config.late_s * 1e9)
    return stamps, fixes, np.tile(config.sigma_m**2 * np.eye(3), (len(stamps), 1, 1))


def _drifting(
    motion: Motion, stamps: IntArray, config: SimulatedOdometryConfig, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Positions (N, 3) and quaternions (N, 4) that begin at the origin and drift with the way."""
    rng = np.random.default_rng(random_stream(seed, "odometry"))
    rotations, positions = motion.rotations(stamps), motion.positions(stamps)
    turns = rotations[:-1].inv() * rotations[1:]
    shifts = rotations[:-1].inv().apply(np.diff(positions, axis=0))
    roots = np.sqrt(np.linalg.norm(shifts, axis=1))[:, None]
    shifts = shifts + config.position_noise * roots * rng.normal(size=shifts.shape)
    turns = turns * Rotation.from_rotvec(
        config.rotation_noise * roots * rng.normal(size=shifts.shape)
    )
    place, attitude = np.zeros(3), Rotation.identity()
    places, attitudes = [place], [attitude.as_quat()]
    for shift, turn in zip(shifts, turns, strict=True):
        place, attitude = place + attitude.apply(shift), attitude * turn
        places.append(place)
        attitudes.append(attitude.as_quat())
    return np.array(places), np.array(attitudes)
