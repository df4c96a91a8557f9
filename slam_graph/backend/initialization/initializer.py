# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Start-up: the first states and the prior that the loop goes on from.

A start is tried at every frame until one succeeds: from standing still, or in motion. A start in
motion is a batch problem over a short window under the engine's own cost, steps and
marginalization; only its first guess is special.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.cost import Cost, NewFeatures
from slam_graph.backend.cost.feature_factors import ReducedFeatures
from slam_graph.backend.cost.feature_tracks import Observations, is_in, sorted_unique
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import Triangulation, triangulate
from slam_graph.backend.cost.zero_velocity import StandstillDetector
from slam_graph.backend.initialization.dynamic_start import (
    OUTLIER_SIGMAS,
    StartGuess,
    StartWindow,
    guess_states,
)
from slam_graph.backend.initialization.static_start import (
    fix_gauge,
    prior_covariance,
    state_at_rest,
)
from slam_graph.backend.marginalization.marginalize import LinearizationPoints, marginalize
from slam_graph.backend.online_calibration import CalibrationVariables
from slam_graph.backend.policies import AlgorithmConfig, GaussNewtonPolicy
from slam_graph.backend.solve.gauss_newton import minimize
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of, imu_state_keys
from slam_graph.backend.window import Window
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.imu_buffer import ImuBuffer, preintegrate
from slam_graph.sensors.measurements import FeatureFrame

BATCH = GaussNewtonPolicy(max_steps=15, tolerance=1e-4, damping="levenberg_marquardt")
"""How the window of a start in motion is solved."""
FINAL = GaussNewtonPolicy(max_steps=1)
BEST_KNOWN = 0.1
"""The share of the features that are taken for the best known ones."""
SETTLED = 0.1
"""The last step must not change the cost by more than this share: else it is no minimum."""


def start_from(
    given: NavState, config: BackendConfig, calibration: CalibrationVariables | None = None
) -> Window:
    """Start from a state with a covariance, and from what is known of an estimated calibration."""
    if config.initialization.fix_gauge:
        given = fix_gauge(given, config.initialization.prior)
    state = State()
    state.insert_imu_state(0, given)
    state.freeze(imu_state_keys(0))
    prior = prior_of(given)
    if calibration is None:
        return Window(0, given.stamp_ns, state, prior)
    prior = calibration.enter(state, prior)
    return Window(0, given.stamp_ns, state, prior, calibration=calibration.keys)


def prior_of(given: NavState, frame: int = 0) -> SquareRootInformation:
    """What the covariance of a state says of a frame, linearised at the state."""
    assert given.covariance is not None
    Rd = np.zeros((16, 16), order="F")
    Rd[:-1, :-1] = np.linalg.cholesky(np.linalg.inv(given.covariance)).T
    return SquareRootInformation(Layout(dims_of(imu_state_keys(frame))), Rd)


def _prior_factors(first: NavState) -> list[gtsam.NonlinearFactor]:
    """The prior on the state of frame 0 as factors, whose linearisation point may move."""
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


