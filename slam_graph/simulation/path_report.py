# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How the path of a recorded flight differs from its ground truth and from its IMU."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.geometry import Trajectory
from slam_graph.sensors import ImuData, ImuNoise
from slam_graph.simulation.motion import GRAVITY

JUMP_M = 5e-3
_JUMP_TO_NOISE = 8.0
"""The ground truth jumps where a step differs from that of the path by more than this, and by more
than this many times the median difference."""

_JUMP_REACH_S = 1.0
"""Time around a jump that counts as disturbed by it."""


@dataclass(frozen=True, eq=False)
class PathReport:
    """How a consistent path differs from the ground truth and from the IMU.

    Attributes:
        jumps_ns, jumps_m: (J,) times, by the clock of the IMU, and sizes of the jumps of the truth.
        bridged_s: total length of the gaps of the ground truth.
        late_s: how much later the positions of the ground truth are than the IMU says, which is
            corrected; 0 if it is little.
        position_rms_m, position_p95_m, position_max_m: distance from the ground truth where it does
            not jump.
        rotation_offset_rad: (3,) constant rotation path_R_truth of the body.
        rotation_rms_rad: the rest of the difference in orientation.
        gyro_ratio, accel_ratio: standard deviation of the recorded samples minus those of the
            path, relative to that of white noise of the calibrated density.
        gyro_correlation, accel_correlation: correlation of neighbouring differences.
    """

    jumps_ns: IntArray
    jumps_m: FloatArray
    bridged_s: float
    late_s: float
    position_rms_m: float
    position_p95_m: float
    position_max_m: float
    rotation_offset_rad: FloatArray
    rotation_rms_rad: float
    gyro_ratio: float
    accel_ratio: float
    gyro_correlation: float
    accel_correlation: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON: lists and numbers."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in values.items()
        }

    def lines(self) -> dict[str, str]:
        """For people: what was found, by name."""
        jumps = "none"
        if len(self.jumps_m):
            jumps = f"{len(self.jumps_m)}, the largest of {1e3 * np.max(self.jumps_m):.0f} mm"
        offset = float(np.rad2deg(np.linalg.norm(self.rotation_offset_rad)))
        late = f"{1e3 * abs(self.late_s):.0f} ms {'late' if self.late_s > 0.0 else 'early'}"
        return {
            "positions of the truth": f"{late}, corrected" if self.late_s else "in time",
            "jumps of the truth": jumps,
            "path to truth": f"{1e3 * self.position_rms_m:.1f} mm rms, 95 % within "
            f"{1e3 * self.position_p95_m:.0f} mm, {1e3 * self.position_max_m:.0f} mm at most; "
            f"{offset:.2f} deg constant, {np.rad2deg(self.rotation_rms_rad):.2f} deg rms",
            "gaps of the truth": f"{self.bridged_s:.1f} s bridged by the IMU",
            "IMU to path": f"gyroscope {self.gyro_ratio:.2f}, accelerometer "
            f"{self.accel_ratio:.2f} of the calibrated noise; correlation of neighbours "
            f"{self.gyro_correlation:.2f}, {self.accel_correlation:.2f}",
        }


def report_on(
    truth: Trajectory,
    path: Trajectory,
    imu: ImuData,
    noise: ImuNoise,
    offset: Rotation,
    late_s: float,
) -> PathReport:
    """How a path differs from the ground truth and the IMU that it was estimated from.

    Args:
        truth: the recorded poses, with positions at the times of the IMU.
        path: at the times of the samples, with velocities and biases.
        imu: the recorded samples.
        noise: calibrated densities of the IMU.
        offset: constant rotation path_R_truth of the body.
        late_s: how much later the recorded positions were.
    """
    seconds = (path.stamps_ns - path.stamps_ns[0]) * 1e-9
    at = (truth.stamps_ns - path.stamps_ns[0]) * 1e-9
    inside = (at >= seconds[0]) & (at <= seconds[-1])
    stamps, at = truth.stamps_ns[inside], at[inside]
    flown = np.stack([np.interp(at, seconds, column) for column in path.positions.T], axis=1)
    difference = truth.positions[inside] - flown
    steps = np.linalg.norm(np.diff(difference, axis=0), axis=1)
    dense = np.diff(at) < 2.0 * np.median(np.diff(at))
    jumps = np.flatnonzero((steps > max(JUMP_M, _JUMP_TO_NOISE * float(np.median(steps)))) & dense)
    calm = ~_near(at, at[jumps])
    distance = np.linalg.norm(difference, axis=1)[calm]
    turned = Rotation.from_quat(truth.quaternions[inside]) * offset.inv()
    rotations = Slerp(seconds, Rotation.from_quat(path.quaternions))(at)
    wander = (turned.inv() * rotations).magnitude()[calm]
    gyro, accel = _differences(path, imu)
    root_rate = 1.0 / float(np.sqrt(np.median(np.diff(seconds))))
    gaps = np.diff(at)[np.diff(at) > 0.1]
    return PathReport(
        stamps[jumps],
        steps[jumps],
        float(np.sum(gaps)),
        late_s,
        float(np.sqrt(np.mean(distance**2))),
        float(np.percentile(distance, 95)),
        float(np.max(distance)),
        offset.as_rotvec(),
        float(np.sqrt(np.mean(wander**2))),
        float(np.std(gyro)) / (noise.gyro_noise_density * root_rate),
        float(np.std(accel)) / (noise.accel_noise_density * root_rate),
        _neighbours(gyro),
        _neighbours(accel),
    )


def _near(times: FloatArray, events: FloatArray) -> BoolArray:
    near = np.zeros(len(times), dtype=bool)
    for event in events:
        near |= np.abs(times - event) < _JUMP_REACH_S
    return near


def _differences(path: Trajectory, imu: ImuData) -> tuple[FloatArray, FloatArray]:
    """Recorded rates and specific forces minus those of the path and its biases, (N - 1, 3).

    Between two samples the mean rate of the path is compared with the mean of the samples. As
    neighbouring means share a sample, every second one is taken.
    """
    assert path.velocities is not None
    assert path.gyro_biases is not None
    assert path.accel_biases is not None
    rotations, dt = Rotation.from_quat(path.quaternions), np.diff(path.stamps_ns)[:, None] * 1e-9
    turn = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    gyro = 0.5 * (imu.gyro[1:] + imu.gyro[:-1]) - path.gyro_biases[:-1] - turn / dt
    acceleration = np.diff(path.velocities, axis=0) / dt - GRAVITY
    half = rotations[:-1] * Rotation.from_rotvec(0.5 * turn)
    force = half.inv().apply(acceleration)
    accel = 0.5 * (imu.accel[1:] + imu.accel[:-1]) - path.accel_biases[:-1] - force
    # the mean of two samples has half the variance of one
    return np.sqrt(2.0) * gyro[::2], np.sqrt(2.0) * accel[::2]


def _neighbours(values: FloatArray) -> float:
    """Correlation of neighbouring rows of (N, 3), over the columns."""
    centred = values - values.mean(axis=0)
    return float(np.sum(centred[1:] * centred[:-1]) / np.sum(centred**2))
