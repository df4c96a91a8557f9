# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The terms of the cost over a whole recording, as factors of GTSAM (docs/bundle_adjustment.md).

Keyframe k has the pose X(k), the velocity V(k) and the bias B(k), feature j the position L(j).
"""

from __future__ import annotations

import math
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X
from numpy.typing import NDArray

from slam_graph.backend.config import BackendConfig
from slam_graph.backend.imu import imu_factor, preintegrate, preintegration_params
from slam_graph.backend.native_factors import ProjectionFactors, pixel_noise
from slam_graph.backend.tracks import Observations
from slam_graph.backend.zero_velocity import zero_velocity_factors
from slam_graph.mapping.final_ba_config import FinalBaConfig
from slam_graph.mapping.keyframes import Piece
from slam_graph.sensors.rig import Rig

FloatArray = NDArray[np.float64]

ANCHOR_SIGMA = 1e-3
"""Of position (m) and yaw (rad) of the anchor, which are free to choose."""
UNKNOWN_TILT_RAD = 10.0
"""Of roll and pitch of the anchor, which gravity tells."""


class RecordingCost:
    """Builds the terms.

    Args:
        piece: times and IMU samples.
        anchor: number of the keyframe that keeps its position and yaw.
        rig: calibrated sensors, with cameras that GTSAM has a model of.
        backend: noise.
        config: loss, and how well the first bias is known.
    """

    def __init__(
        self, piece: Piece, anchor: int, rig: Rig, backend: BackendConfig, config: FinalBaConfig
    ) -> None:
        self._piece, self._anchor, self._rig = piece, anchor, rig
        self._backend, self._config = backend, config

    def inertial(self, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Prior, IMU and zero velocities, with samples preintegrated at the biases of `values`."""
        return _graph(self._prior(values) + self._dynamics(values))

    def projections(
        self, obs: Observations, variances: FloatArray, sigma_px: float
    ) -> gtsam.NonlinearFactorGraph:
        """A factor for each observation.

        Args:
            obs: frame k of it is keyframe k.
            variances: (N,) of each, over that of a single observation.
            sigma_px: standard deviation of a single one.
        """
        robust = {
            "robust_loss": self._config.robust_loss,
            "robust_width": self._config.robust_width,
        }
        gating = self._backend.gating.model_copy(update=robust)
        factors: list[gtsam.NonlinearFactor] = []
        for variance in np.unique(variances).tolist():  # one for each size of a group
            noise = pixel_noise(sigma_px * math.sqrt(variance), gating)
            factors += ProjectionFactors(self._rig, noise).of(obs.rows(variances == variance))
        return _graph(factors)

    def _prior(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """Position and yaw of the anchor, and the first bias, loosely."""
        pose, bias = values.atPose3(X(self._anchor)), values.atConstantBias(B(0))
        sigmas = np.diag([UNKNOWN_TILT_RAD, UNKNOWN_TILT_RAD, ANCHOR_SIGMA])
        root = pose.rotation().matrix().T @ sigmas
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = root @ root.T
        covariance[3:, 3:] = np.eye(3) * ANCHOR_SIGMA**2
        gauge = gtsam.noiseModel.Gaussian.Covariance(covariance)
        loose = gtsam.noiseModel.Diagonal.Sigmas(
            np.repeat([self._config.accel_bias_sigma, self._config.gyro_bias_sigma], 3)
        )
        return [
            gtsam.PriorFactorPose3(X(self._anchor), pose, gauge),
            gtsam.PriorFactorConstantBias(B(0), bias, loose),
        ]

    def _dynamics(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """IMU between each keyframe and the next, and zero velocities."""
        factors: list[gtsam.NonlinearFactor] = []
        imu, noise = self._piece.imu, self._backend.noise
        stamps_ns = self._piece.keyframe_stamps_ns.tolist()
        for k, (i, j) in enumerate(pairwise(self._piece.keyframes.tolist())):
            start_ns, end_ns = stamps_ns[k], stamps_ns[k + 1]
            gap = imu.largest_gap_s(start_ns, end_ns) > noise.max_imu_gap_s
            scale = noise.imu_scale * (noise.imu_gap_scale if gap else 1.0)
            # of noise that is not stationary, variances add up
            gyro, accel = np.sqrt(np.mean(self._piece.noise[i + 1 : j + 1] ** 2, axis=0))
            params = preintegration_params(self._rig.imu, noise.gravity, scale, gyro, accel)
            pim = preintegrate(imu.between(start_ns, end_ns), values.atConstantBias(B(k)), params)
            factors.append(imu_factor(k, k + 1, pim))
            if self._piece.still[i + 1 : j + 1].all():
                factors += zero_velocity_factors(k, k + 1, self._backend.zero_velocity)
        return factors


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """The factors as a graph."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph
