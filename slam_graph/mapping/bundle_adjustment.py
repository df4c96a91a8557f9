# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visual-inertial bundle adjustment: all states of some keyframes and all their features at once.

The cost is that of the recursive estimators without a window (docs/bundle_adjustment.md), all of it
factors of GTSAM: preintegrated IMU between keyframes, projections, zero velocities, and a prior on
what no sensor sees. It is minimised by Levenberg-Marquardt, first with all observations, then
without outliers, on features triangulated and IMU samples preintegrated anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

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
from slam_graph.mapping.averaged_observations import averaged, nearest_keyframe
from slam_graph.mapping.final_ba_config import FinalBaConfig
from slam_graph.mapping.keyframe_states import fill_in
from slam_graph.mapping.keyframes import Piece, longest_tracks, views, with_native_cameras
from slam_graph.sensors.rig import Rig

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

ANCHOR_SIGMA = 1e-3
"""Of position (m) and yaw (rad) of the anchor, which are free to choose."""
UNKNOWN_TILT_RAD = 10.0
"""Of roll and pitch of the anchor, which gravity tells."""
MIN_KEYFRAMES = 3
"""A feature must be seen in so many of them."""
MAX_START_ERROR_PX = 30.0
"""Features with a larger root mean square reprojection error do not begin, in units of σ."""
RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))
LEAST_SIGMA = 0.1
"""Learned noise of the tracks is not less than this part of what the settings say, nor more."""
MAX_LAMBDA = 1e5
"""Damping beyond which there is no step that lowers the cost."""

Report = Callable[[int], None]
"""Is told the number of steps after each."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The minimum and what it took.

    Attributes:
        states: of every frame.
        keyframes: number of keyframes.
        features: number of features in the cost.
        observations: number of observations in the cost.
        iterations: Levenberg-Marquardt steps.
        cost_before: of all observations, where it began.
        cost_after: without outliers, at the minimum.
        imu_residual: root mean square of the whitened residuals of the IMU.
        pixel_residual: of the observations.
        pixel_sigma: standard deviation of these that was assumed at the end.
    """

    states: list[NavState]
    keyframes: int
    features: int
    observations: int
    iterations: int
    cost_before: float
    cost_after: float
    imu_residual: float
    pixel_residual: float
    pixel_sigma: float


