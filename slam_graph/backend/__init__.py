# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""From feature tracks to states: frame by frame, and the recording as a whole at the end."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "FEATURE_POLICIES",
    "POSE_SELECTIONS",
    "AlgorithmConfig",
    "Attempt",
    "BackendConfig",
    "Estimator",
    "FeaturePolicy",
    "FinalBa",
    "FinalBaConfig",
    "FrameLog",
    "GainRatioDamping",
    "Innovations",
    "MovingObjects",
    "ObjectFrame",
    "ObjectSmoother",
    "ObjectsConfig",
    "PoseSelection",
    "PosedFrame",
    "RigProjection",
    "RobustLoss",
    "TenfoldDamping",
    "WindowGraph",
    "levenberg_marquardt",
    "visual_rotation",
]

if TYPE_CHECKING:
    from slam_graph.backend.backend_config import BackendConfig
    from slam_graph.backend.cost.gating import Innovations
    from slam_graph.backend.cost.reprojection import RigProjection
    from slam_graph.backend.cost.robust_loss import RobustLoss
    from slam_graph.backend.cost.selection_policies import (
        FEATURE_POLICIES,
        POSE_SELECTIONS,
        FeaturePolicy,
        PoseSelection,
    )
    from slam_graph.backend.estimator import Estimator
    from slam_graph.backend.initialization.visual_rotation import visual_rotation
    from slam_graph.backend.objects.moving_objects import MovingObjects
    from slam_graph.backend.objects.object_frame import ObjectFrame
    from slam_graph.backend.objects.objects_config import ObjectsConfig
    from slam_graph.backend.policies import AlgorithmConfig
    from slam_graph.backend.posed_frame import PosedFrame
    from slam_graph.backend.smoothing.final_adjustment import FinalBa
    from slam_graph.backend.smoothing.frame_log import FrameLog
    from slam_graph.backend.smoothing.object_smoothing import ObjectSmoother
    from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
    from slam_graph.backend.solve.damped_steps import (
        Attempt,
        GainRatioDamping,
        TenfoldDamping,
        levenberg_marquardt,
    )
    from slam_graph.backend.window_graph import WindowGraph
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "backend_config": ("BackendConfig",),
            "cost.gating": ("Innovations",),
            "cost.reprojection": ("RigProjection",),
            "cost.robust_loss": ("RobustLoss",),
            "cost.selection_policies": (
                "FEATURE_POLICIES",
                "POSE_SELECTIONS",
                "FeaturePolicy",
                "PoseSelection",
            ),
            "estimator": ("Estimator",),
            "initialization.visual_rotation": ("visual_rotation",),
            "objects.moving_objects": ("MovingObjects",),
            "objects.object_frame": ("ObjectFrame",),
            "objects.objects_config": ("ObjectsConfig",),
            "policies": ("AlgorithmConfig",),
            "posed_frame": ("PosedFrame",),
            "smoothing.final_adjustment": ("FinalBa",),
            "smoothing.frame_log": ("FrameLog",),
            "smoothing.object_smoothing": ("ObjectSmoother",),
            "smoothing.smoothing_config": ("FinalBaConfig",),
            "solve.damped_steps": (
                "Attempt",
                "GainRatioDamping",
                "TenfoldDamping",
                "levenberg_marquardt",
            ),
            "window_graph": ("WindowGraph",),
        },
    )
