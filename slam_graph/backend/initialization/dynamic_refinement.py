# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Refinement of a start: a batch problem over its frames, under the engine's own cost.

All states of the window and all features they see are estimated together by Levenberg-Marquardt,
once more after outliers are removed; all but the last state is then marginalised. The result is
refused if it does not fit, or does not determine velocity and scale well enough.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, V, X

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.backend.backend_config import PriorConfig
from slam_graph.backend.cost.adaptive_imu_noise import MotionChange
from slam_graph.backend.cost.cost import Cost, Linearization, TrackFeatures
from slam_graph.backend.cost.feature_factors import SummedFeatures
from slam_graph.backend.cost.feature_tracks import Observations, is_in
from slam_graph.backend.cost.imu_factor import IMU_GAP_SCALE, imu_factor
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.triangulation import Triangulation
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.batch_cost import BatchCost
from slam_graph.backend.initialization.dynamic_start import (
    OUTLIER_SIGMAS,
    StartFrames,
    StartGuess,
)
from slam_graph.backend.initialization.first_state import fix_gauge, prior_covariance, prior_of
from slam_graph.backend.initialization.start_diagnosis import MIN_FEATURES, Refusal
from slam_graph.backend.marginalization.marginalize import (
    LinearizationPoints,
    marginalize,
    relative_to,
)
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.solve.damped_steps import Attempt
from slam_graph.backend.solve.gauss_newton import Hopeful, linearized, minimize
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import POINT_DIM, State, dims_of, imu_state_keys
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState

_BATCH = GaussNewtonPolicy(max_steps=15, tolerance=1e-4, damping="levenberg_marquardt")
"""How the batch problem is solved."""
_PATIENT = _BATCH.model_copy(update={"max_steps": 30})
"""The same from a guess that is far off: one that was 2 m off after 7 s took 17 steps."""
_WHITE_NOISE_FACTOR = 1.5
"""Least factor on the calibrated white noise of the IMU: a start is over before the noise of a real
one can be learned. Against a path that agrees with it, the IMU of TUM-VI's room1 is 1.2 to 1.9
times as noisy over half a second as calibrated, most where it is moved fast."""
MAX_FEATURES = 150
"""How many features the batch problem has at most, those with the longest tracks."""
MOTION_PRIOR = PriorConfig(attitude_rad=0.3, velocity=10.0, gyro_bias=0.05)
"""Uncertainty of the first state of the guess."""
_MIN_INLIERS = 0.5
"""Smallest share of the features that must fit the motion."""
MAX_NORMALIZED_COST = 3.0
"""Largest accepted mean squared residual, in σ²."""
MAX_VELOCITY_SIGMA = 0.1
"""Largest accepted standard deviation of the velocity, m/s; more at a speed at which the accepted
error of the scale is more."""
MAX_SCALE_SIGMA = 0.05
"""Largest accepted standard deviation of the scale, relative to it."""
ROUGH_SCALE_SIGMA = 0.5
"""The same for a start without a metre scale (`initialization.unknown_scale: go_on`)."""
_HOPELESS = 4.0
"""A guess whose scale is so many times less well known than accepted is not refined. Of 20 guesses
that led to a start, none was above 1 (V1_02, V2_01, room1, right and wrong calibrations)."""
_ASTRAY = 0.5
"""A guess is given up if a step without damping raises the cost by more than this part, above what
is accepted: damped ones do not get on from there. Of 610 attempts that were refused after 15 steps
527 had such a step, nearly always the first; before 407 starts with a right calibration no step
that promised to lower the cost by 0.1 % raised it at all."""
_JUDGED_AFTER = 5
"""After so many steps the mean squared residual must be as small as is accepted at the end. Before
those 407 starts it was 1.1 σ² at most by then, and the steps had converged after 8 at most."""
MAX_STEP_LEFT = 0.3
"""Longest accepted step that is left at the end, in σ: with more the steps have not converged."""
_UNSETTLED = Refusal("fit", "steps that converge", lasting=True)
_BEST_FEATURES = 0.1
"""Quantile of the features' relative distance errors that is taken for the error of the scale."""


class DynamicRefinement:
    """The batch problem of a start in motion, or of the first motion after a standstill.

    Attributes:
        outliers: ids (N,) of the features that did not fit the last solution, ascending.
        scale_sigma: of the last solution, relative; infinite if the last attempt had none.
    """

    def __init__(
        self,
        context: EngineContext,
        max_scale_sigma: float,
        white_noise_factor: float = _WHITE_NOISE_FACTOR,
        hopeless: float = _HOPELESS,
        patient: bool = False,
    ) -> None:
        """Prepare for attempts.

        Args:
            context: shared with the engine.
            max_scale_sigma: largest accepted standard deviation of the scale, relative to it.
            white_noise_factor: least factor on the calibrated white noise of the IMU.
            hopeless: how many times less well than accepted a guess may tell the scale.
            patient: whether no guess is given up for its first steps, as it may be far off.
        """
        self.outliers = np.zeros(0, np.int64)
        self.scale_sigma = float("inf")
        self._fitness = 0, float("inf")  # features that fit the last solution, and its cost
        self._context, self._white_noise_factor = context, white_noise_factor
        self._max_scale_sigma, self._hopeless_factor = max_scale_sigma, hopeless
        self._patient, self._steps = patient, _PATIENT if patient else _BATCH

    def refine(
        self, frames: StartFrames, guess: StartGuess, first: NavState | None = None
    ) -> Window | Refusal:
        """The window that begins with the last frame, or what is missing for it.

        Args:
            frames: what they observed.
            guess: their states, and which features are static.
            first: the first of these states with its covariance, if it is known: the window is in
                its world then, else in one that the last frame defines.
        """
        lasting, self.scale_sigma = _lasting(frames), float("inf")
        try:
            cost = self._batch_cost(frames, guess, lasting, first)
            linear = cost.linearize(summed=True)
            if hopeless := self._hopeless(cost, linear, len(guess.static)):
                return hopeless
            hopeful = None if self._patient else self._hope(cost)
            found = minimize(cost, self._steps, linear, hopeful=hopeful)
            if hopeful is not None and not found.converged:
                return _unsettled(found.costs[-1], cost)
            self._refine_motions(cost, frames)
            fit, seen = self._remove_outliers(cost, lasting)
            if fit < max(MIN_FEATURES, _MIN_INLIERS * seen):
                return Refusal("fit", f"features that fit the motion ({fit} of {seen} do)")
            minimize(cost, self._steps)
            self._refine_motions(cost, frames)
            features = self._keep_features(cost, frames)
            linear = cost.linearize(summed=True)
            posterior = linearized(cost, linear)
            self.scale_sigma = _scale_sigma(cost, linear, posterior)
        except np.linalg.LinAlgError:
            return Refusal("motion", "motion that determines gravity and scale")
        last, calibration = len(frames.frames) - 1, self._context.calibration.keys
        keep = [*(L(j) for j in features.tolist()), *calibration, *imu_state_keys(last)]
        policy = self._context.algorithm.marginalization
        points: LinearizationPoints = "first" if policy.first_estimates else "current"
        prior = marginalize(posterior, cost.state, keep, points)
        if first is None:
            prior = self._in_gauge(prior, cost.state, last, features)
        start = Window(
            last,
            frames.stamps_ns[-1],
            cost.state,
            prior,
            state_features=features,
            calibration=calibration,
        )
        self._fitness = fit, _normalized_cost(cost, linear)
        return self._doubt(self._fitness[1], start) or start

    def fits_better_than(self, other: DynamicRefinement) -> bool:
        """Whether the last solution fits more features than that of another, and no worse."""
        return self._fitness[0] >= other._fitness[0] and self._fitness[1] <= other._fitness[1]

    def _hopeless(self, cost: BatchCost, linear: Linearization, static: int) -> Refusal | None:
        """What is missing if the guess already shows that no start will come of it.

        The steps cost many times as much as this, and are many where the scale is not determined.

        Args:
            cost: at the guess.
            linear: the same, linearised.
            static: number of features that the guess took for static.
        """
        if linear.tracks is None:
            return Refusal("fit", f"features that fit the motion (0 of {static} do)")
        sigma = _scale_sigma(cost, linear, linearized(cost, linear))
        if sigma > self._hopeless_factor * self._max_scale_sigma:
            return Refusal("motion", f"more motion (scale is known to {sigma:.0%} only)")
        return None

    def _hope(self, cost: BatchCost) -> Hopeful | None:
        """Whether a start may come of the steps so far; None if all are taken in any case."""
        assert cost.tracks is not None, "asked for before"
        tried, bar = 0, 0.5 * MAX_NORMALIZED_COST * _dof(cost.tracks)

        def hopeful(attempt: Attempt) -> bool:
            nonlocal tried
            tried += 1
            if not attempt.damping and attempt.after > max((1.0 + _ASTRAY) * attempt.before, bar):
                return False
            return tried < _JUDGED_AFTER or min(attempt.before, attempt.after) <= bar

        return hopeful

    def _in_gauge(
        self, prior: SquareRootInformation, state: State, last: int, features: IntArray
    ) -> SquareRootInformation:
        """The prior of a start, with what nothing measures taken for known.

        The first state that is reported defines the world, not that where the window began.

        Args:
            prior: over offsets from the linearisation points.
            state: the variables.
            last: index of the frame that is reported first.
            features: ids (N,) of the features in the state.
        """
        sigmas = MOTION_PRIOR.position_m, MOTION_PRIOR.yaw_rad
        return relative_to(prior, state, X(last), sigmas)

    def _doubt(self, normalized_cost: float, start: Window) -> Refusal | None:
        """What is missing if a solution cannot be trusted; None if it can.

        Args:
            normalized_cost: mean squared residual, σ².
            start: the window that would begin.
        """
        last = start.prior.marginal(imu_state_keys(start.frame))
        if not np.linalg.norm(last.d) < MAX_STEP_LEFT:
            return _UNSETTLED
        if normalized_cost > MAX_NORMALIZED_COST:
            needs = f"images and IMU to agree (normalised cost {normalized_cost:.1f})"
            return Refusal("fit", needs)
        velocity_sigma = float(np.sqrt(np.max(np.diag(last.covariance())[6:9])))
        speed = float(np.linalg.norm(start.state.frames.atVector(V(start.frame))))
        if velocity_sigma > max(MAX_VELOCITY_SIGMA, self._max_scale_sigma * speed):
            needs = f"more motion (velocity is known to {velocity_sigma:.2g} m/s only)"
            return Refusal("motion", needs)
        if self.scale_sigma > self._max_scale_sigma:
            return Refusal("motion", f"more motion (scale is known to {self.scale_sigma:.0%} only)")
        return None

    def _batch_cost(
        self, frames: StartFrames, guess: StartGuess, obs: Observations, first: NavState | None
    ) -> BatchCost:
        """All states of the window, a prior on the first, and the static features they see."""
        context = self._context
        state = State()
        for k, nav in enumerate(guess.states):
            state.insert_imu_state(k, nav)
        if first is None:
            factors, known = self._factors(frames, guess), SquareRootInformation.empty()
        else:
            factors, known = self._dynamics(frames, guess), prior_of(first)
            state.freeze(imu_state_keys(0))
        known = context.calibration.enter(state, known)
        for k, (stamp_ns, frame) in enumerate(zip(frames.stamps_ns, frames.frames, strict=True)):
            context.calibration.note_motion(state, k, stamp_ns, frame.stamp_ns, context.imu)
        loss = RobustLoss(context.config.gating.loss)
        cost = BatchCost(state, context.projection, context.config, known, factors, loss=loss)
        result = cost.triangulated(obs)
        _set_features(cost, obs, result, result.good & is_in(obs.ids, guess.static))
        return cost

    def _factors(self, frames: StartFrames, guess: StartGuess) -> list[gtsam.NonlinearFactor]:
        """The dynamics from frame to frame, and a prior on the first state."""
        first = replace(guess.states[0], covariance=prior_covariance(MOTION_PRIOR))
        prior = prior_factors(fix_gauge(first, MOTION_PRIOR))
        return self._dynamics(frames, guess) + prior

    def _dynamics(self, frames: StartFrames, guess: StartGuess) -> list[gtsam.NonlinearFactor]:
        """The dynamics from frame to frame."""
        context, start = self._context, guess.states[0]
        factors: list[gtsam.NonlinearFactor] = []
        bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
        noise = context.propagation.noise
        blocks = frames.imu_between(context.imu)
        for k, (before, samples) in enumerate(zip([None, *blocks], blocks, strict=False)):
            change = MotionChange.between(before, samples)
            gap_s = context.imu.largest_gap_s(*samples.stamps_ns[[0, -1]].tolist())
            scale = IMU_GAP_SCALE if gap_s > context.config.noise.max_imu_gap_s else 1.0
            params = noise.params(scale, self._white_noise_factor, change)
            factors.append(imu_factor(k, k + 1, samples.preintegrated(bias, params)))
        return factors

    def _refine_motions(self, cost: Cost, frames: StartFrames) -> None:
        """Take the velocities of the solution for the motion between rows of rolling shutters."""
        for k, stamp_ns in enumerate(frames.stamps_ns):
            self._context.calibration.refine_motion(cost.state, k, stamp_ns, self._context.imu)

    def _remove_outliers(self, cost: BatchCost, obs: Observations) -> tuple[int, int]:
        """Triangulate all features again and keep those that fit; their number, and that of all.

        Features that the guess took for dynamic count too: a motion that only few features support
        is wrong.
        """
        result = cost.triangulated(obs)
        fits = result.reprojection_px < OUTLIER_SIGMAS * self._context.config.noise.pixel_sigma
        good = result.good & fits
        self.outliers = obs.ids[~fits]
        _set_features(cost, obs, result, good)
        return int(np.sum(good)), len(good)

    def _keep_features(self, cost: Cost, frames: StartFrames) -> IntArray:
        """Make variables of the features that the last frame still sees."""
        assert cost.tracks is not None
        tracks, room = cost.tracks, self._context.algorithm.cost.max_state_features
        seen = frames.frames[-1].ids
        live = is_in(tracks.obs.ids, seen)
        order = np.argsort(-np.where(live, tracks.obs.counts, 0), kind="stable")[:room]
        chosen = np.zeros(len(live), np.bool_)
        chosen[order] = True
        chosen &= live
        cost.state.insert_points(tracks.obs.ids[chosen], tracks.points[chosen])
        cost.tracks = replace(tracks, in_state=chosen)
        return tracks.obs.ids[chosen]


