# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Visual-inertial bundle adjustment of a segment: all keyframe states and features at once.

The cost (`recording_factors.py`) is that of the recursive estimators without a window. It is
minimised by Levenberg-Marquardt: first to a loose tolerance with all observations, unless the poses
are near that minimum already; then to the end without outliers, with features triangulated and IMU
samples preintegrated anew. The noise of both sensors is read from the residuals at this minimum:
how far the errors of tracks are correlated, and then how noisy the IMU is. The states are those of
the minimum under it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import MEDIAN_2D, RobustLoss
from slam_graph.backend.depth_camera import is_of_depth
from slam_graph.backend.smoothing.adjustment_figures import AdjustmentFigures
from slam_graph.backend.smoothing.calibration_equations import CalibrationColumns
from slam_graph.backend.smoothing.cost_minimization import minimized
from slam_graph.backend.smoothing.imu_noise_estimation import ImuNoiseFactors
from slam_graph.backend.smoothing.keyframe_states import (
    fill_in,
    fill_in_by_motion,
    states_in,
    values_of,
)
from slam_graph.backend.smoothing.learned_imu_noise import Minimum, equations_at_minimum
from slam_graph.backend.smoothing.pose_equations import PoseEquations
from slam_graph.backend.smoothing.recording_cost import (
    Estimates,
    RecordingCost,
    ReprojectionCost,
)
from slam_graph.backend.smoothing.recording_factors import (
    RecordingFactors,
    averaged,
    nearest_keyframe,
)
from slam_graph.backend.smoothing.recording_segment import (
    longest_tracks,
    row_motions,
    triangulated,
    views,
    with_gtsam_cameras,
)
from slam_graph.backend.smoothing.smoothing_task import (
    AdjustedSegment,
    SegmentStart,
    SmoothingTask,
)
from slam_graph.backend.smoothing.state_covariances import with_covariances
from slam_graph.backend.smoothing.state_elimination import EliminatedStates
from slam_graph.backend.smoothing.track_correlation import statistical_inefficiency
from slam_graph.backend.solve.stacked_values import stacked_poses
from slam_graph.geometry import NavState

logger = logging.getLogger(__name__)

OUTLIER_WIDTH = 3.7
"""Observations with a larger whitened residual near the minimum are outliers (the 99.9 %
circle)."""
_MIN_KEYFRAMES = 3
"""A feature must be seen in this many keyframes."""
_MIN_SIGMA_RATIO = 0.1
"""The learned noise of the tracks is at least this part of the configured one."""
_SAME_FIT = 1.5
"""Poses are near the minimum where the median residual of each keyframe is below this many times
that of all: then outliers are nearly the same, and the minimum is a step away."""
_LOOSE_TOLERANCE = 1e-3
"""Relative decrease of the cost at which the steps before the last minimum end."""

Report = Callable[[int, int], None]
"""Is given after each step: steps so far, minimisations that are complete."""


