# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visual-inertial bundle adjustment: all states of some keyframes and all their features at once.

The cost (`recording_cost`) is that of the recursive estimators without a window. It is minimised by
Levenberg-Marquardt, roughly with all observations, then to the end without outliers, on features
triangulated and IMU samples preintegrated anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X
from numpy.typing import NDArray

from slam_graph.backend.config import BackendConfig
from slam_graph.backend.imu import preintegration_params
from slam_graph.backend.reprojection import Geometry, RigProjection
from slam_graph.backend.state import stacked_points, stacked_poses
from slam_graph.backend.tracks import Observations
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import NavState
from slam_graph.mapping.averaged_observations import averaged, nearest_keyframe
from slam_graph.mapping.final_ba_config import FinalBaConfig
from slam_graph.mapping.keyframe_states import fill_in
from slam_graph.mapping.keyframes import (
    Piece,
    longest_tracks,
    triangulated,
    views,
    with_native_cameras,
)
from slam_graph.mapping.recording_cost import RecordingCost
from slam_graph.sensors.rig import Rig

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

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
                    np.asarray(bias.gyroscope()),
                    np.asarray(bias.accelerometer()),
                )
            )
        params = preintegration_params(self._rig.imu, self._backend.noise.gravity)
        return fill_in(keyframes, self._piece.stamps_ns, self._piece.imu, params)