class Initializer:
    """Collects frames and tries to start from them.

    Attributes:
        waiting_for: why there is no start yet.
        unfit: ids (N,) of features that do not fit the motion of a start in motion, ascending.
    """

    def __init__(
        self,
        rig: RigProjection,
        params: gtsam.PreintegrationCombinedParams,
        algorithm: AlgorithmConfig,
        config: BackendConfig,
        calibration: CalibrationVariables,
    ) -> None:
        self.waiting_for = "the first frames"
        self.unfit = np.zeros(0, np.int64)
        self._rig = rig
        self._params = params
        self._algorithm = algorithm
        self._config = config
        self._calibration = calibration
        self._stamps_ns: list[int] = []
        self._frames: list[FeatureFrame] = []
        self._tried_ns = 0
        self._rng = np.random.default_rng(0)
        largest = config.initialization.static_disparity_px
        self._standstill = StandstillDetector(
            config.zero_velocity.model_copy(update={"max_disparity_px": largest, "enabled": True})
        )

    def try_to_start(self, imu: ImuBuffer, stamp_ns: int, frame: FeatureFrame) -> Window | None:
        """Take the next frame and start if it is possible.

        Args:
            imu: samples up to the frame.
            stamp_ns: time of the frame on the clock of the IMU.
            frame: its features.
        """
        mode = self._config.initialization.mode
        outcome: Window | str = "a state to start from (mode 'given')"
        self._standstill.is_still(imu, stamp_ns, frame)
        if mode in ("auto", "static"):
            outcome = self._at_rest(imu, stamp_ns)
        if mode in ("auto", "motion") and isinstance(outcome, str):
            outcome = self._in_motion(imu, stamp_ns, frame)
        if isinstance(outcome, str):
            self.waiting_for = outcome
            return None
        return outcome

    def _at_rest(self, imu: ImuBuffer, stamp_ns: int) -> Window | str:
        start, since_ns = self._config.initialization, self._standstill.since_ns
        needed_ns = round(start.static_window_s * 1e9)
        if since_ns is None or stamp_ns - since_ns < needed_ns:
            return f"a still period of {start.static_window_s:g} s"
        samples = imu.between(since_ns, stamp_ns)
        state = state_at_rest(samples, stamp_ns, start.prior)
        return start_from(state, self._config, self._calibration)

    def _in_motion(self, imu: ImuBuffer, stamp_ns: int, frame: FeatureFrame) -> Window | str:
        start = self._config.initialization
        length_ns = round(start.motion_window_s * 1e9)
        if imu.covers(stamp_ns) and len(frame.cameras[0]) >= start.min_features:
            self._stamps_ns.append(stamp_ns)
            self._frames.append(frame)
        while self._stamps_ns and self._stamps_ns[0] < stamp_ns - length_ns - round(1e8):
            del self._stamps_ns[0], self._frames[0]
        if not self._stamps_ns or stamp_ns - self._stamps_ns[0] < length_ns:
            return f"{start.motion_window_s:g} s of frames with IMU samples"
        if stamp_ns - self._tried_ns < round(start.retry_s * 1e9):
            return self.waiting_for
        self._tried_ns = stamp_ns
        window = StartWindow.thinned(self._stamps_ns, self._frames, start.frame_spacing_s)
        guess = guess_states(window, imu, self._rig, self._params, self._config.noise, self._rng)
        return guess if isinstance(guess, str) else self._refined(window, guess, imu)

    # --- the batch problem of a start in motion ---------------------------------------------------

    def _refined(self, window: StartWindow, guess: StartGuess, imu: ImuBuffer) -> Window | str:
        """Solve the window by the engine and marginalise all but its last state."""
        cost = self._batch_cost(window, guess, imu)
        try:
            minimize(cost, BATCH)
            if not self._without_outliers(cost, window):
                return "features that fit the motion"
            minimize(cost, BATCH)
            features = self._keep_features(cost, window)
            final = minimize(cost, FINAL)
            before, after = final.costs
            normalized_cost, scale_sigma = (
                _normalized_cost(cost),
                _scale_sigma(cost, final.posterior),
            )
        except np.linalg.LinAlgError:
            return "motion that shows gravity and scale"
        if not abs(after - before) < SETTLED * max(before, 1.0):
            return "steps that settle"
        last = len(window.frames) - 1
        keep = [L(j) for j in features.tolist()]
        keep += [*self._calibration.keys, *imu_state_keys(last)]
        points: LinearizationPoints = "current"
        if self._algorithm.marginalization.first_estimates:
            points = "first"
        prior = marginalize(final.posterior, cost.state, keep, points)
        start = Window(
            last,
            window.stamps_ns[-1],
            cost.state,
            prior,
            features=features,
            calibration=self._calibration.keys,
        )
        covariance = prior.covariance_of(imu_state_keys(last))
        return self._doubt(normalized_cost, scale_sigma, covariance) or start

    def _batch_cost(self, window: StartWindow, guess: StartGuess, imu: ImuBuffer) -> Cost:
        """All states of the window, a prior on the first, and the features they see."""
        state = State()
        factors: list[gtsam.NonlinearFactor] = []
        for k, nav in enumerate(guess.states):
            state.insert_imu_state(k, nav)
        start = guess.states[0]
        bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
        for k, samples in enumerate(window.imu_between(imu)):
            factors.append(imu_factor(k, k + 1, preintegrate(samples, bias, self._params)))
        wide = self._config.initialization.motion_prior
        first = fix_gauge(replace(start, covariance=prior_covariance(wide)), wide)
        factors += _prior_factors(first)
        known = self._calibration.enter(state, SquareRootInformation.empty())
        for k, (stamp_ns, frame) in enumerate(zip(window.stamps_ns, window.frames, strict=True)):
            self._calibration.note_motion(state, k, stamp_ns, frame.stamp_ns, imu)
        cost = Cost(state, self._rig, self._config, known, factors)
        obs = _lasting(window)
        result = self._points(cost, obs)
        self._enter(cost, obs, result, result.good & is_in(obs.ids, guess.static))
        return cost

    def _enter(
        self, cost: Cost, obs: Observations, result: Triangulation, good: NDArray[np.bool_]
    ) -> None:
        """Let the good ones (J,) into the cost; if they are too many, the longest tracks."""
        length = np.where(good, obs.counts, 0)
        order = np.argsort(-length, kind="stable")[: self._config.initialization.features]
        chosen = np.zeros(len(good), np.bool_)
        chosen[order] = good[order]
        nothing = np.zeros(len(good), np.bool_)
        cost.fresh = NewFeatures(obs, result.points, nothing).subset(chosen)

    def _points(self, cost: Cost, obs: Observations) -> Triangulation:
        rig = self._rig.at(cost.state)
        poses = rig.poses(cost.state.estimate, obs.frames)
        return triangulate(rig.renormalized(obs), rig, *poses, self._config.triangulation)

    def _without_outliers(self, cost: Cost, window: StartWindow) -> bool:
        """Triangulate all features anew and take what fits; whether that is most of them.

        Those that did not agree at first count too: a motion that few agree on is none.
        """
        obs = _lasting(window)
        result = self._points(cost, obs)
        fits = result.reprojection_px < OUTLIER_SIGMAS * self._config.noise.pixel_sigma
        good = result.good & fits
        self.unfit = obs.ids[~fits]
        self._enter(cost, obs, result, good)
        return bool(np.sum(good) >= max(self._config.initialization.min_features, 0.5 * len(good)))

    def _keep_features(self, cost: Cost, window: StartWindow) -> IntArray:
        """Make variables of the features that the last frame still sees."""
        assert cost.fresh is not None
        fresh, room = cost.fresh, self._algorithm.cost.max_state_features
        seen = sorted_unique(np.sort(np.concatenate([c.ids for c in window.frames[-1].cameras])))
        live = is_in(fresh.obs.ids, seen)
        order = np.argsort(-np.where(live, fresh.obs.counts, 0), kind="stable")[:room]
        chosen = np.zeros(len(live), np.bool_)
        chosen[order] = True
        chosen &= live
        for j in np.flatnonzero(chosen):
            cost.state.insert_point(int(fresh.obs.ids[j]), fresh.points[j])
        cost.fresh = replace(fresh, in_state=chosen)
        return fresh.obs.ids[chosen]

    def _doubt(
        self, normalized_cost: float, scale_sigma: float, covariance: FloatArray
    ) -> str | None:
        """Why the solution should not be trusted, if so."""
        start = self._config.initialization
        velocity_sigma = float(np.sqrt(np.max(np.diag(covariance)[6:9])))
        if normalized_cost > start.max_normalized_cost:
            return f"images and IMU to agree (normalised cost {normalized_cost:.1f})"
        if velocity_sigma > start.max_velocity_sigma:
            return f"more motion (velocity is known to {velocity_sigma:.2g} m/s only)"
        if scale_sigma > start.max_scale_sigma:
            return f"more motion (scale is known to {scale_sigma:.0%} only)"
        return None