def _set_features(cost: Cost, obs: Observations, result: Triangulation, good: BoolArray) -> None:
    """Put the good features (J,) into the cost; if they are too many, those with long tracks."""
    length = np.where(good, obs.counts, 0)
    order = np.argsort(-length, kind="stable")[:MAX_FEATURES]
    chosen = np.zeros(len(good), np.bool_)
    chosen[order] = good[order]
    nothing = np.zeros(len(good), np.bool_)
    cost.tracks = TrackFeatures(obs, result.points, nothing).subset(chosen)


def prior_factors(first: NavState) -> list[gtsam.NonlinearFactor]:
    """The prior on frame 0 as factors, so that it is linearised at every step."""
    assert first.covariance is not None
    x, v, b = imu_state_keys(0)
    noise = [
        gtsam.noiseModel.Gaussian.Covariance(first.covariance[block, block])
        for block in (slice(0, 6), slice(6, 9), slice(9, 15))
    ]
    bias = gtsam.imuBias.ConstantBias(first.accel_bias, first.gyro_bias)
    return [
        gtsam.PriorFactorPose3(x, first.world_T_body, noise[0]),
        gtsam.PriorFactorVector(v, first.velocity, noise[1]),
        gtsam.PriorFactorConstantBias(b, bias, noise[2]),
    ]


