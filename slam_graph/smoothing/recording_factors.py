# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The factors of the cost over a recording, in GTSAM (docs/bundle_adjustment.md).

Keyframe k has the pose X(k), the velocity V(k) and the bias B(k), feature j the position L(j).
"""

from __future__ import annotations

import math
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X

from slam_graph.arrays import FloatArray
from slam_graph.backend import (
    IMU_GAP_SCALE,
    BackendConfig,
    Observations,
    ProjectionFactors,
    RobustLoss,
    imu_factor,
    pixel_noise,
    zero_velocity_factors,
)
from slam_graph.sensors import Rig, preintegrate, preintegration_params
from slam_graph.smoothing.recording_segment import RecordingSegment
from slam_graph.smoothing.smoothing_config import FinalBaConfig

_ANCHOR_SIGMA = 1e-3
"""Prior on position (m) and yaw (rad) of the anchor, which are unobservable: it fixes the gauge."""
_UNKNOWN_TILT_RAD = 10.0
"""Prior on roll and pitch of the anchor, which gravity determines: none."""
GYRO_BIAS_SIGMA = 0.05
"""Prior on the first gyroscope bias, rad/s: loose, as the estimate of a filter after its start."""
ACCEL_BIAS_SIGMA = 0.3
"""Prior on the first accelerometer bias, m/s²: loose, as above."""


class RecordingFactors:
    """Builds the factors of a segment.

    Args:
        segment: times and IMU samples.
        anchor: number of the keyframe whose position and yaw are fixed.
        rig: calibrated sensors, with cameras that GTSAM has (`with_gtsam_cameras`).
        backend: noise.
        config: the robust loss.
    """

    def __init__(
        self,
        segment: RecordingSegment,
        anchor: int,
        rig: Rig,
        backend: BackendConfig,
        config: FinalBaConfig,
    ) -> None:
        self._segment, self._anchor, self._rig = segment, anchor, rig
        self._backend, self._config = backend, config

    def inertial(self, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Priors, IMU and zero-velocity factors, preintegrated at the biases of `values`."""
        return _graph(self._prior(values) + self._dynamics(values))

    def projections(
        self, obs: Observations, variances: FloatArray, sigma_px: float
    ) -> gtsam.NonlinearFactorGraph:
        """One projection factor for each observation.

        Args:
            obs: of the keyframes; frame indices are those of keyframes.
            variances: (N,) relative to that of a single observation.
            sigma_px: standard deviation of a single observation.
        """
        loss = RobustLoss(self._config.robust_loss, self._config.robust_width)
        factors: list[gtsam.NonlinearFactor] = []
        for variance in np.unique(variances).tolist():  # one noise model for each group size
            noise = pixel_noise(sigma_px * math.sqrt(variance), loss)
            factors += ProjectionFactors(self._rig, noise).of(obs.rows(variances == variance))
        return _graph(factors)

    def _prior(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """Priors on position and yaw of the anchor, and a loose one on the first bias."""
        pose, bias = values.atPose3(X(self._anchor)), values.atConstantBias(B(0))
        sigmas = np.diag([_UNKNOWN_TILT_RAD, _UNKNOWN_TILT_RAD, _ANCHOR_SIGMA])
        root = pose.rotation().matrix().T @ sigmas
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = root @ root.T
        covariance[3:, 3:] = np.eye(3) * _ANCHOR_SIGMA**2
        gauge = gtsam.noiseModel.Gaussian.Covariance(covariance)
        loose = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3))
        return [
            gtsam.PriorFactorPose3(X(self._anchor), pose, gauge),
            gtsam.PriorFactorConstantBias(B(0), bias, loose),
        ]

    def _dynamics(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """IMU factors between consecutive keyframes, and zero-velocity factors."""
        factors: list[gtsam.NonlinearFactor] = []
        imu, noise = self._segment.imu, self._backend.noise
        stamps_ns = self._segment.keyframe_stamps_ns.tolist()
        for k, (i, j) in enumerate(pairwise(self._segment.keyframes.tolist())):
            start_ns, end_ns = stamps_ns[k], stamps_ns[k + 1]
            gap = imu.largest_gap_s(start_ns, end_ns) > noise.max_imu_gap_s
            scale = noise.imu_scale * (IMU_GAP_SCALE if gap else 1.0)
            # variances of non-stationary noise add up
            gyro, accel = np.sqrt(np.mean(self._segment.noise[i + 1 : j + 1] ** 2, axis=0))
            params = preintegration_params(self._rig.imu, noise.gravity, scale, gyro, accel)
            pim = preintegrate(imu.between(start_ns, end_ns), values.atConstantBias(B(k)), params)
            factors.append(imu_factor(k, k + 1, pim))
            if self._segment.still[i + 1 : j + 1].all():
                factors += zero_velocity_factors(k, k + 1)
        return factors


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """The factors as a graph."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph
