# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Motion of the body by the IMU, from the last state of the back end on."""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.geometry import NavState
from slam_graph.sensors import (
    ImuBuffer,
    ImuData,
    ImuNoise,
    integrate_rotation,
    predict,
    preintegrate,
    preintegration_params,
)

_HISTORY_NS = 2_000_000_000
"""How long samples are kept; frames and states of the back end are never that far behind."""

_MAX_GAP_NS = 30_000_000
"""Samples must begin and end no further than this from the times asked for: some samples of a slow
IMU may be missing, but not a frame's worth."""


class ImuMotion:
    """Integrates the IMU over short times.

    Attributes:
        state: the last one that the back end estimated, whose biases are used; None before.
    """

    def __init__(self, noise: ImuNoise, gravity: float) -> None:
        """Start without samples.

        Args:
            noise: of the IMU.
            gravity: magnitude in m/s².
        """
        self.state: NavState | None = None
        self._imu = ImuBuffer()
        self._params = preintegration_params(noise, gravity)

    def add(self, imu: ImuData) -> None:
        """Add samples that follow those already given; others are left out."""
        self._imu.add(imu)
        self._imu.forget_before(self._imu.newest_ns() - _HISTORY_NS)

    def rotation(self, start_ns: int, end_ns: int) -> gtsam.Rot3 | None:
        """start_R_end of the body, or None where samples are missing.

        Without a state the bias counts as zero.
        """
        if not self._covers(start_ns, end_ns):
            return None
        bias = np.zeros(3) if self.state is None else self.state.gyro_bias
        return integrate_rotation(self._imu.between(start_ns, end_ns), bias)

    def pose(self, stamp_ns: int) -> gtsam.Pose3 | None:
        """world_T_body, predicted from the last state; None without a state or samples."""
        state = self.state
        if state is None:
            return None
        if stamp_ns <= state.stamp_ns:
            return state.world_T_body if stamp_ns == state.stamp_ns else None
        if not self._covers(state.stamp_ns, stamp_ns):
            return None
        bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
        pim = preintegrate(self._imu.between(state.stamp_ns, stamp_ns), bias, self._params)
        return predict(state, pim, stamp_ns).world_T_body

    def _covers(self, start_ns: int, end_ns: int) -> bool:
        """Whether there are samples over a whole interval, which must not be empty."""
        stamps = self._imu.data.stamps_ns
        return (
            len(stamps) > 0
            and end_ns > start_ns
            and bool(stamps[0] <= start_ns + _MAX_GAP_NS)
            and bool(stamps[-1] >= end_ns - _MAX_GAP_NS)
        )
