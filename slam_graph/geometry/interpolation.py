# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Interpolation of trajectories: positions linearly, orientations by slerp."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.geometry.trajectory import Trajectory

DEFAULT_MAX_GAP_S = 0.2
"""Four frames at 20 Hz; over a longer gap a straight line says little of the motion."""


def interpolate(
    trajectory: Trajectory, stamps_ns: IntArray, max_gap_s: float = DEFAULT_MAX_GAP_S
) -> tuple[Trajectory, BoolArray]:
    """The trajectory at those of the given times that have poses before and after, near enough.

    Args:
        trajectory: of at least one pose.
        stamps_ns: (M,) increasing times.
        max_gap_s: inside a longer gap between poses nothing is interpolated.

    Returns:
        The trajectory at the K times that can be interpolated, and a mask (M,) of which these are.
    """
    times = trajectory.stamps_ns
    after = np.clip(np.searchsorted(times, stamps_ns), 0, len(times) - 1)
    before = np.where(times[after] == stamps_ns, after, np.maximum(after - 1, 0))
    inside = (times[before] <= stamps_ns) & (stamps_ns <= times[after])
    valid = inside & (times[after] - times[before] <= round(max_gap_s * 1e9))
    before, after, queries = before[valid], after[valid], stamps_ns[valid]
    length = np.maximum(times[after] - times[before], 1)
    weight = ((queries - times[before]) / length)[:, None]

    def blend(values: FloatArray | None) -> FloatArray | None:
        if values is None:
            return None
        mixed: FloatArray = values[before] * (1.0 - weight) + values[after] * weight
        return mixed

    positions = blend(trajectory.positions)
    assert positions is not None
    return (
        Trajectory(
            queries,
            positions,
            _slerp(trajectory.quaternions[before], trajectory.quaternions[after], weight),
            blend(trajectory.velocities),
            accel_biases=blend(trajectory.accel_biases),
            gyro_biases=blend(trajectory.gyro_biases),
        ),
        valid,
    )


def _slerp(start: FloatArray, end: FloatArray, weight: FloatArray) -> FloatArray:
    """Quaternions (K, 4) at weights (K, 1) of the way from `start` to `end`."""
    if len(start) == 0:
        return start
    first = Rotation.from_quat(start)
    step = (first.inv() * Rotation.from_quat(end)).as_rotvec()
    return np.asarray((first * Rotation.from_rotvec(step * weight)).as_quat())
