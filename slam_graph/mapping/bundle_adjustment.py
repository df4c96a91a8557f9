# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visual-inertial bundle adjustment: all states of some keyframes and all their features at once.

The cost is that of the recursive estimators without a window (docs/bundle_adjustment.md), all of it
factors of GTSAM: preintegrated IMU between keyframes, projections, zero velocities, and a prior on
what no sensor sees. It is minimised by Levenberg-Marquardt, first with all observations, then
without outliers, on features triangulated and IMU samples preintegrated anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X
from numpy.typing import NDArray

from slam_graph.backend.config import BackendConfig
from slam_graph.backend.imu import imu_factor, preintegrate, preintegration_params
from slam_graph.backend.native_factors import ProjectionFactors, pixel_noise
from slam_graph.backend.reprojection import Geometry, RigProjection
from slam_graph.backend.state import stacked_points, stacked_poses
from slam_graph.backend.tracks import Observations
from slam_graph.backend.triangulation import triangulate
from slam_graph.backend.zero_velocity import zero_velocity_factors
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import NavState
from slam_graph.mapping.final_ba_config import FinalBaConfig
from slam_graph.mapping.keyframes import Keyframes, longest_tracks
from slam_graph.sensors.rig import Rig

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ANCHOR_SIGMA = 1e-3
"""Of position (m) and yaw (rad) of the anchor, which are free to choose."""
UNKNOWN_TILT_RAD = 10.0
"""Of roll and pitch of the anchor, which gravity tells."""
MIN_KEYFRAMES = 3
"""A feature must be seen in so many of them."""
MAX_START_ERROR_PX = 30.0
"""Features with a larger root mean square reprojection error do not begin, in units of σ."""
MAX_LAMBDA = 1e5
"""Damping beyond which there is no step that lowers the cost."""

Report = Callable[[float], None]
"""Is told the relative change of the cost after each step."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The minimum and what it took.

    Attributes:
        states: of every keyframe.
        features: number of features in the cost.
        observations: number of observations that were used to the end.
        outliers: number of observations that were left out.
        iterations: Levenberg-Marquardt steps.
        cost_before: where the last cost began.
        cost_after: at its minimum.
        imu_error: sum of the squared whitened residuals of the IMU.
        pixel_error: of the observations.
    """

    states: list[NavState]
    features: int
    observations: int
    outliers: int
    iterations: int
    cost_before: float
    cost_after: float
    imu_error: float = 0.0
    pixel_error: float = 0.0


class BundleAdjustment:
    """The problem of some keyframes.

    Args:
        keyframes: times, observations, IMU samples.
        states: where to begin.
        anchor: number of the keyframe that keeps its position and yaw.
        rig: calibrated sensors.
        backend: noise and triangulation.
        config: how to solve.
        report: is told of each step.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        states: list[NavState],
        anchor: int,
        rig: Rig,
        backend: BackendConfig,
        config: FinalBaConfig,
        report: Report,
    ) -> None:
        self._keyframes = keyframes
        self._anchor = anchor
        self._rig = rig
        self._projection = RigProjection(rig)
        self._backend = backend
        self._config = config
        self._report = report
        chosen = longest_tracks(keyframes.seen, config.features, MIN_KEYFRAMES)
        self._candidates = keyframes.seen.subset(chosen)
        self._iterations = 0
        self.values = gtsam.Values()
        for k, state in enumerate(states):
            self.values.insert(X(k), state.world_T_body)
            self.values.insert(V(k), np.asarray(state.velocity, dtype=np.float64))
            bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
            self.values.insert(B(k), bias)

    def solve(self) -> Adjustment:
        """Minimise, leave out outliers, and minimise again.

        Raises:
            EstimationError: if there is no minimum.
        """
        candidates = self._candidates
        points, good = self._triangulated(candidates)
        before, _ = self._minimize(candidates.subset(good), points[good])
        points, good = self._triangulated(candidates)
        points, good = self._known(candidates, points, good)
        used = candidates.rows(self._inliers(candidates, points) & good[candidates.feature])
        seen = _keyframes_of_each(used) >= MIN_KEYFRAMES
        used = used.subset(seen)
        _, after = self._minimize(used, points[seen])
        return Adjustment(
            [self._state(k) for k in range(len(self._keyframes))],
            len(used.ids),
            len(used),
            int(np.sum(good[candidates.feature])) - len(used),
            self._iterations,
            before,
            after,
            self._imu_cost,
            self._pixel_cost,
        )

    def _triangulated(self, obs: Observations) -> tuple[FloatArray, BoolArray]:
        """Points (J, 3) from the poses as they are, and which of them (J,) are usable."""
        rotations, positions = stacked_poses(self.values, obs.frames)
        found = triangulate(
            obs, self._projection, rotations, positions, self._backend.triangulation
        )
        limit_px = MAX_START_ERROR_PX * self._backend.noise.pixel_sigma
        return found.points, found.good & (found.reprojection_px < limit_px)

    def _known(
        self, obs: Observations, points: FloatArray, good: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """The same, with the estimates of the features that have one."""
        known = np.array([self.values.exists(L(j)) for j in obs.ids.tolist()], np.bool_)
        points[known] = stacked_points(self.values, obs.ids[known].tolist())
        return points, good | known

    def _inliers(self, obs: Observations, points: FloatArray) -> BoolArray:
        """Which observations (N,) fit."""
        at = Geometry(*stacked_poses(self.values, obs.frames), points)
        residuals, depths = self._projection.residuals(obs, at)
        limit_px = self._config.outlier_width * self._backend.noise.pixel_sigma
        near = depths > self._backend.triangulation.min_depth_m
        return near & (np.linalg.norm(residuals, axis=1) < limit_px)

    # --- the cost --------------------------------------------------------------------------------

    def _prior(self) -> list[gtsam.NonlinearFactor]:
        """Position and yaw of the anchor, and the first bias, loosely."""
        pose, bias = self.values.atPose3(X(self._anchor)), self.values.atConstantBias(B(0))
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

    def _dynamics(self) -> list[gtsam.NonlinearFactor]:
        """IMU between each keyframe and the next, and zero velocities."""
        factors: list[gtsam.NonlinearFactor] = []
        frames, noise = self._keyframes, self._backend.noise
        for k in range(len(frames) - 1):
            start_ns, end_ns = int(frames.stamps_ns[k]), int(frames.stamps_ns[k + 1])
            gap = frames.imu.largest_gap_s(start_ns, end_ns) > noise.max_imu_gap_s
            scale = noise.imu_scale * (noise.imu_gap_scale if gap else 1.0)
            gyro, accel = 0.5 * (frames.noise[k] + frames.noise[k + 1])
            params = preintegration_params(self._rig.imu, noise.gravity, scale, gyro, accel)
            bias = self.values.atConstantBias(B(k))
            pim = preintegrate(frames.imu.between(start_ns, end_ns), bias, params)
            factors.append(imu_factor(k, k + 1, pim))
            if frames.still[k + 1]:
                factors += zero_velocity_factors(k, k + 1, self._backend.zero_velocity)
        return factors

    # --- Levenberg-Marquardt ---------------------------------------------------------------------

    def _minimize(self, obs: Observations, points: FloatArray) -> tuple[float, float]:
        """Move the values to the minimum, and return the cost before and there."""
        count = len(self._keyframes)
        states = gtsam.Values()
        for k in range(count):
            states.insert(X(k), self.values.atPose3(X(k)))
            states.insert(V(k), self.values.atVector(V(k)))
            states.insert(B(k), self.values.atConstantBias(B(k)))
        for j, point in zip(obs.ids.tolist(), points, strict=True):
            states.insert(L(j), point)
        gating = self._backend.gating.model_copy(
            update={
                "robust_loss": self._config.robust_loss,
                "robust_width": self._config.robust_width,
            }
        )
        noise = pixel_noise(self._backend.noise.pixel_sigma, gating)
        dynamics = gtsam.NonlinearFactorGraph()
        for factor in self._prior() + self._dynamics():
            dynamics.push_back(factor)
        graph = gtsam.NonlinearFactorGraph(dynamics)
        projections = ProjectionFactors(self._rig, noise).of(obs)
        for factor in projections:
            graph.push_back(factor)
        ordering = gtsam.Ordering()
        for j in obs.ids.tolist():
            ordering.push_back(L(j))
        for k in range(count):
            for key in (X(k), V(k), B(k)):
                ordering.push_back(key)
        import os
        if os.environ.get("COLAMD"):
            ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
        params = gtsam.LevenbergMarquardtParams()
        params.setOrdering(ordering)
        import time
        t=time.time()
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, states, params)
        before = cost = optimizer.error()
        for _ in range(self._config.max_iterations):
            optimizer.iterate()
            self._iterations += 1
            fallen = (cost - optimizer.error()) / max(cost, 1e-300)
            cost = optimizer.error()
            self._report(fallen)
            if fallen < self._config.tolerance or optimizer.lambda_() > MAX_LAMBDA:
                break
        if not np.isfinite(cost):
            raise EstimationError("the cost of the bundle adjustment is not finite")
        self.values = optimizer.values()
        self._imu_cost = dynamics.error(self.values)
        self._pixel_cost = cost - self._imu_cost
        print("LM", before, cost, self._iterations, len(obs), len(obs.ids), time.time()-t)
        return before, cost

    def _state(self, k: int) -> NavState:
        bias = self.values.atConstantBias(B(k))
        return NavState(
            int(self._keyframes.stamps_ns[k]),
            self.values.atPose3(X(k)),
            np.asarray(self.values.atVector(V(k))),
            np.asarray(bias.gyroscope()),
            np.asarray(bias.accelerometer()),
        )


def _keyframes_of_each(obs: Observations) -> NDArray[np.int64]:
    """Number (J,) of keyframes that see each feature."""
    new = np.ones(len(obs), np.bool_)
    new[1:] = (np.diff(obs.feature) != 0) | (np.diff(obs.frame) != 0)
    return np.bincount(obs.feature[new], minlength=len(obs.ids))