class BundleAdjustment:
    """The problem of a piece of a recording.

    Args:
        piece: times, observations, IMU samples.
        states: of the keyframes, where to begin.
        anchor: number of the keyframe that keeps its position and yaw.
        rig: calibrated sensors.
        backend: noise and triangulation.
        config: how to solve.
        report: is told of each step.
    """

    def __init__(
        self,
        piece: Piece,
        states: list[NavState],
        anchor: int,
        rig: Rig,
        backend: BackendConfig,
        config: FinalBaConfig,
        report: Report,
    ) -> None:
        self._piece = piece
        self._anchor = anchor
        self._rig = with_native_cameras(rig)
        self._projection = RigProjection(self._rig)
        self._backend = backend
        self._config = config
        self._report = report
        seen = piece.seen_by_keyframes()
        chosen = longest_tracks(seen, config.features, MIN_KEYFRAMES)
        self._candidates = seen.subset(chosen)
        self._everything = piece.seen.subset(chosen)
        self._iterations = 0
        self._sigma_px = backend.noise.pixel_sigma
        self._values = gtsam.Values()
        for k, state in enumerate(states):
            self._values.insert(X(k), state.world_T_body)
            self._values.insert(V(k), np.asarray(state.velocity, dtype=np.float64))
            bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
            self._values.insert(B(k), bias)

    def solve(self) -> Adjustment:
        """Minimise, leave out outliers, and minimise again.

        Raises:
            EstimationError: if there is no minimum.
        """
        points, good = self._triangulated(self._candidates)
        obs = self._candidates.subset(good)
        before, *_ = self._minimize(obs, points[good], np.ones(len(obs)))
        points, good = self._triangulated(self._candidates)
        points, good = self._known(self._candidates, points, good)
        if self._config.learn_pixel_sigma:
            self._learn_pixel_sigma(self._candidates.subset(good), points[good])
        obs, points, variances = self._without_outliers(good, points[good])
        _, cost, imu_cost = self._minimize(obs, points, variances)
        dynamics = 15 * max(len(self._piece.keyframes) - 1, 1)
        return Adjustment(
            self._states(),
            len(self._piece.keyframes),
            len(obs.ids),
            len(obs),
            self._iterations,
            before,
            cost,
            float(np.sqrt(2.0 * imu_cost / dynamics)),
            float(np.sqrt((cost - imu_cost) / max(len(obs), 1))),
            self._sigma_px,
        )

    # --- features --------------------------------------------------------------------------------

    def _triangulated(self, obs: Observations) -> tuple[FloatArray, BoolArray]:
        """Points (J, 3) from the poses as they are, and which of them (J,) are usable."""
        poses = stacked_poses(self._values, obs.frames)
        found = triangulate(obs, self._projection, *poses, self._backend.triangulation)
        limit_px = MAX_START_ERROR_PX * self._backend.noise.pixel_sigma
        return found.points, found.good & (found.reprojection_px < limit_px)

    def _known(
        self, obs: Observations, points: FloatArray, good: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """The same, with the estimates of the features that have one."""
        known = np.array([self._values.exists(L(j)) for j in obs.ids.tolist()], np.bool_)
        points[known] = stacked_points(self._values, obs.ids[known].tolist())
        return points, good | known

    def _learn_pixel_sigma(self, obs: Observations, points: FloatArray) -> None:
        """The noise of the tracks from the median of what the minimum leaves of them.

        A few outliers do not change a median. The length of a residual of standard deviation σ on
        both axes has the median 1.1774 σ (Rayleigh); the minimum has taken away as many degrees of
        freedom as there are unknowns.
        """
        at = Geometry(*stacked_poses(self._values, obs.frames), points)
        lengths = np.linalg.norm(self._projection.residuals(obs, at)[0], axis=1)
        unknowns = 3 * len(obs.ids) + 6 * len(self._piece.keyframes)
        freedom = 2 * len(obs) - unknowns
        if freedom <= unknowns:
            return
        sigma_px = float(np.median(lengths)) / RAYLEIGH_MEDIAN * math.sqrt(2 * len(obs) / freedom)
        said_px = self._backend.noise.pixel_sigma
        self._sigma_px = float(np.clip(sigma_px, LEAST_SIGMA * said_px, said_px))

    def _without_outliers(
        self, good: BoolArray, points: FloatArray
    ) -> tuple[Observations, FloatArray, FloatArray]:
        """Observations that fit, their features, and variances over that of a single one.

        Args:
            good: (J,) candidates that have a position.
            points: of these.
        """
        obs, seen = self._candidates.subset(good), self._everything.subset(good)
        if not self._config.average_frames:
            seen = obs
        own = Geometry(*stacked_poses(self._values, obs.frames), points)
        limit_px = self._config.outlier_width * self._sigma_px
        if self._config.average_frames:
            matrices = np.array([s.world_T_body.matrix() for s in self._states()])
            theirs = Geometry(matrices[:, :3, :3], matrices[:, :3, 3], points)
            nearest = nearest_keyframe(self._piece.stamps_ns, self._piece.keyframes)
        else:
            theirs, nearest = own, np.arange(len(self._piece.keyframes))
        obs, variances = averaged(obs, own, seen, theirs, nearest, self._projection, limit_px)
        used = np.isfinite(variances)
        obs, variances = obs.rows(used), variances[used]
        enough = np.bincount(views(obs)[0], minlength=len(obs.ids)) >= MIN_KEYFRAMES
        return obs.subset(enough), points[enough], variances[enough[obs.feature]]

    # --- the cost --------------------------------------------------------------------------------

    def _prior(self) -> list[gtsam.NonlinearFactor]:
        """Position and yaw of the anchor, and the first bias, loosely."""
        pose, bias = self._values.atPose3(X(self._anchor)), self._values.atConstantBias(B(0))
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
        imu, noise = self._piece.imu, self._backend.noise
        stamps_ns = self._piece.keyframe_stamps_ns.tolist()
        for k, (i, j) in enumerate(pairwise(self._piece.keyframes.tolist())):
            start_ns, end_ns = stamps_ns[k], stamps_ns[k + 1]
            gap = imu.largest_gap_s(start_ns, end_ns) > noise.max_imu_gap_s
            scale = noise.imu_scale * (noise.imu_gap_scale if gap else 1.0)
            # of noise that is not stationary, variances add up
            gyro, accel = np.sqrt(np.mean(self._piece.noise[i + 1 : j + 1] ** 2, axis=0))
            params = preintegration_params(self._rig.imu, noise.gravity, scale, gyro, accel)
            bias = self._values.atConstantBias(B(k))
            pim = preintegrate(imu.between(start_ns, end_ns), bias, params)
            factors.append(imu_factor(k, k + 1, pim))
            if self._piece.still[i + 1 : j + 1].all():
                factors += zero_velocity_factors(k, k + 1, self._backend.zero_velocity)
        return factors

    def _projections(self, obs: Observations, variances: FloatArray) -> list[gtsam.NonlinearFactor]:
        """A factor for each observation, with its variance over that of a single one."""
        robust = {
            "robust_loss": self._config.robust_loss,
            "robust_width": self._config.robust_width,
        }
        gating = self._backend.gating.model_copy(update=robust)
        factors: list[gtsam.NonlinearFactor] = []
        for variance in np.unique(variances).tolist():  # one for each size of a group
            noise = pixel_noise(self._sigma_px * math.sqrt(variance), gating)
            factors += ProjectionFactors(self._rig, noise).of(obs.rows(variances == variance))
        return factors

    # --- Levenberg-Marquardt ---------------------------------------------------------------------

    def _minimize(
        self, obs: Observations, points: FloatArray, variances: FloatArray
    ) -> tuple[float, float, float]:
        """Move the values to the minimum.

        Returns:
            The cost before, the cost there, and the part of the IMU and the prior in it.
        """
        start = gtsam.Values()
        for k in range(len(self._piece.keyframes)):
            start.insert(X(k), self._values.atPose3(X(k)))
            start.insert(V(k), self._values.atVector(V(k)))
            start.insert(B(k), self._values.atConstantBias(B(k)))
        for j, point in zip(obs.ids.tolist(), points, strict=True):
            start.insert(L(j), point)
        inertial = _graph(self._prior() + self._dynamics())
        graph = gtsam.NonlinearFactorGraph(inertial)
        graph.push_back(_graph(self._projections(obs, variances)))
        params = gtsam.LevenbergMarquardtParams()
        params.setOrdering(gtsam.Ordering.ColamdNonlinearFactorGraph(graph))
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
        before = cost = optimizer.error()
        for _ in range(self._config.max_iterations):
            optimizer.iterate()
            self._iterations += 1
            fallen = cost - optimizer.error()
            cost = optimizer.error()
            self._report(self._iterations)
            if fallen <= self._config.tolerance * cost or optimizer.lambda_() > MAX_LAMBDA:
                break
        if not math.isfinite(cost):
            raise EstimationError("the cost of the bundle adjustment is not finite")
        self._values = optimizer.values()
        return before, cost, inertial.error(self._values)

    def _states(self) -> list[NavState]:
        """The estimate at all frames."""
        keyframes = []
        for k, stamp_ns in enumerate(self._piece.keyframe_stamps_ns.tolist()):
            bias = self._values.atConstantBias(B(k))
            keyframes.append(
                NavState(
                    stamp_ns,
                    self._values.atPose3(X(k)),
                    np.asarray(self._values.atVector(V(k))),
                    np.asarray(bias.gyroscope()),
                    np.asarray(bias.accelerometer()),
                )
            )
        params = preintegration_params(self._rig.imu, self._backend.noise.gravity)
        return fill_in(keyframes, self._piece.stamps_ns, self._piece.imu, params)


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """The factors as a graph."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph
