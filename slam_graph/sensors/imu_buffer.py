# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The IMU between two times: the buffer of recent samples, and their integration.

Samples are taken as instantaneous values of a signal that is linear between them: from one sample
to the next the mean of the two is integrated. Back end, smoothing and front end all integrate with
the functions of this module.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry import NavState
from slam_graph.sensors.measurements import ImuData
from slam_graph.sensors.rig import ImuNoise

STANDARD_GRAVITY = 9.81
"""Magnitude of gravity in m/s² where the settings (`backend.noise.gravity`) are not at hand."""

_FAR_FUTURE_NS = 2**62

_INTEGRATION_SIGMA = 1e-5
"""Error of the position integration itself, m/√s; it keeps the preintegrated covariance regular."""


class ImuBuffer:
    """The recent IMU samples, kept as long as a frame may still need them."""

    def __init__(self) -> None:
        self.data = ImuData.empty()

    def add(self, imu: ImuData) -> int:
        """Append samples.

        Samples that are not finite, or not later than those before them, are left out.

        Returns:
            How many were left out.
        """
        newest = self.data.stamps_ns[-1] if len(self.data) else np.iinfo(np.int64).min
        latest = np.maximum.accumulate(np.concatenate([[newest], imu.stamps_ns]))[:-1]
        good = (imu.stamps_ns > latest) & np.isfinite(imu.gyro).all(axis=1)
        good &= np.isfinite(imu.accel).all(axis=1)
        if good.any():
            rows = ImuData(imu.stamps_ns[good], imu.gyro[good], imu.accel[good])
            self.data = ImuData.concatenate([self.data, rows])
        return int(np.sum(~good))

    def newest_ns(self) -> int:
        """Time of the last sample; far in the future as long as there is none."""
        return int(self.data.stamps_ns[-1]) if len(self.data) else _FAR_FUTURE_NS

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the samples before the last one at or before `stamp_ns`."""
        first = int(np.searchsorted(self.data.stamps_ns, stamp_ns, side="right")) - 1
        if first > 0:
            self.data = self.data[first:]

    def covers(self, stamp_ns: int) -> bool:
        """Whether there is a sample at or before `stamp_ns`."""
        return len(self.data) > 0 and int(self.data.stamps_ns[0]) <= stamp_ns

    def largest_gap_s(self, start_ns: int, end_ns: int) -> float:
        """Longest time between consecutive samples around an interval; infinite without samples."""
        if len(self.data) == 0:
            return float("inf")
        t = self.data.stamps_ns
        before = t[: int(np.searchsorted(t, start_ns, side="right"))][-1:]
        after = t[int(np.searchsorted(t, end_ns)) :][:1]
        inside = t[(t > start_ns) & (t < end_ns)]
        first = before if len(before) else [start_ns]
        last = after if len(after) else [end_ns]
        return float(np.max(np.diff(np.concatenate([first, inside, last])))) * 1e-9

    def between(self, start_ns: int, end_ns: int) -> ImuData:
        """Samples at both ends (interpolated, or the nearest held) and all in between."""
        t = self.data.stamps_ns
        if len(t) == 0:  # nothing known: the caller asks `largest_gap_s` first
            return ImuData(np.array([start_ns, end_ns]), np.zeros((2, 3)), np.zeros((2, 3)))
        inside = slice(
            int(np.searchsorted(t, start_ns, side="right")), int(np.searchsorted(t, end_ns))
        )
        around = slice(max(inside.start - 1, 0), inside.stop + 1)
        stamps = np.concatenate([[start_ns], t[inside], [end_ns]])
        seconds = (t[around] - start_ns) * 1e-9
        at = (stamps - start_ns) * 1e-9
        gyro, accel = (
            np.stack([np.interp(at, seconds, values[around, axis]) for axis in range(3)], axis=1)
            for values in (self.data.gyro, self.data.accel)
        )
        return ImuData(stamps, gyro, accel)


def _steps(samples: ImuData) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Durations (K - 1,) in s between samples, mean rates and specific forces (K - 1, 3)."""
    gyro = 0.5 * (samples.gyro[1:] + samples.gyro[:-1])
    accel = 0.5 * (samples.accel[1:] + samples.accel[:-1])
    return np.diff(samples.stamps_ns) * 1e-9, gyro, accel


def integrate_rotation(samples: ImuData, gyro_bias: FloatArray) -> gtsam.Rot3:
    """Rotation start_R_end of the body from the first to the last sample.

    Args:
        samples: at least one; `ImuBuffer.between` gives them with the ends in place.
        gyro_bias: (3,) rad/s.
    """
    durations_s, gyro, _ = _steps(samples)
    start_R_end = gtsam.Rot3()
    for turn in (gyro - gyro_bias) * durations_s[:, None]:
        start_R_end = start_R_end * gtsam.Rot3.Expmap(turn)
    return start_R_end


def preintegration_params(
    noise: ImuNoise,
    gravity: float,
    scale: float = 1.0,
    gyro_scale: float = 1.0,
    accel_scale: float = 1.0,
) -> gtsam.PreintegrationCombinedParams:
    """GTSAM's parameters for an IMU.

    Args:
        noise: continuous-time densities.
        gravity: magnitude in m/s²; the world's z axis points up.
        scale: factor on all densities.
        gyro_scale: factor on the white noise of the gyroscope.
        accel_scale: factor on that of the accelerometer.
    """
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)
    eye = np.eye(3)
    params.setGyroscopeCovariance(eye * (scale * gyro_scale * noise.gyro_noise_density) ** 2)
    params.setAccelerometerCovariance(eye * (scale * accel_scale * noise.accel_noise_density) ** 2)
    params.setBiasOmegaCovariance(eye * (scale * noise.gyro_random_walk) ** 2)
    params.setBiasAccCovariance(eye * (scale * noise.accel_random_walk) ** 2)
    params.setIntegrationCovariance(eye * _INTEGRATION_SIGMA**2)
    return params


def preintegrate(
    samples: ImuData,
    bias: gtsam.imuBias.ConstantBias,
    params: gtsam.PreintegrationCombinedParams,
) -> gtsam.PreintegratedCombinedMeasurements:
    """Preintegrate from the first to the last sample (Forster et al. 2017).

    Args:
        samples: at least two; `ImuBuffer.between` gives them with the ends in place.
        bias: at which the integration is linearised.
        params: noise of the IMU.
    """
    pim = gtsam.PreintegratedCombinedMeasurements(params, bias)
    durations_s, gyro, accel = _steps(samples)
    # GTSAM turns the specific force by the attitude at the start of a step; this is half a step on
    half_turn = 0.5 * durations_s[:, None] * (gyro - bias.gyroscope())
    accel = accel + np.cross(half_turn, accel - bias.accelerometer())
    for a, w, dt in zip(accel, gyro, durations_s.tolist(), strict=True):
        pim.integrateMeasurement(a, w, dt)
    return pim


def predict(
    state: NavState, pim: gtsam.PreintegratedCombinedMeasurements, stamp_ns: int
) -> NavState:
    """The state at the end of a preintegration that began at `state`: g(x_t)."""
    bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
    there = pim.predict(gtsam.NavState(state.world_T_body, state.velocity), bias)
    return NavState(
        stamp_ns,
        there.pose(),
        np.asarray(there.velocity()),
        accel_bias=state.accel_bias,
        gyro_bias=state.gyro_bias,
    )
