# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The engine: one loop of cost construction, Gauss-Newton steps and marginalization.

Every recursive algorithm is this loop under its own policies (`policies.py`). See docs/engine.md.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.aiding.regauging import LEAST_GAIN, left_of_gauge, moved_by_gauge
from slam_graph.backend.aiding.world_linearization import moved_with_world
from slam_graph.backend.cost.construction import ConstructedCost, CostConstruction
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.cost.track_drift import add_drift_noise
from slam_graph.backend.engine_protocol import EngineContext, StepReport
from slam_graph.backend.marginalization.marginalize import marginalize_step
from slam_graph.backend.solve.gauss_newton import Minimum, minimize
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State
from slam_graph.backend.window import Window
from slam_graph.backend.window_graph import WindowGraph, window_graph
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame


class SquareRootEngine:
    """The three modules under the policies of one algorithm; see `Engine` for the methods."""

    def __init__(self, context: EngineContext) -> None:
        self._context = context
        self._policies = context.algorithm
        self._construction = CostConstruction(
            context.algorithm.cost,
            context.projection,
            context.config,
            context.diagnostics,
            context.pixels,
            by_consensus=context.config.dynamics.start_at_images and not context.rig.has_imu,
        )
        self._posterior: SquareRootInformation | None = None
        self._cost: Cost | None = None
        self._before: State | None = None  # the last step, where it keeps first estimates
        self._is_linear = True  # that step, as it was one along straight tangents

    def step(
        self,
        window: Window,
        stamp_ns: int,
        frame: FeatureFrame,
        still_sigma: float | None,
        report: StepReport,
    ) -> NavState:
        """One turn of the loop: the three modules, in order."""
        context = self._context
        # large, and not to be kept beside those of this step
        self._posterior = self._cost = self._before = None
        with report.timed("propagation"):
            corrected = context.by_images(frame, window.points)
            context.propagation.append_frame(window, context.imu, stamp_ns, still_sigma, corrected)
            context.add_observations(window, frame)
        with report.timed("cost"):
            if still_sigma is None:
                add_drift_noise(window, context.projection, context.pixels.drift.sigma_px)
                window.recall_features()
            constructed = self._construction.construct(window, still_sigma is not None)
        with report.timed("gauss_newton"):
            constructed, minimum = self._minimize(window, constructed)
            self._construction.reject_residuals(window, constructed)
            self._describe(window, constructed, minimum, report)
        if self._policies.marginalization.first_estimates and not minimum.repeated:
            self._before = window.state
        undamped = self._policies.gauss_newton.damping == "none"
        self._is_linear = undamped and len(minimum.costs) == 2
        with report.timed("marginalization"):
            marginalize_step(window, constructed, minimum, self._policies)
        self._posterior, self._cost = minimum.posterior, constructed.cost
        state = window.current(minimum.posterior)
        report.correction = context.propagation.learn(state, frame.features)
        context.pixels.learn(constructed.cost, constructed.offered, stamp_ns)
        return context.propagation.reported(state)

    def _minimize(
        self, window: Window, constructed: ConstructedCost
    ) -> tuple[ConstructedCost, Minimum]:
        """Take the steps; without the features if these leave something undetermined."""
        policy, calibration = self._policies.gauss_newton, self._context.calibration
        again = calibration.moved_far if calibration.keys else None
        try:
            return constructed, minimize(
                constructed.cost, policy, constructed.linear, again, constructed.predicted
            )
        except np.linalg.LinAlgError:
            warning = "the features of one frame are not used, and go on waiting"
            self._context.diagnostics.warn("features_degenerate", warning)
            constructed = self._construction.without_features(window)
            return constructed, minimize(constructed.cost, policy)

    def _describe(
        self, window: Window, constructed: ConstructedCost, minimum: Minimum, report: StepReport
    ) -> None:
        report.costs = minimum.costs
        report.columns = minimum.posterior.layout.size + window.lost_features.size
        report.innovations = constructed.innovations_under(minimum.posterior)
        report.rejected = self._construction.rejected

    def information(self, window: Window) -> SquareRootInformation:
        """The posterior of the last step, or what the start left behind."""
        return self._posterior or window.prior

    def regauged(
        self, window: Window, level: bool, measured: bool
    ) -> tuple[Window, gtsam.Pose3 | None]:
        """The window in the world where the cost of the last step is least, linearised there."""
        before, self._before = self._before, None  # once for each step
        found = self._moved(window, level)
        window, motion = (window, None) if found is None else found
        if motion is not None and before is not None:
            before = before.moved(motion)
        if measured and before is not None:
            camera = self._context.rig.scaled_camera
            window = moved_with_world(window, before, level, camera, self._is_linear)
        return window, motion

    def _moved(self, window: Window, level: bool) -> tuple[Window, gtsam.Pose3] | None:
        """The window in the world where the cost of the last step is least, and the motion."""
        posterior = self._posterior
        if posterior is None or posterior.d @ posterior.d < LEAST_GAIN:
            return None
        staying = [key for key in window.state.variables() if key in posterior.layout.dims]
        known = posterior.marginal(staying)
        g = left_of_gauge(window, known, level)
        if g is None:
            return None
        window, self._posterior, motion = moved_by_gauge(window, known, g)
        return window, motion

    def landmarks(self, window: Window) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and world positions (N, 3) of the features that the last step estimated."""
        return window.points()

    def factor_graph(self, window: Window) -> WindowGraph:
        """The cost of the last step, after its Gauss-Newton steps and before marginalization."""
        cost = self._cost
        if cost is None:  # nothing but the start
            cost = Cost(window.state, self._context.projection, self._context.config, window.prior)
        everything = np.ones(len(cost.tracks.points) if cost.tracks is not None else 0, np.bool_)
        determined = cost.part(cost.factors, everything)  # without features that lost observations
        return window_graph(determined)
