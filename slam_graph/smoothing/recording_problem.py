# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visual-inertial bundle adjustment: all states of some keyframes and all their features at once.

The cost (`recording_cost`) is that of the recursive estimators without a window. It is minimised by
Levenberg-Marquardt, roughly with all observations, then to the end without outliers, on features
triangulated and IMU samples preintegrated anew.

What the frames between keyframes say of a feature, put into the observations of the keyframes.

From a keyframe to the frames next to it the IMU knows the motion to a fraction of a pixel. So their
reprojection errors are those of the keyframe, with other noise: their mean replaces the error of
the keyframe's own observation. The cost has no more terms and no more poses for that.

How much better a mean is depends on the tracks. Errors of real ones last from frame to frame: with
the correlation ρ of two errors of a group, the mean of n has the variance σ² (ρ + (1 - ρ) / n). ρ
is measured, as the intraclass correlation of all groups (Fisher 1925).

The terms of the cost over a whole recording, as factors of GTSAM (docs/bundle_adjustment.md).

Keyframe k has the pose X(k), the velocity V(k) and the bias B(k), feature j the position L(j).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.adaptive_noise import IMU_GAP_SCALE
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.zero_velocity import zero_velocity_factors
from slam_graph.backend.gtsam_smoothers.smoother_factors import ProjectionFactors, pixel_noise
from slam_graph.backend.solve.state import stacked_points, stacked_poses
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.imu_buffer import preintegrate, preintegration_params
from slam_graph.sensors.rig import Rig
from slam_graph.smoothing.keyframe_states import fill_in
from slam_graph.smoothing.recording_keyframes import (
    Piece,
    longest_tracks,
    triangulated,
    views,
    with_native_cameras,
)
from slam_graph.smoothing.smoothing_config import FinalBaConfig


