# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of simulated tours through three rooms, at poses that drift in yaw and position."""

from typing import cast

import gtsam
import numpy as np

from slam_graph.geometry.trajectory import Trajectory
from slam_graph.loop_closure.loop_config import KeyframeConfig, LoopClosureConfig, PlaceConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe, KeyframeLog
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulated_sequence import SimulatedTracks
from slam_graph.simulation.simulation_config import (
    FlightConfig,
    LandmarkConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

YAW_DRIFT, POSITION_DRIFT = 5e-3, 0.01
"""rad/√s, and m/√s on each axis."""

CONFIG = LoopClosureConfig(
    places=PlaceConfig(words=500),
    odometry_rotation_sigma=YAW_DRIFT,
    odometry_position_sigma=POSITION_DRIFT,
)


def tour(
    seed: int, duration_s: float = 75.0, descriptors: int = 2000
) -> tuple[Rig, list[Keyframe], Trajectory, Trajectory]:
    """A flight without an estimator: the truth plus a random walk stands in for its trajectory.

    Args:
        seed: of everything.
        duration_s: how long; a lap takes 40 s.
        descriptors: how many different ones there are.

    Returns:
        The rig, keyframes at drifting poses, the drifting trajectory, and the truth.
    """
    config = SimulationConfig(
        trajectory="rooms",
        duration_s=duration_s,
        seed=seed,
        rate_hz=4.0,
        flight=FlightConfig(hover_s=0.0),
        landmarks=LandmarkConfig(density=4.0),
        tracks=TrackConfig(
            features=80, outliers=0.01, descriptors=True, distinct_descriptors=descriptors
        ),
    )
    sequence = cast(SimulatedTracks, simulate(config))
    truth = sequence.groundtruth()
    drifting = drift(truth, np.random.default_rng(seed))
    log = KeyframeLog(sequence.rig, KeyframeConfig())
    for row, frame in enumerate(sequence.frames()):
        log.add(frame, drifting.pose(row))
    return sequence.rig, log.keyframes, drifting, truth


def drift(truth: Trajectory, rng: np.random.Generator) -> Trajectory:
    """A trajectory whose steps are true up to white noise of yaw and position."""
    pose, positions, quaternions = truth.pose(0), [], []
    root_s = np.sqrt(np.diff(truth.stamps_ns, prepend=truth.stamps_ns[0]) * 1e-9)
    for row in range(len(truth)):
        step = truth.pose(max(row - 1, 0)).between(truth.pose(row))
        pose = pose.compose(step)
        yaw = gtsam.Rot3.Rz(rng.normal(0.0, YAW_DRIFT * root_s[row]))
        moved = pose.translation() + rng.normal(0.0, POSITION_DRIFT * root_s[row], 3)
        pose = gtsam.Pose3(yaw * pose.rotation(), moved)
        positions.append(pose.translation())
        quaternions.append(pose.rotation().toQuaternion().coeffs())
    return Trajectory(truth.stamps_ns, np.array(positions), np.array(quaternions))


def true_relative(keyframes: list[Keyframe], truth: Trajectory, i: int, j: int) -> gtsam.Pose3:
    """i_T_j of two keyframes."""
    rows = np.searchsorted(truth.stamps_ns, [keyframes[i].stamp_ns, keyframes[j].stamp_ns])
    return truth.pose(int(rows[0])).between(truth.pose(int(rows[1])))
