# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""From feature tracks to states: cost construction, Gauss-Newton steps, marginalization."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "FEATURE_POLICIES",
    "IMU_GAP_SCALE",
    "POSE_SELECTIONS",
    "AlgorithmConfig",
    "Attempt",
    "BackendConfig",
    "Estimator",
    "FeatureTracks",
    "GainRatioDamping",
    "Geometry",
    "Innovations",
    "Observations",
    "PoseSelection",
    "ProjectionFactors",
    "RigProjection",
    "RobustLoss",
    "StandstillDetector",
    "StepSettings",
    "TenfoldDamping",
    "TriangulationConfig",
    "WindowGraph",
    "ZeroVelocityConfig",
    "imu_factor",
    "levenberg_marquardt",
    "pixel_noise",
    "stacked_points",
    "stacked_poses",
    "triangulate",
    "zero_velocity_factors",
]

if TYPE_CHECKING:
    from slam_graph.backend.backend_config import (
        BackendConfig,
        TriangulationConfig,
        ZeroVelocityConfig,
    )
    from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations
    from slam_graph.backend.cost.gating import Innovations
    from slam_graph.backend.cost.imu_factor import IMU_GAP_SCALE, imu_factor
    from slam_graph.backend.cost.reprojection import Geometry, RigProjection
    from slam_graph.backend.cost.robust_loss import RobustLoss
    from slam_graph.backend.cost.selection_policies import (
        FEATURE_POLICIES,
        POSE_SELECTIONS,
        PoseSelection,
    )
    from slam_graph.backend.cost.triangulation import triangulate
    from slam_graph.backend.cost.zero_velocity import StandstillDetector, zero_velocity_factors
    from slam_graph.backend.estimator import Estimator
    from slam_graph.backend.gtsam_smoothers.smoother_features import ProjectionFactors, pixel_noise
    from slam_graph.backend.policies import AlgorithmConfig
    from slam_graph.backend.solve.damped_steps import (
        Attempt,
        GainRatioDamping,
        StepSettings,
        TenfoldDamping,
        levenberg_marquardt,
    )
    from slam_graph.backend.solve.state import stacked_points, stacked_poses
    from slam_graph.backend.window_graph import WindowGraph
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "backend_config": ("BackendConfig", "TriangulationConfig", "ZeroVelocityConfig"),
            "cost.feature_tracks": ("FeatureTracks", "Observations"),
            "cost.gating": ("Innovations",),
            "cost.imu_factor": ("IMU_GAP_SCALE", "imu_factor"),
            "cost.reprojection": ("Geometry", "RigProjection"),
            "cost.robust_loss": ("RobustLoss",),
            "cost.selection_policies": ("FEATURE_POLICIES", "POSE_SELECTIONS", "PoseSelection"),
            "cost.triangulation": ("triangulate",),
            "cost.zero_velocity": ("StandstillDetector", "zero_velocity_factors"),
            "estimator": ("Estimator",),
            "gtsam_smoothers.smoother_features": ("ProjectionFactors", "pixel_noise"),
            "policies": ("AlgorithmConfig",),
            "solve.damped_steps": (
                "Attempt",
                "GainRatioDamping",
                "StepSettings",
                "TenfoldDamping",
                "levenberg_marquardt",
            ),
            "solve.state": ("stacked_points", "stacked_poses"),
            "window_graph": ("WindowGraph",),
        },
    )
