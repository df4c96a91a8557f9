# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What an estimator knows beyond the states that it reports: covariances, graph, landmarks."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray, ascending_union
from slam_graph.backend.aiding.aiding_factors import Aiding
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.track_fit import TrackFit
from slam_graph.backend.cost.zero_velocity import StandstillDetector
from slam_graph.backend.engine_protocol import Engine, EngineContext, StepReport
from slam_graph.backend.initialization.clock_change import ClockChange, ClockChanges
from slam_graph.backend.initialization.segment_joint import SegmentJoint
from slam_graph.backend.initialization.start_calibration import StartCalibration
from slam_graph.backend.initialization.start_up import StartUp
from slam_graph.backend.rigid_motion_watch import RigidMotionWatch
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.backend.window import Window
from slam_graph.backend.window_graph import WindowGraph
from slam_graph.errors import EstimationError
from slam_graph.geometry import NavState
from slam_graph.sensors import AidingData, CalibrationEstimate, Rig


class EstimatorKnowledge:
    """The part of an estimator that answers questions.

    Attributes:
        window: the variables and what is known of them; None as long as there is no state.
        aiding: takes position fixes and odometry up to the next frame.
        rig: the sensors, as calibrated or corrected at the start.
        clock_change: found at the last frame: the state is wrong since then; see `begin_segment`.
        clock_changes: those that are corrected in the IMU samples.
        report: what is known of the last step besides the state.
        times_ns: when the states are of the frames that the last call took, by their stamps.
    """

    window: Window | None
    aiding: Aiding
    rig: Rig
    clock_change: ClockChange | None
    clock_changes: ClockChanges
    report: StepReport
    times_ns: dict[int, int]
    _real_rig: Rig
    _corrected: bool
    _engine: Engine
    _context: EngineContext
    _start_up: StartUp
    _given: NavState | None
    _check: StartCalibration
    _standstill: StandstillDetector
    _motions: RigidMotionWatch

    @property
    def imu_stamps_ns(self) -> IntArray:
        """Times (N,) of the recent IMU samples, ascending, on the clock of states."""
        return self._context.imu.data.stamps_ns

    @property
    def rejected(self) -> IntArray:
        """Ids (N,) of the features that the gate rejected in the last frame, ascending."""
        return self.report.rejected

    def covariance_of(self, keys: Sequence[int]) -> FloatArray:
        """The joint covariance (n, n) of variables after the last step.

        Args:
            keys: of past poses X(i), of the current state X(i), V(i), B(i), of features L(j) of the
                state, or of the calibration; tangents are GTSAM's.

        Raises:
            EstimationError: if there is no state yet, or a key is not of a variable now.
        """
        if self.window is None:
            raise EstimationError("there is no state yet")
        information = self._engine.information(self.window)
        missing = [gtsam.DefaultKeyFormatter(k) for k in keys if k not in information.layout]
        if missing:
            raise EstimationError(f"not variables of the last step: {', '.join(missing)}")
        return information.covariance_of(keys)

    def factor_graph(self) -> WindowGraph:
        """The cost of the last step as a factor graph of GTSAM with its values.

        For this package's engine: marginal prior, dynamics, and a projection factor for each
        observation, after the Gauss-Newton steps and before marginalization. For GTSAM's smoothers:
        what they hold.

        Raises:
            EstimationError: if there is no state yet.
        """
        if self.window is None:
            raise EstimationError("there is no state yet, and so no factor graph")
        return self._engine.factor_graph(self.window)

    def pixel_noise_px(self) -> float:
        """Standard deviation of the observations as tracks show it; that of the settings at first.

        A mean over the cameras.
        """
        return float(np.mean(self._context.pixels.estimate_px))

    @staticmethod
    def track_fit(config: BackendConfig) -> TrackFit:
        """A comparison of tracks with the states that an estimator reports, without frames yet."""
        return TrackFit(config.noise.pixel_sigma)

    @property
    def scaled_camera(self) -> gtsam.Pose3 | None:
        """body_T_camera of the camera whose path is up to scale so far; None for metres."""
        return None if self.aiding.aligned else self.rig.scaled_camera

    @property
    def joint(self) -> SegmentJoint | None:
        """How the present segment continues the one before; None in the first."""
        return self._start_up.joint

    @property
    def start_is_doubtful(self) -> bool:
        """Whether what follows the start may still contradict it."""
        return self._start_up.doubtful

    @property
    def assumed_noise_px(self) -> float:
        """Largest standard deviation of observations over the cameras, as the cost takes it."""
        return float(np.max(self._context.pixels.sigma_px))

    @property
    def imu_noise(self) -> tuple[float, float]:
        """Factors on the white noise of gyroscope and accelerometer that are assumed now."""
        return self._context.propagation.noise.factors

    @property
    def imu_noise_at_limit(self) -> bool:
        """Whether a noise density of the IMU was raised as far as it may be."""
        return self._context.propagation.noise.at_limit

    def find_clock_change(self) -> ClockChange | None:
        """The change of the clock that explains why an estimate is lost, if there is one."""
        self.clock_change = self.clock_change or self._check.clock_change(self._context.imu)
        return self.clock_change

    @property
    def misses_imu(self) -> bool:
        """Whether samples of the IMU were missing up to the last frame."""
        return self._context.propagation.missed

    @property
    def predicted(self) -> gtsam.Pose3 | None:
        """`world_T_body` of the last frame as the IMU predicts it from the estimate before.

        None where samples were missing, without an IMU, and without a covariance.
        """
        return self._context.propagation.predicted

    @property
    def motion(self) -> FrameMotion | None:
        """The motion of the body within the last frame, where a shutter rolls."""
        window = self.window
        return None if window is None else window.state.motions.get(window.frame)

    @property
    def rig_now(self) -> Rig:
        """The rig with the parameters that are estimated now."""
        variables = self._context.calibration
        if self.window is None or not variables.keys:
            return variables.nominal
        return variables.rig(self.window.state.frames)

    @property
    def calibration(self) -> CalibrationEstimate | None:
        """The calibration now; None if nothing of it is estimated, or there is no state yet."""
        variables = self._context.calibration
        if self.window is None or not variables.keys:
            return None
        information = self._engine.information(self.window)
        return variables.estimate(self.window.stamp_ns, self.window.state, information)

    @property
    def corrected_rig(self) -> Rig | None:
        """The rig, if the first motion has shown that its calibration does not fit; else None."""
        return self.rig.select(len(self._real_rig.cameras)) if self._corrected else None

    @property
    def rig_on_raw_clock(self) -> Rig | None:
        """The corrected rig against the IMU samples as they come; None if nothing is corrected."""
        if not self.clock_changes:
            return self.corrected_rig
        return self.rig.select(len(self._real_rig.cameras)).shifted(self.clock_changes.shift_s)

    @property
    def fix_calibration(self) -> AidingData.Calibration | None:
        """Lever arm and clock of the position fixes now; None where they are no variables."""
        if self.window is None or not self.aiding.aligned or self.aiding.variables is None:
            return None
        information = self._engine.information(self.window)
        return self.aiding.calibration(self.window.state, information)

    def landmarks(self) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and world positions (N, 3) of the features that the last step estimated."""
        if self.window is None:
            return np.zeros(0, np.int64), np.zeros((0, 3))
        return self._engine.landmarks(self.window)

    @property
    def initialized(self) -> bool:
        """Whether there is a state."""
        return self.window is not None

    @property
    def start_is_given(self) -> bool:
        """Whether the first state was given, by `start`."""
        return self._given is not None

    @property
    def waiting_for(self) -> str:
        """What a start still needs, and the likeliest cause of the lack."""
        if not self._check.mounted:
            return self._check.waiting_for
        return self._start_up.waiting_for(self._check.contradiction(self._context.imu))

    @property
    def dynamic(self) -> IntArray:
        """Ids (N,) of the tracked features that move by themselves, ascending."""
        return ascending_union(self._standstill.dynamic, self._motions.moving)
