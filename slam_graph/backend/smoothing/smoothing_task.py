# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the bundle adjustment of a segment is given, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.depth_camera import with_depth_camera
from slam_graph.backend.dynamics import model_rig, without_imu
from slam_graph.backend.smoothing.adjustment_figures import AdjustmentFigures
from slam_graph.backend.smoothing.calibration_equations import CalibrationEquations
from slam_graph.backend.smoothing.imu_noise_estimation import ImuNoiseFactors
from slam_graph.backend.smoothing.pose_equations import PoseEquations
from slam_graph.backend.smoothing.recording_segment import RecordingSegment
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import AidingData, Rig


@dataclass(frozen=True, slots=True)
class SmoothingTask:
    """What does not change from segment to segment of a recording.

    Attributes:
        rig: the best calibration available.
        backend: noise and triangulation.
        config: settings of the bundle adjustment.
        causal: motion between keyframes where there is no IMU to predict it.
        least_noise: smallest factor on the noise of the IMU, or of the dynamics, that is learned.
        joint: whether the equations at the minimum are kept, which others can be joined to.
        calibration: whether the equations of the calibration are wanted.
    """

    rig: Rig
    backend: BackendConfig
    config: FinalBaConfig
    causal: Trajectory | None = None
    least_noise: float = 1.0
    joint: bool = False
    calibration: bool = False

    @classmethod
    def of(
        cls, rig: Rig, backend: BackendConfig, config: FinalBaConfig, least_noise: float = 1.0
    ) -> SmoothingTask:
        """The task under the dynamics that the settings choose."""
        rig = with_depth_camera(rig)
        if backend.dynamics.uses_imu(rig.has_imu):
            return cls(rig, backend, config, least_noise=least_noise)
        alone = config.model_copy(update={"average_frames": False})  # an IMU would relate them
        rig = model_rig(rig, backend.dynamics)
        return cls(rig, without_imu(backend, rig.sees_depth), alone, least_noise=least_noise)

    @property
    def preintegration(self) -> gtsam.PreintegrationCombinedParams:
        """Noise of the IMU by the calibration."""
        return self.rig.imu.preintegration_params(self.backend.noise.gravity)


@dataclass(frozen=True, slots=True, eq=False)
class LooseAdjustment:
    """What an adjustment to the observations of some of the keyframes has left.

    Attributes:
        given: states of the keyframes before it, for `cost_before`.
        noise: factors on the noise of the IMU that it has learned.
    """

    given: list[NavState]
    noise: ImuNoiseFactors


@dataclass(frozen=True, slots=True, eq=False)
class SegmentStart:
    """A segment of a recording, and where its bundle adjustment starts.

    Attributes:
        segment: times, observations, IMU samples.
        states: initial states of the keyframes.
        anchor: number of the keyframe whose position and yaw are fixed.
        loose: the adjustment that `states` come from; None if they are not adjusted yet.
        joint: number of the keyframe where the next segment takes over; None if there is none.
    """

    segment: RecordingSegment
    states: list[NavState]
    anchor: int
    loose: LooseAdjustment | None = None
    joint: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedSegment:
    """The minimum of the cost of a segment.

    Attributes:
        states: of every frame; covariances, if known, relative to position and yaw of the anchor.
        figures: of the minimum.
        aligned: (N, 6, 6) pose covariances after an alignment in position and yaw, or None.
        noise: factors on the noise of the IMU of this minimum.
        equations: those at the minimum, if they are wanted and there are covariances.
        fixes: lever arm and clock of position fixes, where they are variables.
        calibration: equations of the calibration at the minimum, if they are wanted and known.
        gains: (N, 15, 6) how errors of the states follow from that of the pose at the joint with
            the next segment (`segment_chain.py`); None without one or without covariances.
    """

    states: list[NavState]
    figures: AdjustmentFigures
    aligned: FloatArray | None
    noise: ImuNoiseFactors
    equations: PoseEquations | None
    fixes: AidingData.Calibration | None = None
    calibration: CalibrationEquations | None = None
    gains: FloatArray | None = None
