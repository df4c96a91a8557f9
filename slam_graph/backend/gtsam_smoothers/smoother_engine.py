# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's smoothers as an engine: the same start, input and output as the package's own loop.

Everything in the graph is a factor of GTSAM: preintegrated IMU measurements, projections, zero
velocities, and one prior. See docs/engine.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Outcome
from slam_graph.backend.engine_protocol import EngineContext, StepReport
from slam_graph.backend.gtsam_smoothers.smoother_features import (
    NewObservations,
    SmootherFeatures,
    features_given_pose,
    joint_prior,
)
from slam_graph.backend.gtsam_smoothers.smoother_solvers import SOLVERS, SmootherSolver
from slam_graph.backend.initialization.first_state import prior_of
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.stacked_values import stacked_points
from slam_graph.backend.solve.state import FrameMotion, State, imu_state_keys, nav_state_in
from slam_graph.backend.window import Window
from slam_graph.backend.window_graph import WindowGraph
from slam_graph.errors import ConfigError
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame


class SmootherEngine:
    """Steps that are updates of one of GTSAM's smoothers; see `Engine` for the methods.

    The window holds no more than the newest state in the graph, with its marginal covariance; the
    smoother holds the rest.
    """

    def __init__(self, context: EngineContext) -> None:
        """Prepare the smoother that `algorithm.engine` names.

        Raises:
            ConfigError: if parameters of the calibration are to be estimated.
        """
        if not all(mounted.rotation_known for mounted in context.rig.cameras):
            raise ConfigError(
                f"the mounting of a camera is not known, and '{context.algorithm.name}' cannot "
                "estimate it; use msckf, swf, okvis, ekf or iekf"
            )
        if context.config.calibration.anything:
            raise ConfigError(
                f"backend.calibration is not for '{context.algorithm.name}': GTSAM's smoothers "
                "take the calibration as it is; use msckf, swf, okvis, ekf or iekf"
            )
        if context.config.gnss.lever_arm_sigma_m > 0.0:
            raise ConfigError(
                f"backend.gnss.lever_arm_sigma_m is not for '{context.algorithm.name}': GTSAM's "
                "smoothers take the lever arm as it is; use msckf, swf, okvis, ekf or iekf"
            )
        self._context = context
        self._policy = context.algorithm.smoother
        self._features = SmootherFeatures(
            context.rig, self._policy, context.config, context.diagnostics
        )
        self._solver: SmootherSolver | None = None
        self._estimate = gtsam.Values()
        self._frames: dict[int, int] = {}  # indices and stamps of the states in the lag
        self._motions: dict[int, FrameMotion] = {}  # of the same states, for rolling shutters
        self._origin_ns = 0

    def information(self, window: Window) -> SquareRootInformation:
        """What is known of the newest state in the graph."""
        return window.prior

    def regauged(self, window: Window, level: bool, measured: bool) -> tuple[Window, None]:
        """The window as it is: what is in the lag is linearised anew, and so follows by itself."""
        return window, None

    def landmarks(self, window: Window) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and world positions (N, 3) of the features that are variables and tracked."""
        return self._features.active, stacked_points(self._estimate, self._features.active)

    def factor_graph(self, window: Window) -> WindowGraph:
        """All factors and estimates that the smoother holds."""
        solver = self._solver or self._begin(window)
        held = solver.factors()
        graph = gtsam.NonlinearFactorGraph()
        for number in range(held.size()):
            if held.at(number) is not None:
                graph.push_back(held.at(number))
        values = gtsam.Values(solver.everything()[0])
        return WindowGraph(graph, values, values, (None,) * graph.size())

    def step(
        self,
        window: Window,
        stamp_ns: int,
        frame: FeatureFrame,
        still_sigma: float | None,
        report: StepReport,
    ) -> NavState:
        """Predict the state, and add it to the graph if it is time for one."""
        propagation = self._context.propagation
        if self._solver is None and not self._context.rig.has_scale:
            self._begin_with_features(window)
        with report.timed("propagation"):
            ahead = Window(window.frame, window.stamp_ns, window.state.copy(), window.prior)
            corrected = self._context.by_images(frame, lambda: self.landmarks(window))
            propagation.append_frame(ahead, self._context.imu, stamp_ns, still_sigma, corrected)
            predicted = self._predicted(ahead)
        if stamp_ns - window.stamp_ns < self._policy.spacing_s * 1e9:
            return propagation.reported(predicted)
        with report.timed("cost"):
            if still_sigma is not None:
                new = self._pause(window.tracks, ahead, frame)
            else:
                new = self._observations(window.tracks, ahead, predicted, frame)
                report.innovations = self._features.innovations
                report.rejected = self._features.rejected
        with report.timed("smoother"):
            self._solve(window, ahead, new)
        with report.timed("covariance"):
            state = self._advance(window, ahead, predicted)
        report.correction = propagation.learn(state, frame.features)
        return propagation.reported(state)

    def _predicted(self, ahead: Window) -> NavState:
        """The new state and its covariance before any image is used."""
        context = self._context
        cost = Cost(ahead.state, context.projection, context.config, ahead.prior, ahead.factors)
        return ahead.current(cost.prior_at_estimate().updated(cost.factor_rows(cost.layout())))

    def _pause(self, tracks: FeatureTracks, ahead: Window, frame: FeatureFrame) -> NewObservations:
        """At a standstill images only add errors: no factors, and tracks begin again."""
        tracks.keep_frames([])
        tracks.add(ahead.frame, frame)
        self._note_motion(ahead, frame)
        tracks.remove(Outcome.STANDSTILL, self._features.active)
        return NewObservations()

    def _observations(
        self, tracks: FeatureTracks, ahead: Window, predicted: NavState, frame: FeatureFrame
    ) -> NewObservations:
        """What the images add to the graph at the new state."""
        tracks.keep_frames(list(self._frames))
        tracks.add(ahead.frame, frame)
        self._note_motion(ahead, frame)
        estimate = gtsam.Values(self._estimate)
        estimate.insert(X(ahead.frame), predicted.world_T_body)
        assert predicted.covariance is not None
        return self._features.observe(tracks, ahead.frame, estimate, predicted.covariance[:6, :6])

    def _note_motion(self, ahead: Window, frame: FeatureFrame) -> None:
        """Note how the body moves while the rows of a rolling shutter are exposed."""
        context, state = self._context, ahead.state
        context.calibration.note_motion(
            state, ahead.frame, ahead.stamp_ns, frame.stamp_ns, context.imu
        )
        if ahead.frame in state.motions:
            kept = {i: motion for i, motion in self._motions.items() if i in self._frames}
            self._motions = kept | {ahead.frame: state.motions[ahead.frame]}
            self._features.move(self._motions)

    # --- the smoother ----------------------------------------------------------------------------

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self._origin_ns) * 1e-9

    def _solve(self, window: Window, ahead: Window, new: NewObservations) -> None:
        """Update the smoother; by QR, or without new features, or from the last state if it fails.

        GTSAM's multifrontal Cholesky refuses some problems that are determined, such as those of an
        IMU and fixes that tell the position to a metre (condition number 5e10).
        """
        if self._solver is None:
            self._solver = self._begin(window)
        stamps = dict.fromkeys(imu_state_keys(ahead.frame), self._seconds(ahead.stamp_ns))
        values = _values_of(ahead.state, ahead.frame)
        both = gtsam.Values(values)
        both.insert(new.points)
        all_stamps = stamps | dict.fromkeys(new.seen, self._seconds(ahead.stamp_ns))
        factors = [*ahead.factors, *new.factors]
        before = self._solver.factors(), *self._solver.everything()
        try:
            self._solver.update(factors, both, all_stamps)
            return
        except RuntimeError as error:
            reason = _one_line(error)
        if self._policy.factorization == "cholesky":
            by_cholesky = self._policy
            self._policy = by_cholesky.model_copy(update={"factorization": "qr"})
            try:
                self._rebuild(before, factors, both, all_stamps)
                warning = f"QR instead of Cholesky ({reason})"
                self._context.diagnostics.warn("smoother_by_qr", warning)
                return
            except RuntimeError as error:
                self._policy, reason = by_cholesky, _one_line(error)
        message = f"the features of one frame are not used ({reason})"
        self._context.diagnostics.warn("features_degenerate", message)
        try:
            self._rebuild(before, ahead.factors, values, stamps)
        except RuntimeError as error:
            message = f"the graph is restarted from the last state ({_one_line(error)})"
            self._context.diagnostics.warn("smoother_restarted", message)
            self._solver = self._begin(window)
            self._solver.update(ahead.factors, values, stamps)

    def _rebuild(
        self,
        before: tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, float]],
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        stamps: dict[int, float],
    ) -> None:
        """Give all factors to a new smoother: one that has failed cannot be used any more."""
        graph, known, known_stamps = before
        known = gtsam.Values(known)
        known.insert(values)
        held = [graph.at(k) for k in range(graph.size())]
        alive = [f for f in held if f is not None and all(map(known.exists, f.keys()))]
        self._solver = SOLVERS[self._context.algorithm.engine](self._policy)
        self._solver.update([*alive, *factors], known, {**known_stamps, **stamps})

    def _begin(self, window: Window) -> SmootherSolver:
        """A smoother that holds the state of a window only."""
        keys = imu_state_keys(window.frame)
        if not self._frames:
            self._origin_ns = window.stamp_ns
        self._frames = {window.frame: window.stamp_ns}
        prior = joint_prior(window.prior.marginal(keys), window.state.first)
        solver = SOLVERS[self._context.algorithm.engine](self._policy)
        values = _values_of(window.state, window.frame)
        solver.update([prior], values, dict.fromkeys(keys, self._seconds(window.stamp_ns)))
        return solver

    def _begin_with_features(self, window: Window) -> None:
        """Begin with the features of the start, too: nothing else tells the scale."""
        ids = window.state_features[: self._policy.max_features]
        self._solver = self._begin(window)
        factors = features_given_pose(window.prior, window.state.first, ids, X(window.frame))
        for j, point in zip(ids.tolist(), window.state.positions_of(ids), strict=True):
            self._estimate.insert(L(j), point)
        stamps = {L(j): self._seconds(window.stamp_ns) for j in ids.tolist()}
        self._solver.update(factors, self._estimate, stamps)
        self._features.active = ids

    # --- the result ------------------------------------------------------------------------------

    def _advance(self, window: Window, ahead: Window, predicted: NavState) -> NavState:
        """Make the state that was added the newest one of the window."""
        assert self._solver is not None
        window.frame, window.stamp_ns = ahead.frame, ahead.stamp_ns
        self._read(ahead)
        try:
            covariance = self._solver.covariance(imu_state_keys(ahead.frame))
            state = nav_state_in(self._estimate, ahead.frame, ahead.stamp_ns, covariance)
            window.prior = prior_of(state, ahead.frame)
        except (RuntimeError, np.linalg.LinAlgError):
            self._context.diagnostics.warn(
                "covariance_predicted", "the graph does not give a covariance"
            )
            state = nav_state_in(self._estimate, ahead.frame, ahead.stamp_ns, predicted.covariance)
            window.prior = prior_of(state, ahead.frame)
        window.state = State()
        window.state.insert_imu_state(ahead.frame, state)
        window.state.freeze(imu_state_keys(ahead.frame))
        return state

    def _read(self, ahead: Window) -> None:
        """Read the estimates that the next steps need, and forget what was marginalised."""
        assert self._solver is not None
        oldest_ns = ahead.stamp_ns - round(self._policy.lag_s * 1e9)
        self._frames[ahead.frame] = ahead.stamp_ns
        self._frames = {i: stamp for i, stamp in self._frames.items() if stamp > oldest_ns}
        keys = [X(i) for i in self._frames] + [L(j) for j in self._features.active.tolist()]
        self._estimate = self._solver.estimate(dict.fromkeys([*keys, *imu_state_keys(ahead.frame)]))
        self._frames = {i: t for i, t in self._frames.items() if self._estimate.exists(X(i))}
        self._features.retain(self._estimate)


def _one_line(error: RuntimeError) -> str:
    """The beginning of what GTSAM says."""
    return " ".join(str(error).split())[:120]


def _values_of(state: State, frame: int) -> gtsam.Values:
    """The pose, velocity and bias of one frame alone."""
    x, v, b = imu_state_keys(frame)
    values = gtsam.Values()
    values.insert(x, state.frames.atPose3(x))
    values.insert(v, state.frames.atVector(v))
    values.insert(b, state.frames.atConstantBias(b))
    return values
