# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What an engine is: it turns the measurements of one frame into a state.

`Estimator` does what all algorithms have in common: it takes the input, checks it, detects
standstill and finds the first state. Its engine does the rest, frame by frame. There are two: this
package's own (`engine.py`) and GTSAM's smoothers (`gtsam_smoothers/`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.gating import Innovations
from slam_graph.backend.cost.imu_factor import Propagation, VelocityCorrection
from slam_graph.backend.cost.pixel_noise import PixelNoise
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.selection_policies import FEATURE_POLICIES
from slam_graph.backend.online_calibration import CalibrationVariables
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.visual_motion import VisualMotion
from slam_graph.backend.window import Window
from slam_graph.backend.window_graph import WindowGraph
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, ImuBuffer, Rig


@dataclass(eq=False)
class StepReport:
    """What is known of one step besides the state.

    Attributes:
        timings: seconds that each module took.
        costs: the cost before the first Gauss-Newton step and after each; empty if not known.
        columns: dimension of the state, with the features that are stored; 0 without costs.
        innovations: how far the measurements were from what was predicted.
        correction: of the velocity that the IMU predicted; None if not known, and at a standstill.
        rejected: ids (N,) of the features that the gate rejected, ascending.
    """

    timings: dict[str, float] = field(default_factory=dict)
    costs: tuple[float, ...] = ()
    columns: int = 0
    innovations: Innovations = field(default_factory=Innovations)
    correction: VelocityCorrection | None = None
    rejected: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    def timed(self, module: str) -> _Timed:
        """Measure how long a block takes; nothing is noted where it fails."""
        return _Timed(self.timings, module)


class _Timed:
    """Times a block; a generator takes several times as long."""

    def __init__(self, timings: dict[str, float], module: str) -> None:
        self._timings, self._module = timings, module

    def __enter__(self) -> None:
        self._start_s = time.perf_counter()

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if kind is None:
            self._timings[self._module] = time.perf_counter() - self._start_s


@dataclass(frozen=True, eq=False)
class EngineContext:
    """What an engine works with; the estimator shares it with its own start and input.

    Attributes:
        rig: the sensors as they were calibrated.
        algorithm: the policies.
        config: settings that do not depend on the algorithm.
        diagnostics: counts warnings.
        calibration: which parameters of the rig are variables.
        projection: into the cameras of the rig.
        propagation: predicts a new frame's state by the IMU.
        imu: the recent samples.
    """

    rig: Rig
    algorithm: AlgorithmConfig
    config: BackendConfig
    diagnostics: Diagnostics
    calibration: CalibrationVariables
    projection: RigProjection
    propagation: Propagation
    imu: ImuBuffer = field(default_factory=ImuBuffer)

    @cached_property
    def pixels(self) -> PixelNoise:
        """Noise of the observations, which the engine estimates on the way.

        Where features are linearised anew in every step, residuals in the window have the errors of
        its poses in them, which look like drift: there it stays what the settings say.
        """
        anew = FEATURE_POLICIES[self.algorithm.cost.features].relinearized
        learns = self.config.noise.adaptive_drift and not anew
        noise = self.config.noise.model_copy(update={"adaptive_drift": learns})
        return PixelNoise(noise, len(self.rig.cameras), self.rig.depth is not None)

    @cached_property
    def _motion(self) -> VisualMotion:
        return VisualMotion(self.rig, self.config.dynamics.min_points)

    def note(self, frame: FeatureFrame) -> None:
        """Remember the first frame: its depths give the points for PnP in the second one."""
        if self.config.dynamics.start_at_images:
            self._motion.note(frame)

    def by_images(
        self, frame: FeatureFrame, known: Callable[[], tuple[IntArray, FloatArray]]
    ) -> Callable[[NavState, NavState], NavState] | None:
        """What corrects the prediction of a frame by its images; None if that is not wanted.

        Args:
            frame: its features.
            known: gives ids (N,) and world positions (N, 3) of the features that are known.
        """
        if not self.config.dynamics.start_at_images:
            return None
        last = self._motion.note(frame)
        return lambda before, predicted: self._motion.corrected(
            before, predicted, (last, frame), known()
        )

    def add_observations(self, window: Window, frame: FeatureFrame) -> None:
        """Add the observations of the window's current frame to its tracks."""
        window.tracks.add(window.frame, frame)
        self.calibration.note_motion(
            window.state, window.frame, window.stamp_ns, frame.stamp_ns, self.imu
        )


class Engine(Protocol):
    """Estimates a state for each frame, once there is a first one."""

    def step(
        self,
        window: Window,
        stamp_ns: int,
        frame: FeatureFrame,
        still_sigma: float | None,
        report: StepReport,
    ) -> NavState:
        """Take the measurements of one frame.

        Args:
            window: the variables; the step changes it.
            stamp_ns: time of the frame on the clock of the IMU, after that of the window.
            frame: the observations, all cameras of the rig, finite.
            still_sigma: standard deviation of the velocity from zero at a standstill, m/s; None if
                the platform moves.
            report: gets what is known of this step.

        Returns:
            The state of the frame with its covariance.
        """
        ...

    def information(self, window: Window) -> SquareRootInformation:
        """What the last step knew of the variables, the calibration among them."""
        ...

    def regauged(
        self, window: Window, level: bool, measured: bool
    ) -> tuple[Window, gtsam.Pose3 | None]:
        """The window in the world where the cost of the last step is least, linearised there.

        Args:
            window: after the step.
            level: whether gravity is measured, so that the world turns about the vertical only.
            measured: whether the step had a measurement of the place of the world.

        Returns:
            With the motion new_T_old of the worlds; None if estimates stay where the step has put
            them, to first order.
        """
        ...

    def landmarks(self, window: Window) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and world positions (N, 3) of the features that the last step estimated."""
        ...

    def factor_graph(self, window: Window) -> WindowGraph:
        """The cost of the last step as a factor graph."""
        ...