def _lasting(window: StartWindow) -> Observations:
    """The features of a window that show more than the motion between two frames."""
    tracks = window.tracks()
    ids, lengths = tracks.lengths()
    return tracks.observations(ids[lengths >= 3])


def _normalized_cost(cost: Cost) -> float:
    """Mean squared residual of the features that do not depend on their positions."""
    fresh = cost.linearize().fresh
    if not isinstance(fresh, ReducedFeatures):
        return float("inf")
    return float(np.sum(fresh.r_2**2)) / max(int(np.sum(fresh.dof)), 1)


def _scale_sigma(cost: Cost, posterior: SquareRootInformation) -> float:
    """Standard deviation of the scale: that of the best-known distances, relative to them.

    A distance to a feature is scale times shape, so none is known better than the scale. An error
    in metres does not show it: where the scale is taken for too small, it is too small as well.
    """
    fresh, features = cost.linearize().fresh, cost.fresh
    if not isinstance(fresh, ReducedFeatures) or features is None or not len(features.points):
        return float("inf")
    keys = cost.rig.keys_of(features.obs)
    last = X(features.obs.frames[-1])
    pose = cost.state.estimate.atPose3(last)
    away = features.points - pose.translation()
    distances = np.linalg.norm(away, axis=1)
    toward = away / distances[:, None]
    # δf = R_f⁻¹ (r₁ - T δx), and the body moves by R δp
    by_r_1 = np.linalg.solve(fresh.R_f.transpose(0, 2, 1), toward[:, :, None])[:, :, 0]
    by_state = -np.einsum("ji,jin->jn", by_r_1, fresh.T)
    position = Layout(dims_of(keys)).columns[last].start + np.arange(3, 6)
    by_state[:, position] -= toward @ pose.rotation().matrix()
    variances = np.einsum("jn,nm,jm->j", by_state, posterior.covariance_of(keys), by_state)
    variances += np.sum(by_r_1**2, axis=1)
    return float(np.quantile(np.sqrt(variances) / distances, BEST_KNOWN))