class BundleAdjustment:
    """The bundle adjustment of a segment of a recording.

    Args:
        start: segment, initial states and anchor.
        task: calibration and settings.
        report: is given the progress after each step.

    Attributes:
        iterations: steps so far.
    """

    def __init__(self, start: SegmentStart, task: SmoothingTask, report: Report) -> None:
        self._segment, self._joint = start.segment, start.joint
        segment = start.segment
        self._task, self._rig = replace(task, rig=with_gtsam_cameras(task.rig)), task.rig
        self._backend, self._config = backend, config = task.backend, task.config
        self._projection = RigProjection(self._task.rig, taken_by=task.rig)
        self._report = report
        loose = start.loose
        noise = ImuNoiseFactors(least=task.least_noise) if loose is None else loose.noise
        self._factors = RecordingFactors(
            segment, start.anchor, self._task.rig, backend, config, noise
        )
        seen = segment.seen_by_keyframes()
        chosen = longest_tracks(seen, config.features, _MIN_KEYFRAMES)
        self._candidates = seen.subset(chosen)
        self._everything = segment.seen.subset(chosen)
        self.iterations = self._passes = 0
        self._sigma_px, self._inefficiency = backend.noise.pixel_sigma, 1.0
        self._values, self._shared = values_of(start.states), segment.aiding.shared()
        self._given = start.states if loose is None else loose.given
        self._adjusted = loose is not None
        self._factor: EliminatedStates | None = None
        self._note_motions()

    @property
    def imu_noise(self) -> ImuNoiseFactors:
        """Estimated factors on the noise of the IMU, beyond those that the causal run learned."""
        return self._factors.noise

    def solve(self) -> AdjustedSegment:
        """Go near the minimum, remove outliers, and minimise.

        Raises:
            EstimationError: if there is no minimum.
        """
        keyframes = self._segment.keyframes
        points, good = self._triangulated(self._candidates)
        if not self._adjusted or not self._fits_alike(self._candidates.subset(good), points[good]):
            self._minimize_loosely()
            points, good = self._triangulated(self._candidates)
            points, good = self._with_estimates(self._candidates, points, good)
        else:
            self._passes += 1  # which is left out
        self._note_motions()
        if self._config.learn_pixel_sigma:
            self._learn_pixel_sigma(self._candidates.subset(good), points[good])
        obs, points, variances = self._without_outliers(good, points[good])
        cost, imu_cost = self._minimize(obs, points, variances, self._config.tolerance)
        if self._config.learn_pixel_sigma and self._learn_inefficiency():
            points = self._minimum.estimates.points
            cost, imu_cost = self._minimize(obs, points, variances, self._config.tolerance)
        images = replace(self._minimum.cost.images, inefficiency=1.0)
        squares = images.value(self._minimum.estimates)
        figures = AdjustmentFigures(
            keyframes=len(keyframes),
            features=len(obs.ids),
            observations=len(obs),
            iterations=self.iterations,
            cost_before=self._cost_before(obs),
            cost_after=cost,
            imu_residual=float(np.sqrt(2.0 * imu_cost / (15 * max(len(keyframes) - 1, 1)))),
            pixel_residual=float(np.sqrt(squares / max(len(obs), 1))),
            pixel_sigma=self._sigma_px,
            inefficiency=self._inefficiency,
        )
        aligned, gains, equations, assumed = None, None, None, self._factors.noise
        try:
            equations = self._equations()
            covariances, self._values = equations.covariances(), equations.minimum.values
            states = self._states(self._segment.stamps_ns)
            states, aligned = with_covariances(states, covariances, equations.frames)
            if self._joint is not None:
                gains = equations.errors_by(self._joint, states)
        except (RuntimeError, np.linalg.LinAlgError) as error:
            logger.info("no covariances: %s", " ".join(str(error).split())[:200])
            states, aligned, equations = self._states(self._segment.stamps_ns), None, None
            self._factors.noise = assumed
        figures = replace(figures, iterations=self.iterations)
        kept = equations if self._task.joint else None
        found = None if equations is None else equations.minimum
        fixes, calibration = (None, None) if found is None else (found.fixes, found.calibration)
        of_minimum = self.imu_noise, kept, fixes, calibration, gains
        return AdjustedSegment(states, figures, aligned, *of_minimum)

    def solve_loosely(self, stamps_ns: IntArray) -> list[NavState]:
        """States near the minimum, with outliers, to a loose tolerance.

        Under `learn_imu_noise` the noise of the IMU is learned there, too, and is in `imu_noise`.
        It stays as it was where the last step left no factor, or the estimate fails.

        Args:
            stamps_ns: of the states, ascending; those of the keyframes among them.

        Raises:
            EstimationError: if there is no minimum.
        """
        self._minimize_loosely()
        if self._config.learn_imu_noise and self._factor is not None:
            inertial = self._minimum.cost.inertial
            try:
                self._factors.learn_noise(inertial, self._values, self._factor.times_covariance)
            except (RuntimeError, np.linalg.LinAlgError) as error:
                logger.info("the noise of the IMU is not learned loosely: %s", error)
        return self._states(stamps_ns)

    def _triangulated(self, obs: Observations) -> tuple[FloatArray, BoolArray]:
        """Points (J, 3) triangulated from the current poses, and which of them (J,) are usable."""
        return triangulated(
            obs, stacked_poses(self._values, obs.frames), self._projection, self._backend
        )

    def _with_estimates(
        self, obs: Observations, points: FloatArray, good: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """The same with the current estimates of the features that have one."""
        known = np.isin(obs.ids, self._minimum.cost.images.obs.ids)  # both are ascending
        points[known] = self._minimum.estimates.points
        return points, good | known

    def _fits_alike(self, obs: Observations, points: FloatArray) -> bool:
        """Whether the observations of each keyframe fit its pose as well as those of the others.

        A keyframe none of whose features has a point may be far off.
        """
        at = Geometry(*stacked_poses(self._values, obs.frames), points)
        lengths = np.linalg.norm(self._projection.residuals(obs, at)[0], axis=1)
        frames, counts = np.unique(obs.frame, return_counts=True)
        if len(frames) == 0 or len(frames) < len(np.unique(self._candidates.frame)):
            return False
        middle = np.cumsum(counts) - counts + counts // 2
        medians = lengths[np.lexsort((lengths, obs.frame))][middle]
        return bool(np.all(medians < _SAME_FIT * np.median(lengths)))

    def _learn_pixel_sigma(self, obs: Observations, points: FloatArray) -> None:
        """Estimate the noise of the tracks from the median of their residuals near the minimum.

        The median is robust to outliers. A residual of standard deviation σ on both axes has the
        median length 1.1774 σ (Rayleigh); at the minimum the residuals have lost as many degrees of
        freedom as there are unknowns.
        """
        at = Geometry(*stacked_poses(self._values, obs.frames), points)
        lengths = np.linalg.norm(self._projection.residuals(obs, at)[0], axis=1)
        lengths = lengths[~is_of_depth(obs, self._task.rig)]  # whose noise is known
        unknowns = 3 * len(obs.ids) + 6 * len(self._segment.keyframes)
        freedom = 2 * len(obs) - unknowns
        if freedom <= unknowns:
            return
        sigma_px = float(np.median(lengths)) / MEDIAN_2D * math.sqrt(2 * len(obs) / freedom)
        configured_px = self._backend.noise.pixel_sigma
        self._sigma_px = float(np.clip(sigma_px, _MIN_SIGMA_RATIO * configured_px, configured_px))

    def _learn_inefficiency(self) -> bool:
        """Estimate how far errors of tracks are correlated; whether images count less for it.

        Depths are no part of it: their noise is known.
        """
        found = self._minimum
        linear = found.cost.images.linearized(found.estimates)
        tracked = ~is_of_depth(linear.obs, self._task.rig)
        self._inefficiency = statistical_inefficiency(linear.rows(tracked))
        return self._inefficiency > 1.0

    def _without_outliers(
        self, good: BoolArray, points: FloatArray
    ) -> tuple[Observations, FloatArray, FloatArray]:
        """The inliers, the points of their features, and their relative variances.

        Args:
            good: (J,) candidates that have a point.
            points: of these candidates.
        """
        obs, seen = self._candidates.subset(good), self._everything.subset(good)
        if not self._config.average_frames:
            seen = obs
        own = Geometry(*stacked_poses(self._values, obs.frames), points)
        limit_px = OUTLIER_WIDTH * self._sigma_px
        if self._config.average_frames:
            states = self._states(self._segment.stamps_ns)
            matrices = np.array([s.world_T_body.matrix() for s in states])
            all_frames = Geometry(matrices[:, :3, :3], matrices[:, :3, 3], points)
            nearest = nearest_keyframe(self._segment.stamps_ns, self._segment.keyframes)
            motions = row_motions(states, self._segment.imu, self._task.rig)
            everywhere = self._projection.moving(motions)
        else:
            all_frames, nearest = own, np.arange(len(self._segment.keyframes))
            everywhere = self._projection
        projections = self._projection, everywhere
        obs, variances = averaged(obs, own, seen, all_frames, nearest, projections, limit_px)
        used = np.isfinite(variances)
        obs, variances = obs.rows(used), variances[used]
        enough = np.bincount(views(obs)[0], minlength=len(obs.ids)) >= _MIN_KEYFRAMES
        return obs.subset(enough), points[enough], variances[enough[obs.feature]]

    def _minimize_loosely(self) -> None:
        """Minimise with all observations to a loose tolerance."""
        points, good = self._triangulated(self._candidates)
        obs = self._candidates.subset(good)
        self._minimize(obs, points[good], np.ones(len(obs)), _LOOSE_TOLERANCE)

    def _minimize(
        self, obs: Observations, points: FloatArray, variances: FloatArray, tolerance: float
    ) -> tuple[float, float]:
        """Move the values to the minimum.

        Returns:
            The minimum, and the part of IMU and priors in it.
        """
        inertial = self._factors.inertial(self._values)
        cost = RecordingCost(
            inertial,
            ReprojectionCost(
                obs,
                self._sigmas_px(obs) * np.sqrt(variances),
                self._projection,
                RobustLoss(self._config.robust_loss, self._config.robust_width),
                np.where(is_of_depth(obs, self._task.rig), 1.0, self._inefficiency),
            ),
            len(self._segment.keyframes),
            self._segment.aiding.calibrated,
        )
        start = Estimates(self._values, points, self._shared)
        steps = self._config.max_iterations
        self._factor = None  # it is large
        end, value, self._factor = minimized(cost, start, tolerance, steps, self._count_step)
        self._passes += 1
        self._values, self._shared = end.states, end.fixes
        self._minimum = Minimum(cost, end)
        return value, inertial.error(self._values)

    def _sigmas_px(self, obs: Observations) -> FloatArray:
        """Standard deviations (N,) of observations: learned, but for those of a depth sensor."""
        of_depth = is_of_depth(obs, self._task.rig)
        return np.where(of_depth, self._backend.noise.pixel_sigma, self._sigma_px)

    def _count_step(self) -> None:
        self.iterations += 1
        self._report(self.iterations, self._passes)

    def _cost_before(self, obs: Observations) -> float:
        """What the cost that was minimised last is at the states before the adjustment.

        Features are triangulated from these states; those that cannot be stay where they are.

        Args:
            obs: that are in the cost.
        """
        states = values_of(self._given)
        poses = stacked_poses(states, obs.frames)
        points, good = triangulated(obs, poses, self._projection, self._backend)
        points[~good] = self._minimum.estimates.points[~good]
        given = Estimates(states, points, self._segment.aiding.shared())
        return self._minimum.cost.value(given)

    def _equations(self) -> PoseEquations:
        """The equations at the minimum.

        Raises:
            RuntimeError: if GTSAM cannot linearise a factor.
            LinAlgError: if the minimum does not determine all variables.
        """
        if not self._config.learn_imu_noise:
            self._factor = None
        columns = None
        if self._task.calibration:
            columns = CalibrationColumns.of(self._rig, self._keyframe_states(), self._segment.imu)
        minimum = equations_at_minimum(
            self._minimum,
            self._take_factor,
            self._factors,
            self._config.learn_imu_noise,
            self._task.joint,
            self._count_step,
            columns,
        )
        densities, level = self._factors.densities(), self._task.rig.has_imu
        stamps_ns, keyframes = self._segment.stamps_ns, self._segment.keyframes
        features = self._minimum.cost.images.obs.ids
        return PoseEquations.of(minimum, stamps_ns, keyframes, densities, level, features)

    def _take_factor(self) -> EliminatedStates | None:
        """The factor of the last step, if there is one, which is kept no longer: it is large."""
        factor, self._factor = self._factor, None
        return factor

    def _note_motions(self) -> None:
        """Take the current velocities for the motion between the rows of rolling shutters."""
        if self._projection.rolling:
            motions = row_motions(self._keyframe_states(), self._segment.imu, self._task.rig)
            self._projection = self._projection.moving(motions)

    def _states(self, stamps_ns: IntArray) -> list[NavState]:
        """The states at some times, those of the keyframes among them."""
        imu, preintegration = self._segment.imu, self._task.preintegration
        causal = self._task.causal
        if causal is not None:
            return fill_in_by_motion(
                self._keyframe_states(), stamps_ns, causal, imu, preintegration
            )
        return fill_in(self._keyframe_states(), stamps_ns, imu, preintegration)

    def _keyframe_states(self) -> list[NavState]:
        """The states of the keyframes."""
        return states_in(self._values, self._segment.keyframe_stamps_ns.tolist())