def nearest_keyframe(stamps_ns: IntArray, keyframes: IntArray) -> IntArray:
    """Number (N,) of the keyframe next to each frame in time."""
    times = stamps_ns[keyframes]
    return np.searchsorted(times[:-1] + np.diff(times) // 2, stamps_ns)


def averaged(
    obs: Observations,
    own: Geometry,
    seen: Observations,
    all_frames: Geometry,
    nearest: IntArray,
    projection: RigProjection,
    limit_px: float,
) -> tuple[Observations, FloatArray]:
    """Observations of keyframes that stand for those of the frames around them.

    Args:
        obs: of the keyframes (frame k is keyframe k).
        own: poses of the keyframes, and the features of `obs`.
        seen: of all frames, of the same features.
        all_frames: poses of all frames, and the features of `obs`.
        nearest: number (N,) of the keyframe next to each frame.
        projection: of the rig.
        limit_px: observations with a larger error do not count.

    Returns:
        The observations, and the variance (M,) of each over that of a single one; infinite where
        nothing fits.
    """
    residuals, depths = projection.residuals(seen, all_frames)
    fits = (np.linalg.norm(residuals, axis=1) < limit_px) & (depths > 0.0)
    cameras = len(projection.cameras)
    key = _key(seen.feature, nearest[seen.frame], seen.camera, len(obs.frames), cameras)
    own_key = _key(obs.feature, obs.frame, obs.camera, len(obs.frames), cameras)
    row = np.minimum(np.searchsorted(own_key, key), len(own_key) - 1)
    counted = fits & (own_key[row] == key)
    row, residuals = row[counted], residuals[counted]
    counts = np.bincount(row, minlength=len(obs))
    sums = np.stack([np.bincount(row, residuals[:, i], len(obs)) for i in range(2)], axis=1)
    means = sums / np.maximum(counts, 1)[:, None]
    rho = _correlation(residuals, means[row], counts[row])
    predicted = obs.pixels - projection.residuals(obs, own)[0]
    variances = np.full(len(obs), np.inf)
    np.divide(1.0 - rho, counts, out=variances, where=counts > 0)
    return replace(obs, pixels=predicted + means), rho + variances


def _correlation(values: FloatArray, means: FloatArray, counts: IntArray) -> float:
    """Intraclass correlation, from 0 to 1, of values (N, 2) in groups.

    Args:
        values: of all groups.
        means: (N, 2) of the group of each value.
        counts: (N,) size of the group of each value.
    """
    shared = counts > 1
    values, means, counts = values[shared], means[shared], counts[shared]
    if len(values) == 0:
        return 0.0
    # groups of n have n - 1 degrees of freedom of their own
    within = float(np.mean(np.sum((values - means) ** 2, axis=1) * counts / (counts - 1)))
    total = float(np.mean(np.sum(values**2, axis=1)))
    return float(np.clip(1.0 - within / max(total, 1e-300), 0.0, 1.0))


def _key(
    feature: IntArray, keyframe: IntArray, camera: IntArray, keyframes: int, cameras: int
) -> IntArray:
    """A number for each observation, ascending where observations are sorted."""
    return (feature * keyframes + keyframe) * cameras + camera


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
        loss = RobustLoss(self._config.robust_loss, self._config.robust_width)
        factors: list[gtsam.NonlinearFactor] = []
        for variance in np.unique(variances).tolist():  # one for each size of a group
            noise = pixel_noise(sigma_px * math.sqrt(variance), loss)
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
            scale = noise.imu_scale * (IMU_GAP_SCALE if gap else 1.0)
            # of noise that is not stationary, variances add up
            gyro, accel = np.sqrt(np.mean(self._piece.noise[i + 1 : j + 1] ** 2, axis=0))
            params = preintegration_params(self._rig.imu, noise.gravity, scale, gyro, accel)
            pim = preintegrate(imu.between(start_ns, end_ns), values.atConstantBias(B(k)), params)
            factors.append(imu_factor(k, k + 1, pim))
            if self._piece.still[i + 1 : j + 1].all():
                factors += zero_velocity_factors(k, k + 1)
        return factors


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """The factors as a graph."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


MIN_KEYFRAMES = 3
"""A feature must be seen in so many of them."""
RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))
LEAST_SIGMA = 0.1
"""Learned noise of the tracks is not less than this part of what the settings say, nor more."""
MAX_LAMBDA = 1e5
"""Damping beyond which there is no step that lowers the cost."""
ROUGHLY = 1e-3
"""Steps before the last minimum end when the cost falls by less than this part of it."""

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
        cost_before: of all observations, where the adjustment of all keyframes began.
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

    Attributes:
        iterations: Levenberg-Marquardt steps until now.
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
        self._rig = with_native_cameras(rig)
        self._projection = RigProjection(self._rig)
        self._backend = backend
        self._config = config
        self._report = report
        self._cost = RecordingCost(piece, anchor, self._rig, backend, config)
        seen = piece.seen_by_keyframes()
        chosen = longest_tracks(seen, config.features, MIN_KEYFRAMES)
        self._candidates = seen.subset(chosen)
        self._everything = piece.seen.subset(chosen)
        self.iterations = 0
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
        before = self._minimize_roughly()
        points, good = self._triangulated(self._candidates)
        points, good = self._known(self._candidates, points, good)
        if self._config.learn_pixel_sigma:
            self._learn_pixel_sigma(self._candidates.subset(good), points[good])
        obs, points, variances = self._without_outliers(good, points[good])
        _, cost, imu_cost = self._minimize(obs, points, variances, self._config.tolerance)
        dynamics = 15 * max(len(self._piece.keyframes) - 1, 1)
        return Adjustment(
            self._states(),
            len(self._piece.keyframes),
            len(obs.ids),
            len(obs),
            self.iterations,
            before,
            cost,
            float(np.sqrt(2.0 * imu_cost / dynamics)),
            float(np.sqrt((cost - imu_cost) / max(len(obs), 1))),
            self._sigma_px,
        )

    def solve_roughly(self) -> list[NavState]:
        """The states of all frames near the minimum, outliers and all.

        Raises:
            EstimationError: if there is no minimum.
        """
        self._minimize_roughly()
        return self._states()

    # --- features --------------------------------------------------------------------------------

    def _triangulated(self, obs: Observations) -> tuple[FloatArray, BoolArray]:
        """Points (J, 3) from the poses as they are, and which of them (J,) are usable."""
        return triangulated(
            obs, stacked_poses(self._values, obs.frames), self._projection, self._backend
        )

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

    # --- Levenberg-Marquardt ---------------------------------------------------------------------

    def _minimize_roughly(self) -> float:
        """With all observations of the candidates; returns the cost before."""
        points, good = self._triangulated(self._candidates)
        obs = self._candidates.subset(good)
        return self._minimize(obs, points[good], np.ones(len(obs)), ROUGHLY)[0]

    def _minimize(
        self, obs: Observations, points: FloatArray, variances: FloatArray, tolerance: float
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
        inertial = self._cost.inertial(self._values)
        graph = gtsam.NonlinearFactorGraph(inertial)
        graph.push_back(self._cost.projections(obs, variances, self._sigma_px))
        params = gtsam.LevenbergMarquardtParams()
        params.setOrdering(gtsam.Ordering.ColamdNonlinearFactorGraph(graph))
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
        before = cost = optimizer.error()
        for _ in range(self._config.max_iterations):
            optimizer.iterate()
            self.iterations += 1
            fallen = cost - optimizer.error()
            cost = optimizer.error()
            self._report(self.iterations)
            if fallen <= tolerance * cost or optimizer.lambda_() > MAX_LAMBDA:
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
                    accel_bias=np.asarray(bias.accelerometer()),
                    gyro_bias=np.asarray(bias.gyroscope()),
                )
            )
        params = preintegration_params(self._rig.imu, self._backend.noise.gravity)
        return fill_in(keyframes, self._piece.stamps_ns, self._piece.imu, params)