def _lasting(frames: StartFrames) -> Observations:
    """Observations of the features that at least three frames see."""
    tracks = frames.tracks
    ids, lengths = tracks.lengths()
    return tracks.observations(ids[lengths >= 3])


def _normalized_cost(cost: Cost, linear: Linearization) -> float:
    """Mean squared residual of the features after their positions are eliminated, σ²."""
    tracks = linear.tracks
    if not isinstance(tracks, SummedFeatures) or cost.tracks is None:
        return float("inf")
    return float(np.sum(tracks.rows[:, -1] ** 2)) / _dof(cost.tracks)


def _unsettled(value: float, cost: BatchCost) -> Refusal:
    """What is missing where the steps ended at some cost without having converged."""
    assert cost.tracks is not None
    normalized = value / (0.5 * _dof(cost.tracks))
    if normalized <= MAX_NORMALIZED_COST:
        return _UNSETTLED
    needs = f"images and IMU to agree (normalised cost {normalized:.1f})"
    return Refusal("fit", needs, lasting=True)


def _dof(tracks: TrackFeatures) -> int:
    """How many residuals some features have beyond what their positions take, at least one."""
    return max(int(np.sum(2 * tracks.obs.counts - POINT_DIM)), 1)


def _scale_sigma(cost: Cost, linear: Linearization, posterior: SquareRootInformation) -> float:
    """Relative standard deviation of the scale: that of the best determined distances.

    A distance to a feature is scale times shape, so no distance has a smaller relative error than
    the scale. Absolute errors are no measure: if the scale is estimated too small, so are they.
    """
    tracks, features = linear.tracks, cost.tracks
    if not isinstance(tracks, SummedFeatures) or features is None or not len(features.points):
        return float("inf")
    keys = cost.rig.keys_of(features.obs)
    last = X(features.obs.frames[-1])
    pose = cost.state.frames.atPose3(last)
    away = features.points - pose.translation()
    distances = np.linalg.norm(away, axis=1)
    toward = away / distances[:, None]
    # δf = R_f⁻¹ (r₁ - T δx), and the body moves by R δp
    by_r_1 = np.linalg.solve(tracks.R_f.transpose(0, 2, 1), toward[:, :, None])[:, :, 0]
    by_state = -np.einsum("ji,jin->jn", by_r_1, tracks.T)
    position = Layout(dims_of(keys)).starts[last] + np.arange(3, 6)
    by_state[:, position] -= toward @ pose.rotation().matrix()
    variances = np.sum(by_state @ posterior.covariance_of(keys) * by_state, axis=1)
    variances += np.sum(by_r_1**2, axis=1)
    return float(np.quantile(np.sqrt(variances) / distances, _BEST_FEATURES))
