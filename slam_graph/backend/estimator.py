# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The estimator: one loop of cost construction, Gauss-Newton steps and marginalization.

Every recursive algorithm is this loop under a policy (`policies.py`). See docs/engine.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from threadpoolctl import ThreadpoolController

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.calibrated_projection import CalibratedProjection
from slam_graph.backend.cost.construction import ConstructedCost, CostConstruction
from slam_graph.backend.cost.gating import Innovations
from slam_graph.backend.cost.imu_factor import Propagation
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.zero_velocity import StandstillDetector
from slam_graph.backend.initialization.initializer import Initializer, start_from
from slam_graph.backend.marginalization.marginalize import marginalize_step
from slam_graph.backend.online_calibration import CalibrationVariables
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.solve.gauss_newton import Minimum, minimize
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.calibration_estimate import CalibrationEstimate
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData
from slam_graph.sensors.rig import Rig

IMU_HISTORY_NS = 10_000_000_000
"""How long IMU samples are kept."""
MAX_AHEAD_NS = 10_000_000_000
"""A frame that is later than the last IMU sample by more than this has a wrong stamp."""


class Estimator:
    """A visual-inertial estimator under the policies of one algorithm.

    Feed it IMU samples and feature frames in the order of time; every frame gives the state then.

    Attributes:
        window: variables, prior and tracks; None as long as there is no state.
        timings: seconds that each module took in the last step.
        costs: the cost before the first Gauss-Newton step of the last frame and after each.
        columns: dimension of the state in the last step, with the features that are put aside.
        innovations: how far the last frame was from what was predicted of it.
    """

    def __init__(
        self,
        rig: Rig,
        algorithm: AlgorithmConfig,
        config: BackendConfig | None = None,
        diagnostics: Diagnostics | None = None,
    ) -> None:
        self.rig = rig
        self.algorithm = algorithm
        self.config = _with_loss(config or BackendConfig(), algorithm)
        self.diagnostics = diagnostics or Diagnostics()
        self.window: Window | None = None
        self.timings: dict[str, float] = {}
        self.costs: tuple[float, ...] = ()
        self.columns = 0
        self.innovations = Innovations()
        self._calibration = CalibrationVariables(rig, self.config.calibration)
        projection = RigProjection(rig)
        if self._calibration.keys:
            projection = CalibratedProjection(self._calibration)
        self._propagation = Propagation(rig.imu, self.config, self.diagnostics)
        self._construction = CostConstruction(
            algorithm.cost, projection, self.config, self.diagnostics
        )
        self._initializer = Initializer(
            projection, self._propagation.noise.params(), algorithm, self.config, self._calibration
        )
        self._standstill = StandstillDetector(self.config.zero_velocity)
        self._imu = ImuBuffer()
        self._latest_ns = np.iinfo(np.int64).min
        self._posterior: SquareRootInformation | None = None
        # the matrices are small: waking threads for them costs many times what they save
        self._threads = ThreadpoolController()

    # --- the loop --------------------------------------------------------------------------------

    def _step(self, window: Window, stamp_ns: int, frame: FeatureFrame, still: bool) -> NavState:
        """One turn of the loop: the three modules, in order."""
        with self._timed("propagation"):
            self._propagation.append_frame(window, self._imu, stamp_ns, still)
            self._add_tracks(window, frame)
        with self._timed("cost"):
            constructed = self._construction.construct(window, still)
        with self._timed("gauss_newton"):
            minimum = self._minimize(constructed)
            self.costs = minimum.costs
            self.columns = minimum.posterior.layout.size + window.archive.size
            self._construction.reject_residuals(window, constructed)
            self.innovations = constructed.innovations_under(minimum.posterior)
        with self._timed("marginalization"):
            policy = self.algorithm.marginalization
            marginalize_step(window, constructed, minimum, policy)
        self._posterior = minimum.posterior
        state = window.current(minimum.posterior)
        self._propagation.learn(state)
        return state

    def _minimize(self, constructed: ConstructedCost) -> Minimum:
        """Take the steps; without the features if these leave something undetermined."""
        policy = self.algorithm.gauss_newton
        again = self._calibration.moved_far if self._calibration.keys else None
        try:
            return minimize(constructed.cost, policy, constructed.linear, again)
        except np.linalg.LinAlgError:
            self.diagnostics.warn("features_degenerate", "one frame goes without its features")
            constructed.drop_features()
            return minimize(constructed.cost, policy)

    @contextmanager
    def _timed(self, module: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.timings[module] = time.perf_counter() - start

    # --- the outside -----------------------------------------------------------------------------

    @property
    def initialized(self) -> bool:
        """Whether there is a state."""
        return self.window is not None

    @property
    def imu_noise(self) -> tuple[float, float]:
        """Factors on the white noise of gyroscope and accelerometer that are assumed now."""
        return self._propagation.noise.factors

    @property
    def waiting_for(self) -> str:
        """What a start still needs."""
        return self._initializer.waiting_for

    def start(self, state: NavState) -> None:
        """Begin from a known state.

        Args:
            state: with its covariance.

        Raises:
            EstimationError: if the state has no covariance.
        """
        if state.covariance is None:
            raise EstimationError("a start state needs a covariance")
        self.window = start_from(state, self.config, self._calibration)

    def add_imu(self, imu: ImuData) -> None:
        """Add IMU samples that follow those already given; others are counted and left out."""
        left_out = self._imu.add(imu)
        if left_out:
            message = f"{left_out} IMU samples are not finite or not in order"
            self.diagnostics.warn("imu_rejected", message)

    def add_frame(self, frame: FeatureFrame) -> NavState | None:
        """Take the features of one time and estimate the state then.

        Returns:
            The causal estimate with its covariance, stamped on the clock of the IMU. None as long
            as there is no state, and for a frame that does not follow those before.
        """
        state = self.window.state if self.window is not None else None
        stamp_ns = self._calibration.stamp(frame.stamp_ns, state, self._imu)
        self.timings, self.costs, self.innovations = {}, (), Innovations()
        if not self._latest_ns < stamp_ns <= self._imu.newest_ns() + MAX_AHEAD_NS:
            message = f"frame at {frame.stamp_ns} ns does not follow the frames and the IMU"
            self.diagnostics.warn("frame_out_of_order", message)
            return None
        self._latest_ns = stamp_ns
        self._imu.forget_before(stamp_ns - IMU_HISTORY_NS)
        frame = self._usable(frame)
        with self._threads.limit(limits=1, user_api="blas"):
            still = self._standstill.is_still(self._imu, stamp_ns, frame)
            frame = frame.without(self._standstill.movers)
            if self.window is None:
                with self._timed("start"):
                    self.window = self._initializer.try_to_start(self._imu, stamp_ns, frame)
                if self.window is not None:
                    self._standstill.know_movers(self._initializer.unfit)
            elif stamp_ns > self.window.stamp_ns:
                return self._step(self.window, stamp_ns, frame, still)
            elif stamp_ns == self.window.stamp_ns:
                self._add_tracks(self.window, frame)
            if self.window is None or stamp_ns < self.window.stamp_ns:
                return None
            return self.window.current(self.window.prior)

    @property
    def rejected(self) -> IntArray:
        """Ids (N,) of the features that the gate rejected in the last step."""
        return self._construction.rejected

    @property
    def calibration(self) -> CalibrationEstimate | None:
        """The calibration now; None if nothing of it is estimated, or there is no state yet."""
        if self.window is None or not self._calibration.keys:
            return None
        information = self._posterior or self.window.prior
        return self._calibration.estimate(self.window.stamp_ns, self.window.state, information)

    def landmarks(self) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and world positions (N, 3) of the features that the last step estimated."""
        if self.window is None:
            return np.zeros(0, np.int64), np.zeros((0, 3))
        return self.window.points()

    def _add_tracks(self, window: Window, frame: FeatureFrame) -> None:
        """Add what the current frame has seen."""
        window.tracks.add(window.frame, frame)
        self._calibration.note_motion(
            window.state, window.frame, window.stamp_ns, frame.stamp_ns, self._imu
        )

    def _usable(self, frame: FeatureFrame) -> FeatureFrame:
        """The frame with all cameras of the rig, without observations that are not finite."""
        missing = len(self.rig.cameras) - len(frame.cameras)
        if missing > 0:
            empty = (FeatureObservations.empty(),) * missing
            frame = FeatureFrame(frame.stamp_ns, frame.cameras + empty)
        good = [
            np.all(np.isfinite(np.hstack([c.pixels, c.normalized])), axis=1) for c in frame.cameras
        ]
        bad = sum(int(np.sum(~rows)) for rows in good)
        if not bad:
            return frame
        self.diagnostics.warn("feature_not_finite", f"{bad} observations at {frame.stamp_ns} ns")
        cameras = (c.select(rows) for c, rows in zip(frame.cameras, good, strict=True))
        return FeatureFrame(frame.stamp_ns, tuple(cameras))


def _with_loss(config: BackendConfig, algorithm: AlgorithmConfig) -> BackendConfig:
    """The settings with the robust loss of an algorithm, where it has one of its own."""
    loss = algorithm.cost.robust_loss
    if loss is None:
        return config
    gating = config.gating.model_copy(update={"robust_loss": loss})
    return config.model_copy(update={"gating": gating})
