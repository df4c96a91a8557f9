# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Builds the estimator of an algorithm, whichever engine it runs on."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.gating import Innovations
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.gtsam_smoothers.smoother_estimator import SmootherEstimator
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.calibration_estimate import CalibrationEstimate
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig


class EstimatorLike(Protocol):
    """What every estimator can do. Feed it IMU samples and feature frames in the order of time."""

    @property
    def timings(self) -> dict[str, float]:
        """Seconds that each module took in the last step."""
        ...

    @property
    def costs(self) -> tuple[float, ...]:
        """The cost before the first step of the last frame and after each; empty if not known."""
        ...

    @property
    def columns(self) -> int:
        """Dimension of the state in the last step that has costs."""
        ...

    @property
    def innovations(self) -> Innovations:
        """How far the last frame was from what was predicted of it."""
        ...

    @property
    def imu_noise(self) -> tuple[float, float]:
        """Factors on the white noise of gyroscope and accelerometer that are assumed now."""
        ...

    @property
    def initialized(self) -> bool:
        """Whether there is a state."""
        ...

    @property
    def waiting_for(self) -> str:
        """What a start still needs."""
        ...

    def start(self, state: NavState) -> None:
        """Begin from a known state with its covariance."""
        ...

    def add_imu(self, imu: ImuData) -> None:
        """Add IMU samples."""
        ...

    def add_frame(self, frame: FeatureFrame) -> NavState | None:
        """Take the features of one time and estimate the state then."""
        ...

    @property
    def rejected(self) -> NDArray[np.int64]:
        """Ids (N,) of the features that the gate rejected in the last step."""
        ...

    @property
    def calibration(self) -> CalibrationEstimate | None:
        """The calibration now; None if nothing of it is estimated, or there is no state yet."""
        ...

    def landmarks(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids (N,) and world positions (N, 3) of features."""
        ...


def build_estimator(
    rig: Rig,
    algorithm: AlgorithmConfig,
    config: BackendConfig | None = None,
    diagnostics: Diagnostics | None = None,
) -> EstimatorLike:
    """The estimator of an algorithm.

    Args:
        rig: calibrated sensors.
        algorithm: its table; `engine` says what solves the problem.
        config: what does not depend on the algorithm.
        diagnostics: counts warnings.
    """
    kind = Estimator if algorithm.engine == "square_root" else SmootherEstimator
    return kind(rig, algorithm, config, diagnostics)
